"""A flat white target: where it is, by the projected code, and what it shows of a lamp.

The decoded code tells the target's plane as it tells a painting's surface. The target is then cut
into blocks; each is a point with a mean radiance under every pose of the lamp. Blocks in a shadow,
or with its edge on them, are left out, and so are poses of the lamp that light the target so flatly
that no surface is matt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import robust_sigma
from calibration.arm_photographs import ArmPhotographs
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.sphere_search import Circle
from calibration.target_shading import TargetShading, shadow_depth

_DRAWS = 200
_DRAWN_FROM = 4000
_WINDOW = 0.1
_TOLERANCE_SIGMAS = 5.0
_LEAST_TOLERANCE_MM = 0.02
_ERODED_PX = 3
_BLOCKS = 10
_LEAST_COVERED = 0.6
_LEAST_KNOWN = 0.95
_LEAST_BLOCKS = 12
# Beyond this angle from its normal, no target is matt.
_LEAST_COSINE = 0.5
# Relative error of a block's mean beyond noise: the target's unevenness.
_UNEVEN = 1e-3
_AROUND_SPHERE = 1.15


@dataclass(frozen=True)
class WhiteTarget:
    """A flat target before the camera.

    Attributes
    ----------
    points : (n, 3) float64 array
        Middles of its blocks in the camera's frame, mm.
    normal : (3,) float64 array
        Unit, towards the camera.
    pixels : (n, 2) float64 array
        Columns and rows of the middles in the full frame.
    block : (rows, cols) int32 array
        Which block a pixel belongs to; -1 for none.
    flatness_mm : float
        RMS of its points about the plane, noise included.
    """

    points: NDArray[np.float64]
    normal: NDArray[np.float64]
    pixels: NDArray[np.float64]
    block: NDArray[np.int32]
    flatness_mm: float


def find_white_target(
    points: NDArray[np.float64],
    lens: Lens,
    *,
    origin: tuple[int, int] = (0, 0),
    seed: tuple[float, float] | None = None,
    spheres: Sequence[Circle] = (),
) -> WhiteTarget:
    """Find the plane that a pixel lies on, and cut it into blocks.

    Parameters
    ----------
    points : (rows, cols, 3) array
        By the projected code, in the camera's frame, mm; NaN where none was decoded.
    lens : Lens
        Of the camera.
    origin : (int, int)
        Column and row of the first pixel in the full frame.
    seed : (float, float), optional
        Column and row of a pixel on the target, in the pictures; by default their middle.
    spheres : sequence of (column, row, radius)
        Discs in the pictures that hide it.

    Raises
    ------
    CalibrationError
        There is no plane there, or too little of it.
    """
    from scipy.ndimage import binary_erosion, label

    rows, cols = points.shape[:2]
    column, row = seed or ((cols - 1) / 2, (rows - 1) / 2)
    along, down = np.arange(cols), np.arange(rows)[:, np.newaxis]
    known = np.isfinite(points).all(axis=-1)
    for c, r, radius in spheres:
        known &= np.hypot(along - c, down - r) > _AROUND_SPHERE * radius
    reach = _WINDOW * min(rows, cols)
    near = known & (np.abs(along - column) < reach) & (np.abs(down - row) < reach)
    if near.sum() < 100:
        raise CalibrationError(
            f"no code was decoded about column {column:.0f}, row {row:.0f}, where the white target "
            "should be: light it fully, or name a pixel on it"
        )
    middle, normal, spread = _plane(points[near])
    tolerance = max(_TOLERANCE_SIGMAS * spread, _LEAST_TOLERANCE_MM)
    for _ in range(3):
        on = known & (np.abs((points - middle) @ normal) < tolerance)
        pieces, _ = label(on)
        ids = pieces[near & on]
        if ids.size == 0:
            raise CalibrationError("the white target is not flat where it was looked for")
        on = pieces == np.bincount(ids[ids > 0]).argmax()
        middle, normal, spread = _least_squares_plane(points[on])
    block = _blocks(binary_erosion(on, iterations=_ERODED_PX))
    count = int(block.max()) + 1
    if count < _LEAST_BLOCKS:
        raise CalibrationError(
            f"the white target covers {count} blocks of the picture, and {_LEAST_BLOCKS} are "
            "needed: use a larger one, and see that it is flat"
        )
    inside = block >= 0
    size = np.bincount(block[inside], minlength=count)
    where = np.nonzero(inside)
    pixels = np.stack(
        [np.bincount(block[inside], weights=w, minlength=count) / size for w in where[::-1]], axis=1
    ) + np.array(origin)
    rays = lens.unproject(pixels)
    on_plane = rays * ((middle @ normal) / (rays @ normal))[:, np.newaxis]
    return WhiteTarget(on_plane, normal, pixels, block, spread)


def target_shading(
    photographs: ArmPhotographs,
    target: WhiteTarget,
    *,
    towards_lamp: NDArray[np.float64] | None = None,
    albedo: float = 1.0,
) -> TargetShading:
    """Radiance of the target's blocks under every pose.

    Parameters
    ----------
    photographs : ArmPhotographs
    target : WhiteTarget
    towards_lamp : (poses, 3) array, optional
        Rough directions to the lamp, NaN where unknown: poses that light the target flatly are left
        out.
    albedo : float
        Of the target.

    Returns
    -------
    TargetShading
        With gains of its points that are not known: the camera's vignetting.
    """
    poses, count = len(photographs.brackets), len(target.points)
    radiance = np.full((poses, count, 3), np.nan)
    sigma = np.full((poses, count, 3), np.nan)
    channels = photographs.channels
    for number in range(poses):
        if towards_lamp is not None and towards_lamp[number] @ target.normal < _LEAST_COSINE:
            continue
        means, errors = _means(*photographs.radiance(number), target.block, channels, count)
        lit = _evenly_lit(means, target.pixels)
        radiance[number, lit], sigma[number, lit] = means[lit], errors[lit]
    return TargetShading(target.points, target.normal, radiance, sigma, albedo, gains_unknown=True)


def _plane(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Point, normal towards the camera and robust spread of the plane most points lie on."""
    random = np.random.default_rng(0)
    some = points[random.permutation(len(points))[:_DRAWN_FROM]]
    corners = some[random.integers(0, len(some), (_DRAWS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals, corners = normals[length > 0] / length[length > 0, None], corners[length > 0]
    off = np.abs(np.einsum("kni,ki->kn", some[None] - corners[:, :1], normals))
    best = int(np.median(off, axis=1).argmin())
    kept = off[best] < 4 * robust_sigma(off[best]) + 1e-9
    return _least_squares_plane(some[kept])


def _least_squares_plane(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    middle = points.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((points - middle).T))
    normal = vectors[:, 0] * -np.sign(vectors[:, 0] @ middle)
    return middle, normal, float(np.sqrt(np.mean(((points - middle) @ normal) ** 2)))


def _blocks(mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Blocks of a grid that a mask covers well, numbered; -1 elsewhere."""
    rows, cols = np.nonzero(mask)
    block = np.full(mask.shape, -1, np.int32)
    if len(rows) == 0:
        return block
    size = max(8, int(max(np.ptp(rows), np.ptp(cols)) + 1) // _BLOCKS)
    down, along = (rows - rows.min()) // size, (cols - cols.min()) // size
    cell = down * (int(along.max()) + 1) + along
    covered = np.bincount(cell) >= _LEAST_COVERED * size**2
    number = np.where(covered, np.cumsum(covered) - 1, -1)
    block[rows, cols] = number[cell]
    return block


def _means(
    picture: NDArray[np.float32],
    variance: NDArray[np.float32],
    block: NDArray[np.int32],
    channels: NDArray[np.int64],
    count: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means (n, 3) of blocks and their standard errors; those of a monochrome sensor thrice."""
    known = (block >= 0) & np.isfinite(picture)
    rows, cols = np.nonzero(known)
    channel = channels[rows % 2, cols % 2]
    means, errors = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    full = np.maximum(np.bincount(block[block >= 0], minlength=count), 1)
    for k in range(3):
        use = (channel == k) | (channel < 0)
        which = block[rows[use], cols[use]]
        size = np.bincount(which, minlength=count)
        values = picture[rows[use], cols[use]].astype(np.float64)
        total = np.bincount(which, weights=values, minlength=count)
        squares = np.bincount(which, weights=variance[rows[use], cols[use]], minlength=count)
        # A block with saturated pixels would be that without its brightest.
        share = max(float(np.mean(channels == k)), float(np.mean(channels < 0)))
        whole = size >= _LEAST_KNOWN * share * full
        with np.errstate(divide="ignore", invalid="ignore"):
            means[:, k] = np.where(whole, total / size, np.nan)
            errors[:, k] = np.sqrt(squares) / size
    errors = np.hypot(errors, _UNEVEN * np.abs(means))
    return means, errors * (np.sqrt(3) if channels[0, 0] < 0 else 1.0)


def _evenly_lit(means: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Blocks that are in no shadow: light falls off smoothly over the target."""
    level = np.nanmean(means, axis=1)
    lit = np.isfinite(means).all(axis=1) & (level > 0.1 * np.nanmax(level, initial=0.0))
    at = (pixels - pixels.mean(axis=0)) / np.ptp(pixels, axis=0)
    terms = np.stack(
        [np.ones(len(at)), *at.T, at[:, 0] ** 2, at[:, 0] * at[:, 1], at[:, 1] ** 2], axis=1
    )
    for _ in range(8):
        if lit.sum() < len(terms.T) + 3:
            return np.zeros(len(means), np.bool_)
        logs = np.log(np.where(lit, level, 1.0))
        found = np.linalg.lstsq(terms[lit], logs[lit], rcond=None)[0]
        off = logs - terms @ found
        dark = lit & (off < -shadow_depth(off[lit]))
        if not dark.any():
            return lit
        # The darkest ones pull the fit: they go first.
        lit &= ~(dark & (off <= 0.5 * off[dark].min()))
    return lit
