r"""Pairs of surface points and pixels that saw the same projector coordinates.

A pixel p of a photograph sees the coordinates q; where the scan saw the same, at the camera's pixel
c in one of its blocks, is the surface point :math:`X(c, q)`, triangulated (F. Larue, J.-M.
Dischler, *Automatic Registration and Calibration for Efficient Surface Light Field Acquisition*,
VAST 2006).

The noise of both recordings moves X: that of the photograph looks the surface up elsewhere, along
the surface, and that of the scan shifts c, along the projector's ray. Pixels are exact. Each block
of either picture is used once, so that the pairs' errors are independent; errors of the rig's
calibration, which all pairs share, are kept apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from acquisition.correspondence import CorrespondenceMap
from calibration.code_blocks import CodeBlocks, find_blocks
from calibration.rig_geometry import RigGeometry
from calibration.triangulation import depth_along_rays, usual_depth

_STEP_PX = 0.01


@dataclass(frozen=True)
class CodePairs:
    """Points of a scan and where a photograph sees them.

    Attributes
    ----------
    points : (n, 3) float64 array
        In the rig's frame, that of the scan's camera; mm.
    covariance : (n, 3, 3) float64 array
        Of the points, by the noise of both recordings; mm².
    pixels : (n, 2) float64 array
        Of the photograph, taken as exact.
    """

    points: NDArray[np.float64]
    covariance: NDArray[np.float64]
    pixels: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.points)

    def chosen(self, which: NDArray[np.generic]) -> CodePairs:
        """Some of the pairs, by index or mask."""
        return CodePairs(self.points[which], self.covariance[which], self.pixels[which])


def pair_by_code(
    photograph: CorrespondenceMap, scan: CorrespondenceMap, rig: RigGeometry
) -> CodePairs:
    """Pair surface points of a scan with pixels of a photograph's own code.

    Parameters
    ----------
    photograph, scan : CorrespondenceMap
        Decoded from where the photograph was taken, and from where the scan was; the projector
        stood still in between.
    rig : RigGeometry
        Of the scan.

    Returns
    -------
    CodePairs
        Perhaps none.

    Raises
    ------
    CalibrationError
        One of them was decoded along one axis only.
    """
    seen, known = find_blocks(photograph), find_blocks(scan)
    nothing = CodePairs(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 2)))
    if not len(seen) or not len(known):
        return nothing
    of_photo, of_scan = _nearest(seen, known)
    seen, known = seen.chosen(of_photo), known.chosen(of_scan)
    offset, slopes, variance = known.locate(seen.coordinates)
    here = np.isfinite(offset).all(axis=1)
    if not here.any():
        return nothing
    seen, known = seen.chosen(here), known.chosen(here)
    pixels, coordinates = known.pixels + offset[here], seen.coordinates
    inverse, variance = np.linalg.inv(slopes[here]), variance[here]
    start = usual_depth(rig, pixels, coordinates)

    def point(at: NDArray[np.float64], code: NDArray[np.float64]) -> NDArray[np.float64]:
        slopes = rig.camera.unproject(at)[..., :2]
        depth, _ = depth_along_rays(rig, slopes, code, variance, start_mm=start)
        return np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) * depth[:, np.newaxis]

    points = point(pixels, coordinates)
    along_c, along_q = np.empty((len(points), 3, 2)), np.empty((len(points), 3, 2))
    for axis, step in enumerate(np.eye(2) * _STEP_PX):
        along_c[..., axis] = (point(pixels + step, coordinates) - points) / _STEP_PX
        along_q[..., axis] = (point(pixels, coordinates + step) - points) / _STEP_PX
    by_scan = along_c @ inverse
    by_photo = by_scan + along_q
    covariance = _spread(by_scan, variance) + _spread(by_photo, seen.variance)
    good = np.isfinite(points).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    return CodePairs(points[good], covariance[good], seen.pixels[good])


def _nearest(seen: CodeBlocks, known: CodeBlocks) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Blocks of the photograph and of the scan next to one another on the panel, each once."""
    distance, nearest = cKDTree(known.coordinates).query(seen.coordinates)
    order = np.argsort(distance, kind="stable")
    _, first = np.unique(nearest[order], return_index=True)
    of_photo = np.sort(order[first])
    return of_photo, nearest[of_photo]


def _spread(lever: NDArray[np.float64], variance: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((lever * variance[:, np.newaxis]) @ np.swapaxes(lever, 1, 2))
