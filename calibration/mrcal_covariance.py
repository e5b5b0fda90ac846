"""What a solve leaves uncertain, of parameters and of pixels; see mrcal's page "uncertainty"."""

from __future__ import annotations

import mrcal
import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.mrcal_inputs import copied
from calibration.mrcal_solution import LensSolution


def projection_covariance(
    solution: LensSolution, number: int, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Covariance of the pixels at which a lens sees points, as the calibration leaves it.

    ``mrcal.projection_uncertainty`` with the noise that the residuals show, corrected for the
    fitted parameters. The points are fixed to the boards, on the mean over all of their poses.

    Parameters
    ----------
    solution : LensSolution
    number : int
        Which lens.
    points : (..., 3) array
        In the lens's frame, mm.

    Returns
    -------
    (..., 2, 2) float64 array
        Square pixels.
    """
    model = mrcal.cameramodel(
        optimization_inputs=copied(solution.optimization_inputs), icam_intrinsics=number
    )
    points = np.ascontiguousarray(points, np.float64)
    try:
        covariance = mrcal.projection_uncertainty(
            points, model, what="covariance", observed_pixel_uncertainty=solution.sigma0
        )
    except Exception as error:  # mrcal raises bare Exceptions of its own
        raise CalibrationError(
            f"the uncertainty cannot be computed ({error}); the views do not determine the lens"
        ) from error
    return np.asarray(covariance)


def parameter_covariance(solution: LensSolution) -> NDArray[np.float64]:
    """Covariance of the lenses' parameters and poses, board poses marginalised.

    Noise of the corners is propagated through the solve with regularisation (mrcal's page
    "uncertainty"). A parameter that was not optimised has no variance.

    Returns
    -------
    (n, n) float64 array
        In the order: parameters of each lens, then the pose of each lens but the first.

    Raises
    ------
    CalibrationError
        The views do not determine the parameters.
    """
    inputs = solution.optimization_inputs
    _, _, jacobian, factorization = mrcal.optimizer_callback(**inputs)
    if factorization is None:
        raise CalibrationError("the views do not determine the lenses; record more tilts")
    states, places = _states(solution)
    unit = np.zeros((len(states), jacobian.shape[1]))
    unit[np.arange(len(states)), states] = 1.0
    scale = np.ones(jacobian.shape[1])
    mrcal.unpack_state(scale, **inputs)
    rows = mrcal.num_measurements_boards(**inputs)
    solved = factorization.solve_xt_JtJ_bt(unit) * scale[states][:, np.newaxis]
    noise = jacobian[:rows] @ solved.T
    total = sum(len(lens.intrinsics) for lens in solution.lenses) + 6 * (len(solution.lenses) - 1)
    covariance = np.zeros((total, total))
    covariance[np.ix_(places, places)] = solution.sigma0**2 * (noise.T @ noise)
    return covariance


def _states(solution: LensSolution) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Indices of the lenses' parameters in mrcal's state, and in :func:`parameter_covariance`."""
    inputs = solution.optimization_inputs
    states: list[int] = []
    places: list[int] = []
    start = 0
    first = 0 if inputs["do_optimize_intrinsics_core"] else 4
    for number, lens in enumerate(solution.lenses):
        index = mrcal.state_index_intrinsics(number, **inputs)
        count = len(lens.intrinsics) - first
        states += range(index, index + count)
        places += range(start + first, start + first + count)
        start += len(lens.intrinsics)
    for number in range(len(solution.lenses) - 1):
        index = mrcal.state_index_extrinsics(number, **inputs)
        states += range(index, index + 6)
        places += range(start, start + 6)
        start += 6
    return np.array(states), np.array(places)
