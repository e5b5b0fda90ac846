"""Mirror spheres and their highlights, found in the photographs of a session.

A polished sphere in a dark room is a dark disc before a bright background. Discs are proposed by
Hough's transform in the mean of photographs under many lights, and kept if their edges lie on a
sphere's outline to a fraction of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.arm_fit import SphereHighlights
from calibration.arm_photographs import ArmPhotographs
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.mirror_spheres import (
    MirrorSphere,
    find_highlight,
    find_outline,
    sphere_from_outline,
)

Circle = tuple[float, float, float]
_SEARCH_WIDTH = 900
_LEAST_RADIUS = 8.0
_LARGEST_RADIUS = 0.25
_LEAST_EDGES = 0.6 * 240
_LARGEST_MISS_PX = 1.0
_DARK = 0.7
# Shares of what is bright below which something is dark, and of its circle that a disc fills.
_DARKNESS = (0.15, 0.3, 0.45)
_ROUND = 0.8
_MARGIN = 1.05
_LEAST_HIGHLIGHTS = 6


@dataclass(frozen=True)
class FoundSphere:
    """A sphere in the pictures.

    Attributes
    ----------
    circle : (float, float, float)
        Column and row of its middle in the pictures, and its radius, pixels.
    sphere : MirrorSphere
        In the camera's frame.
    """

    circle: Circle
    sphere: MirrorSphere


def find_spheres(
    photographs: ArmPhotographs,
    lens: Lens,
    *,
    radius_mm: float,
    near: Sequence[Circle] = (),
) -> list[FoundSphere]:
    """Find the mirror spheres of a session.

    Parameters
    ----------
    photographs : ArmPhotographs
    lens : Lens
        Of the camera.
    radius_mm : float
        Of the spheres.
    near : sequence of (column, row, radius)
        Where they are in the pictures, to a tenth of the radius; by default they are looked for.

    Returns
    -------
    list of FoundSphere
        From left to right.

    Raises
    ------
    CalibrationError
        A sphere is not where it was said to be, or was said to be where no picture is; or fewer
        than two are found.
    """
    picture = photographs.even_light()
    for circle in near:
        _check_inside(circle, picture.shape)
    clearest: list[tuple[float, FoundSphere]] = []
    for circle in near or _discs(picture):
        try:
            clearest.append(_refined(picture, circle, lens, photographs.origin, radius_mm))
        except CalibrationError as error:
            if near:
                raise CalibrationError(
                    f"no sphere at column {circle[0]:.0f}, row {circle[1]:.0f}: {error}"
                ) from error
    found: list[FoundSphere] = []
    # A sphere's own shadow may be a disc too; it is brighter.
    for _, one in sorted(clearest, key=lambda pair: pair[0]):
        apart = [np.hypot(*np.subtract(one.circle[:2], f.circle[:2])) for f in found]
        if all(a > one.circle[2] + f.circle[2] for a, f in zip(apart, found, strict=True)):
            found.append(one)
    if len(found) < 2:
        raise CalibrationError(
            f"{photographs.session.path}: {len(found)} mirror spheres found, and two are needed: "
            "put them before something bright, or say where they are in the picture"
        )
    return sorted(found, key=lambda one: one.circle[0])


def sphere_highlights(
    photographs: ArmPhotographs, spheres: Sequence[FoundSphere]
) -> list[SphereHighlights]:
    """The lamp's highlights on spheres under all poses.

    Parameters
    ----------
    photographs : ArmPhotographs
    spheres : sequence of FoundSphere

    Returns
    -------
    list of SphereHighlights
        Of those that show the lamp at six poses or more.

    Raises
    ------
    CalibrationError
        Fewer than two spheres do.
    """
    count = len(photographs.brackets)
    pixels = np.full((len(spheres), count, 2), np.nan)
    sigmas = np.full((len(spheres), count), np.nan)
    why: dict[str, int] = {}
    for number in range(count):
        picture = photographs.grey(photographs.radiance(number)[0])
        for index, one in enumerate(spheres):
            try:
                pixels[index, number], sigmas[index, number] = _highlight(
                    picture, one.circle, photographs.saturation
                )
            except CalibrationError as error:
                why[str(error)] = why.get(str(error), 0) + 1
    pixels += photographs.origin
    seen = np.isfinite(sigmas)
    kept = np.flatnonzero(seen.sum(axis=1) >= _LEAST_HIGHLIGHTS)
    if len(kept) < 2:
        often = max(why, key=lambda text: why[text], default="")
        raise CalibrationError(
            f"{photographs.session.path}: {len(kept)} of {len(spheres)} spheres show the lamp at "
            f"{_LEAST_HIGHLIGHTS} poses or more, and two are needed; most often: {often}"
        )
    return [
        SphereHighlights(
            spheres[n].sphere, pixels[n], float(np.sqrt(np.mean(sigmas[n][seen[n]] ** 2)))
        )
        for n in kept
    ]


def _check_inside(circle: Circle, shape: tuple[int, ...]) -> None:
    column, row, radius = circle
    rows, cols = shape[:2]
    largest = 0.5 * min(rows, cols)
    if not (0 <= column < cols and 0 <= row < rows and 0 < radius <= largest):
        raise CalibrationError(
            f"no sphere of {radius:g} pixels can be at column {column:g}, row {row:g}: pictures "
            f"have {cols} columns and {rows} rows; name its middle and its radius, {largest:g} at "
            "most, in pixels"
        )


def _discs(picture: NDArray[np.float32]) -> list[Circle]:
    """Candidates: dark spots as large as the circles about them, and circles of edges."""
    import cv2

    scale = min(1.0, _SEARCH_WIDTH / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    low, high = np.percentile(small, [1, 99])
    grey = np.clip((small - low) / max(high - low, 1e-12) * 255, 0, 255).astype(np.uint8)
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
    least, largest = max(_LEAST_RADIUS * scale, 4.0), _LARGEST_RADIUS * min(small.shape)
    found: list[Circle] = []
    for share in _DARKNESS:
        outlines, _ = cv2.findContours(
            (grey < 255 * share).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        for outline in outlines:
            (column, row), radius = cv2.minEnclosingCircle(outline)
            round_enough = cv2.contourArea(outline) > _ROUND * np.pi * radius**2
            if least < radius < largest and round_enough:
                found.append((column, row, radius))
    circles = cv2.HoughCircles(
        grey,
        cv2.HOUGH_GRADIENT_ALT,
        1.5,
        2 * least,
        param1=120,
        param2=0.7,
        minRadius=int(least),
        maxRadius=int(largest),
    )
    if circles is not None:
        found += [tuple(one[:3]) for one in circles.reshape(-1, circles.shape[-1]).tolist()]
    # Pixels are counted from their centres, before and after.
    return [((c + 0.5) / scale - 0.5, (r + 0.5) / scale - 0.5, k / scale) for c, r, k in found]


def _refined(
    picture: NDArray[np.float32],
    circle: Circle,
    lens: Lens,
    origin: tuple[int, int],
    radius_mm: float,
) -> tuple[float, FoundSphere]:
    """How bright it is over what is beside it, and the sphere."""
    for _ in range(2):
        edges = find_outline(picture, near=circle)
        if len(edges) < _LEAST_EDGES:
            raise CalibrationError(f"{len(edges)} edges of an outline stand out")
        middle = 0.5 * (np.percentile(edges, 2, axis=0) + np.percentile(edges, 98, axis=0))
        radius = float(np.median(np.hypot(*(edges - middle).T)))
        circle = float(middle[0]), float(middle[1]), radius
    sphere = sphere_from_outline(edges + origin, lens, radius_mm=radius_mm)
    if sphere.outline_px > _LARGEST_MISS_PX:
        raise CalibrationError(f"the edges miss a sphere's outline by {sphere.outline_px:.1f} px")
    rows, cols = np.indices(picture.shape, sparse=True)
    away = np.hypot(cols - circle[0], rows - circle[1]) / radius
    inside, beside = np.median(picture[away < 0.9]), np.median(picture[(away > 1.1) & (away < 1.4)])
    if not inside < _DARK * beside:
        raise CalibrationError("it is no darker than what is behind it")
    return float(inside / beside), FoundSphere(circle, sphere)


def _highlight(
    picture: NDArray[np.float32], circle: Circle, saturation: float
) -> tuple[NDArray[np.float64], float]:
    column, row, radius = circle
    first = [max(int(at - _MARGIN * radius), 0) for at in (column, row)]
    last = [int(at + _MARGIN * radius) + 2 for at in (column, row)]
    part = picture[first[1] : last[1], first[0] : last[0]]
    inside = column - first[0], row - first[1], radius
    pixel, sigma = find_highlight(part, inside=inside, saturation=saturation)
    return pixel + first, sigma
