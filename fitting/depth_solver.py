"""Depth along viewing rays from what is seen of the projector, through any lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.patterns import Axis
from calibration.lens import Lens, rotation
from calibration.rig_geometry import RigGeometry
from fitting.triangulation_kernels import solve_depths

AXES = (Axis.COLUMN, Axis.ROW)
CUBIC_TERMS = 10
_ITERATIONS = 8


@dataclass(frozen=True)
class PanelSightings:
    """Projector coordinates of n pixels, and the rays on which the pixels look.

    Attributes
    ----------
    slopes : (n, 2) float64 array
        x/z and y/z of the viewing rays.
    coordinates : pair of (n,) float64 arrays
        Projector column and row; empty for an axis that was not decoded.
    variances : pair of (n,) float32 arrays
        Of the coordinates, in square pixels.
    """

    slopes: NDArray[np.float64]
    coordinates: tuple[NDArray[np.float64], NDArray[np.float64]]
    variances: tuple[NDArray[np.float32], NDArray[np.float32]]

    def __len__(self) -> int:
        return len(self.slopes)

    @classmethod
    def of(cls, correspondence: CorrespondenceMap, camera: Lens) -> PanelSightings:
        """What every pixel of a correspondence map saw, in the order of the picture."""
        slopes = camera.pixel_slopes(origin=correspondence.origin, shape=correspondence.shape)
        return cls._seen(slopes.reshape(-1, 2), correspondence, slice(None))

    @classmethod
    def of_rays(
        cls,
        slopes: NDArray[np.float64],
        correspondence: CorrespondenceMap,
        index: NDArray[np.intp],
    ) -> PanelSightings:
        """What some pixels saw, by their index in the picture, along rays (n, 2) of their own."""
        slopes = np.ascontiguousarray(slopes)
        slopes.setflags(write=False)
        return cls._seen(slopes, correspondence, index)

    @classmethod
    def _seen(
        cls,
        slopes: NDArray[np.float64],
        correspondence: CorrespondenceMap,
        which: NDArray[np.intp] | slice,
    ) -> PanelSightings:
        coordinates, variances = [], []
        for axis in AXES:
            decoded = correspondence.axes.get(axis)
            if decoded is None:
                coordinates.append(np.zeros(0))
                variances.append(np.zeros(0, np.float32))
            else:
                coordinates.append(_flat(decoded.coordinate, np.float64)[which])
                variances.append(_flat(decoded.variance, np.float32)[which])
        return cls(slopes, (coordinates[0], coordinates[1]), (variances[0], variances[1]))

    def take(self, index: NDArray[np.intp]) -> PanelSightings:
        """The sightings of some pixels."""
        slopes = self.slopes[index]
        # One layout of every argument keeps one compiled kernel.
        slopes.setflags(write=False)
        column, row = (c[index] if len(c) else c for c in self.coordinates)
        column_variance, row_variance = (v[index] if len(v) else v for v in self.variances)
        return PanelSightings(slopes, (column, row), (column_variance, row_variance))

    def only(self, axis: int) -> PanelSightings:
        """The same without the other axis."""
        nothing, no_variance = np.zeros(0), np.zeros(0, np.float32)
        keep = axis == 0
        return PanelSightings(
            self.slopes,
            (self.coordinates[0], nothing) if keep else (nothing, self.coordinates[1]),
            (self.variances[0], no_variance) if keep else (no_variance, self.variances[1]),
        )

    def moved(self, column_px: float, row_px: float) -> PanelSightings:
        """The same with the coordinates moved on the panel."""
        column, row = self.coordinates
        return PanelSightings(self.slopes, (column + column_px, row + row_px), self.variances)


def _flat(values: NDArray[np.floating], kind: type) -> NDArray[np.floating]:
    return np.ascontiguousarray(values, dtype=kind).reshape(-1)


@dataclass(frozen=True)
class PanelCorrection:
    """What is added to one projector coordinate: a cubic of the viewing ray.

    Attributes
    ----------
    axis : int
        0 for the column, 1 for the row, -1 for neither.
    cubic : (10,) float64 array
        Coefficients in the order of :func:`cubic_terms`, projector pixels.
    """

    axis: int
    cubic: NDArray[np.float64]

    @classmethod
    def none(cls) -> PanelCorrection:
        """Nothing added."""
        return cls(-1, np.zeros(CUBIC_TERMS))


def cubic_terms(slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 10) terms of a cubic in x and y of rays (n, 2), x slowest."""
    x, y = slopes[:, 0], slopes[:, 1]
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)


