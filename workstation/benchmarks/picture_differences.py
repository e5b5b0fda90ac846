"""How far a rendered picture is from its reference: radiance, what an eye sees of it, and shape.

PSNR and SSIM (Wang et al., IEEE TIP 13(4), 2004) of sRGB, FLIP (Andersson et al., HPG 2020) as its
authors compute it. Parallax is where a point's paint is shown against where it is: the height
missed, Δh · sin θ / (d · ω) pixels, as in :mod:`render.bounded`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from render.painter import RenderedImage
from render.views import View
from workstation.benchmarks.reference_rendering import Reference, ReferencePicture

Floats = NDArray[np.float64]

_FLIP_REACH_PX = 40  # beyond that of its filters
# Beyond which Embree's single precision is checked, and how many pixels at most.
_DISPUTED_UM = 2.0
_MOST_DISPUTED = 2000


@dataclass(frozen=True)
class Difference:
    """A picture against its reference.

    Attributes
    ----------
    psnr_db, psnr_covered_db : float
        Of linear radiance over the whole picture, peak 1, and where the painting is.
    ssim : float
    flip : float
        Mean over the whole picture.
    flip_covered : float
        Mean where the painting is.
    parallax_px : (float, float, float)
        Median, 95 % and maximum.
    hit_um : (float, float)
        Median and maximum distance of the points hit.
    coverage_px : int
        Pixels that only one of the two covers.
    """

    psnr_db: float
    psnr_covered_db: float
    ssim: float
    flip: float
    flip_covered: float
    parallax_px: tuple[float, float, float]
    hit_um: tuple[float, float]
    coverage_px: int


def difference(
    radiance: NDArray[np.float32],
    points: NDArray[np.float32],
    truth: ReferencePicture,
    reference: Reference,
    view: View,
) -> Difference:
    """Compare a picture (rows, cols, 3) and the points it shows with its reference."""
    from skimage.metrics import structural_similarity

    truth = _settled(points, truth, reference, view)
    covered, truly = np.isfinite(points[..., 0]), truth.covered
    both = covered & truly
    apart = 1000 * np.linalg.norm(points - truth.points, axis=-1)[both]
    off = parallax_px(points, truth.points, view)[both]
    encoded, wanted = encode(radiance), encode(truth.radiance)
    somewhere = covered | truly
    flip = _flip_where(somewhere, encoded, wanted)
    squares = (radiance - truth.radiance) ** 2
    return Difference(
        psnr_db=float(-10 * np.log10(np.mean(squares))),
        psnr_covered_db=float(-10 * np.log10(np.mean(squares[somewhere]))),
        ssim=float(structural_similarity(encoded, wanted, channel_axis=2, data_range=1.0)),
        flip=float(flip.mean()),
        flip_covered=float(flip[somewhere].mean()),
        parallax_px=(float(np.median(off)), float(np.quantile(off, 0.95)), float(off.max())),
        hit_um=(float(np.median(apart)), float(apart.max())),
        coverage_px=int((covered != truly).sum()),
    )


def parallax_px(points: NDArray[np.float32], true_points: Floats, view: View) -> Floats:
    """Pixels by which what is shown is off, (rows, cols); NaN where either shows nothing."""
    to_point = true_points - view.position
    d = np.linalg.norm(to_point, axis=-1)
    sine = np.linalg.norm(to_point[..., :2], axis=-1) / d
    pixel_angle = 2 * np.tan(view.field_of_view / 2) / points.shape[0]
    missed = np.abs(points[..., 2].astype(np.float64) - true_points[..., 2])
    return np.asarray(missed * sine / (d * pixel_angle))


def encode(radiance: NDArray[np.floating]) -> NDArray[np.float32]:
    """SRGB from 0 to 1."""
    empty = np.zeros(radiance.shape[:2], np.float32)
    picture = RenderedImage(radiance.astype(np.float32), empty, empty)
    return picture.encoded().astype(np.float32) / np.float32(255)


def flip_map(shown: NDArray[np.float32], wanted: NDArray[np.float32]) -> Floats:
    """FLIP of sRGB pictures (rows, cols, 3) by pixel."""
    import flip_evaluator

    error, _, _ = flip_evaluator.evaluate(wanted, shown, "LDR", applyMagma=False)
    return np.asarray(error, dtype=np.float64).reshape(shown.shape[:2])


def _flip_where(
    somewhere: NDArray[np.bool_], shown: NDArray[np.float32], wanted: NDArray[np.float32]
) -> Floats:
    """FLIP by pixel, which is 0 away from where the pictures have anything but background."""
    error = np.zeros(somewhere.shape)
    rows, cols = np.nonzero(somewhere)
    if not len(rows):
        return error
    window = tuple(
        slice(max(int(places.min()) - _FLIP_REACH_PX, 0), int(places.max()) + _FLIP_REACH_PX)
        for places in (rows, cols)
    )
    seen, truth = (np.ascontiguousarray(picture[window]) for picture in (shown, wanted))
    error[window] = flip_map(seen, truth)
    return error


def _settled(
    points: NDArray[np.float32], truth: ReferencePicture, reference: Reference, view: View
) -> ReferencePicture:
    """The reference, with disputed rays cast again in double precision.

    A mode that is not to hit what the triangles hit disputes nearly all of them: then the few along
    edges decide nothing.
    """
    apart = 1000 * np.linalg.norm(points - truth.points, axis=-1)
    disputed = (apart > _DISPUTED_UM) | (np.isfinite(points[..., 0]) != truth.covered)
    if disputed.sum() > _MOST_DISPUTED:
        return truth
    return reference.recast(truth, disputed, view)
