r"""The Cramér–Rao bound of a photograph's pose, of the surface that benchmarks register on.

Every pixel of scan and photograph measures the projector's coordinates there with independent
noise; the surface is unknown. A pixel of the photograph then is off its surface point by a
covariance :math:`C_p + C_s\,\rho_p/\rho_s`: its own noise, and that of the scan's pixels on as much
of the surface, with :math:`\rho` pixels per area. No unbiased pose errs less than by
:math:`(\sum J^T C^{-1} J)^{-1}`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.lens import Lens, rotation, transform
from calibration.pose_fit import pose_derivative
from calibration.triangulation import depth_along_rays
from workstation.benchmarks.simulated_photographs import (
    DISTANCE_MM,
    RIG,
    SIGMA_PX,
    noiseless,
)

_STEP_PX = 0.01
_EVERY = 3
_PANEL = np.array([RIG.projector.width, RIG.projector.height])


def pose_bound(
    lens: Lens, rt_cam_rig: NDArray[np.float64], *, free_lens: bool = False
) -> NDArray[np.float64]:
    """Least covariance (6, 6) of a small turn (rad) and shift (mm) of a photograph's camera.

    Parameters
    ----------
    lens : Lens
        Of the photograph.
    rt_cam_rig : (6,) array
    free_lens : bool
        Whether the lens's parameters are unknown too.
    """
    points, code = noiseless(lens, rt_cam_rig)
    _, known = noiseless(RIG.camera, np.zeros(6))
    slopes, of_scan = (np.stack(np.gradient(q)[1::-1], axis=-1) for q in (code, known))
    some = np.s_[_EVERY // 2 :: _EVERY, _EVERY // 2 :: _EVERY]
    points, code = points[some].reshape(-1, 3), code[some].reshape(-1, 2)
    slopes = slopes[some].reshape(-1, 2, 2)
    pixels = RIG.camera.project(points)
    size = np.array([RIG.camera.width, RIG.camera.height])
    shared = ((pixels > 1) & (pixels < size - 2)).all(axis=1)
    shared &= ((code > -0.5) & (code < _PANEL - 0.5)).all(axis=1)
    pixels, code, slopes = pixels[shared], code[shared], slopes[shared]
    column, row = np.round(pixels).astype(int).T
    of_scan = of_scan[row, column]

    def point(at: NDArray[np.float64], seen: NDArray[np.float64]) -> NDArray[np.float64]:
        rays = RIG.camera.unproject(at)
        depth, _ = depth_along_rays(
            RIG, rays[:, :2], seen, np.full(seen.shape, SIGMA_PX**2), start_mm=DISTANCE_MM
        )
        return rays * depth[:, np.newaxis]

    at, steps = point(pixels, code), np.eye(2) * _STEP_PX
    along_c = np.stack([(point(pixels + s, code) - at) / _STEP_PX for s in steps], axis=-1)
    along_q = np.stack([(point(pixels, code + s) - at) / _STEP_PX for s in steps], axis=-1)
    by_scan = along_c @ np.linalg.inv(of_scan)
    by_photo = by_scan + along_q
    # Pixels per area of the panel, the photograph's over the scan's.
    density = np.abs(np.linalg.det(of_scan) / np.linalg.det(slopes))[:, np.newaxis, np.newaxis]
    spread = by_photo @ np.swapaxes(by_photo, 1, 2)
    spread = SIGMA_PX**2 * (spread + density * (by_scan @ np.swapaxes(by_scan, 1, 2)))
    seen = transform(rt_cam_rig, at)
    lever = lens.project_with_gradient(seen)[1] @ rotation(rt_cam_rig)
    weight = np.linalg.inv(lever @ spread @ np.swapaxes(lever, 1, 2))
    by_pose = pose_derivative(lens, seen, free_lens=free_lens)
    normal = np.einsum("nip,nij,njq->pq", by_pose, weight, by_pose, optimize=True) * _EVERY**2
    scale = np.sqrt(np.diagonal(normal))
    bound = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(bound[:6, :6])