@dataclass(frozen=True)
class Depths:
    """Solution of n pixels.

    Attributes
    ----------
    depth : (n,) float64 array
        z in mm; NaN where there is none in front of both devices.
    variance : (n,) float32 array
        Of the depth, mm²; infinite where there is none.
    misfit : (n,) float32 array
        Distance on the panel that the depth leaves, pixels.
    """

    depth: NDArray[np.float64]
    variance: NDArray[np.float32]
    misfit: NDArray[np.float32]


def solve(sightings: PanelSightings, rig: RigGeometry, correction: PanelCorrection) -> Depths:
    r"""Depth by weighted least squares over the coordinates that were decoded.

    Gauss-Newton in the depth z through both lenses, with
    :math:`\sigma_z^{-2} = \sum_i (\partial u_i/\partial z)^2 / \sigma_i^2`.
    """
    lens = rig.projector.opencv_parameters
    if lens is None:
        return _solve_any_lens(sightings, rig, correction)
    return Depths(
        *solve_depths(
            lens,
            rotation(rig.rt_proj_cam),
            np.ascontiguousarray(rig.rt_proj_cam[3:]),
            sightings.slopes,
            *sightings.coordinates,
            *sightings.variances,
            correction.cubic,
            correction.axis,
        )
    )


def panel_points(
    slopes: NDArray[np.float64], depth: NDArray[np.float64], rig: RigGeometry
) -> NDArray[np.float64]:
    """Projector pixels (n, 2) of points at given depths along the rays; NaN without a depth."""
    rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
    points = depth[:, np.newaxis] * (rays @ rotation(rig.rt_proj_cam).T) + rig.rt_proj_cam[3:]
    there = np.isfinite(points).all(axis=1)
    pixels = rig.projector.project(np.where(there[:, np.newaxis], points, 1.0))
    return np.where(there[:, np.newaxis], pixels, np.nan)


def _solve_any_lens(
    sightings: PanelSightings, rig: RigGeometry, correction: PanelCorrection
) -> Depths:
    """The same through whatever the lens itself computes, one array operation at a time."""
    count = len(sightings)
    observed, weight = np.zeros((count, 2)), np.zeros((count, 2))
    for axis in (0, 1):
        if len(sightings.coordinates[axis]):
            observed[:, axis] = sightings.coordinates[axis]
            weight[:, axis] = 1.0 / sightings.variances[axis]
    if correction.axis >= 0:
        observed[:, correction.axis] += cubic_terms(sightings.slopes) @ correction.cubic
    rays = np.concatenate([sightings.slopes, np.ones((count, 1))], axis=1)
    turned = rays @ rotation(rig.rt_proj_cam).T
    shift = rig.rt_proj_cam[3:]
    focal, centre = rig.projector.intrinsics[:2], rig.projector.intrinsics[2:4]
    slope = (observed - centre) / focal
    by_depth = turned[:, :2] - slope * turned[:, 2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = -(weight * by_depth * (shift[:2] - slope * shift[2])).sum(axis=1)
        depth /= (weight * by_depth**2).sum(axis=1)
        for _ in range(_ITERATIONS):
            points = depth[:, np.newaxis] * turned + shift
            depth = np.where((depth > 0) & (points[:, 2] > 0), depth, np.nan)
            pixels, gradient = rig.projector.project_with_gradient(points)
            by_depth = np.einsum("nij,nj->ni", gradient, turned)
            information = (weight * by_depth**2).sum(axis=1)
            step = (weight * by_depth * (observed - pixels)).sum(axis=1) / information
            depth = depth + step
            if np.nanmax(np.abs(step / depth), initial=0.0) < 1e-10:
                break
        left = np.where(weight > 0, observed - pixels, 0.0)
    there = np.isfinite(depth)
    return Depths(
        depth,
        np.where(there, 1 / information, np.inf).astype(np.float32),
        np.where(there, np.linalg.norm(left, axis=1), np.inf).astype(np.float32),
    )
