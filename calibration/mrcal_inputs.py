"""mrcal's optimiser, and the arrays that it takes and overwrites.

The modules whose names begin with ``mrcal_`` and :mod:`calibration.lens` are all that calls mrcal.
Its inputs are arrays that its optimiser overwrites, so each solve works on copies. Every
``do_optimize`` flag is in the inputs, without which the uncertainty cannot be had from them. Later
releases renamed two of the arrays; both names are understood. See mrcal's page "formulation".
"""

from __future__ import annotations

from typing import Any

import mrcal
import numpy as np
from numpy.typing import NDArray

from acquisition.plan import Imager
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.errors import CalibrationError
from calibration.lens_seeds import LensSeed
from calibration.view_seeds import relative_pose

# Names before mrcal 2.5, and since.
POSES = ("extrinsics_rt_fromref", "rt_cam_ref")
BOARDS = ("frames_rt_toref", "rt_ref_frame")
SPLINED = "LENSMODEL_SPLINED_STEREOGRAPHIC"
_STEPS = ("intrinsics_core", "intrinsics_distortions", "extrinsics", "frames", "calobject_warp")
_ROUNDS = 4


def inputs_of(
    views: list[BoardView], board: Chessboard, imagers: list[Imager], seeds: list[LensSeed]
) -> dict[str, Any]:
    """What mrcal starts from: guessed lenses and poses, and the corners that were seen.

    Parameters
    ----------
    views : list of BoardView
    board : Chessboard
    imagers : list of Imager
        Sizes of the lenses' imagers.
    seeds : list of LensSeed
        One per lens; the first is the reference.

    Raises
    ------
    CalibrationError
        A lens and the first have no view in common.
    """
    observations, indices = observations_of(views)
    first = seeds[0].rt_lens_board
    extrinsics = np.array([relative_pose(board, first, s.rt_lens_board) for s in seeds[1:]])
    new_names = hasattr(mrcal.cameramodel, "rt_cam_ref")
    return {
        "intrinsics": np.array([seed.core for seed in seeds]),
        POSES[new_names]: extrinsics.reshape(-1, 6),
        BOARDS[new_names]: first.copy(),
        "points": None,
        "observations_board": cleaned(observations),
        "indices_frame_camintrinsics_camextrinsics": indices,
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": "LENSMODEL_STEREOGRAPHIC" if seeds[0].wide else "LENSMODEL_PINHOLE",
        "imagersizes": np.array([[i.width, i.height] for i in imagers], np.int32),
        "calobject_warp": np.zeros(2),
        "calibration_object_spacing": float(board.square_mm),
        "verbose": False,
    }


def observations_of(
    views: list[BoardView],
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Corners as mrcal has them, and which view and lens each of their boards is of.

    Returns
    -------
    observations : (n, rows, columns, 3) float64 array
        Pixel and weight; 0, 0 and a weight of 0 where a corner was not seen.
    indices : (n, 3) int32 array
        View, lens, and pose of the lens, -1 for the first.
    """
    observations, indices = [], []
    for number, view in enumerate(views):
        for lens, (pixels, sigma) in enumerate(zip(view.pixels, view.sigma_px, strict=True)):
            seen = np.isfinite(pixels).all(axis=-1)
            if not seen.any():
                continue
            weight = np.where(seen, 1 / np.where(seen, sigma, 1.0), 0.0)
            observations.append(np.dstack([np.where(seen[..., None], pixels, 0.0), weight]))
            indices.append((number, lens, lens - 1))
    return np.array(observations), np.array(indices, np.int32)


def cleaned(observations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Observations (n, rows, columns, 3) with missing corners as mrcal has them: a weight of -1."""
    observations = np.ascontiguousarray(observations)
    observations[..., 2][observations[..., 2] == 0] = -1.0
    return observations


def seen_corners(observed: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which corners of an observation were seen: the others are at (0, 0), with a weight of -1."""
    return np.asarray((observed[..., 2] > 0) | observed[..., :2].any(axis=-1))


def indices_of(inputs: dict[str, Any]) -> NDArray[np.int32]:
    """View, lens and pose of the lens (n, 3) of every board that was seen."""
    return np.asarray(inputs["indices_frame_camintrinsics_camextrinsics"], np.int32)


def key_in(inputs: dict[str, Any], names: tuple[str, str]) -> str:
    """Which of two names an array has in the inputs of this release of mrcal."""
    return names[1] if names[1] in inputs else names[0]


def copied(inputs: dict[str, Any]) -> dict[str, Any]:
    """Inputs that may be overwritten."""
    return {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in inputs.items()}


def steps_of(inputs: dict[str, Any]) -> set[str]:
    """What the optimiser was asked to change."""
    return {step for step in _STEPS if inputs.get(f"do_optimize_{step}")}


def take_model(inputs: dict[str, Any], model: str) -> None:
    """Grow the lenses from their core to a model, in place.

    Raises
    ------
    CalibrationError
        mrcal has no such model.
    """
    try:
        extra = mrcal.lensmodel_num_params(model) - 4
    except Exception as error:  # mrcal raises bare Exceptions of its own
        raise CalibrationError(f"mrcal has no lens model {model!r} ({error})") from None
    lenses = len(inputs["intrinsics"])
    # Not zero: there the gradient of some models vanishes.
    grown = np.hstack([inputs["intrinsics"], np.full((lenses, extra), 1e-6)])
    inputs["intrinsics"], inputs["lensmodel"] = grown, model


def settle(inputs: dict[str, Any], steps: set[str], outlier_sigmas: float) -> None:
    """Solve, and leave out corners until those that are left agree, in place.

    Parameters
    ----------
    inputs : dict
    steps : set of str
        What is changed.
    outlier_sigmas : float
        Weighted residual, over the root mean square of all, beyond which a corner is left out;
        infinite keeps all.

    Raises
    ------
    CalibrationError
        As :func:`optimize`.
    """
    observations = inputs["observations_board"]
    for _ in range(_ROUNDS):
        optimize(inputs, steps)
        if not np.isfinite(outlier_sigmas):
            return
        _, x, _, _ = mrcal.optimizer_callback(**inputs, no_jacobian=True, no_factorization=True)
        distance = np.abs(x[: observations[..., :2].size].reshape(*observations.shape[:3], 2))
        kept = observations[..., 2] > 0
        rms = float(np.sqrt(np.mean(distance[kept] ** 2)))
        gross = kept & (distance.max(axis=-1) > outlier_sigmas * rms)
        if not gross.any():
            return
        observations[..., 2][gross] *= -1
    optimize(inputs, steps)


def optimize(inputs: dict[str, Any], steps: set[str], *, regularize: bool = True) -> None:
    """Optimise some of the variables, in place.

    Raises
    ------
    CalibrationError
        mrcal fails, or does not end in numbers.
    """
    for step in _STEPS:
        inputs[f"do_optimize_{step}"] = step in steps
    # The uncertainty wants this flag also where there is one lens and nothing to optimise.
    inputs["do_optimize_extrinsics"] = True
    # mrcal's own threshold drops hundreds of good corners of heavy-tailed detectors.
    inputs["do_apply_outlier_rejection"] = False
    inputs["do_apply_regularization"] = regularize and (
        "intrinsics_core" in steps or "intrinsics_distortions" in steps
    )
    try:
        mrcal.optimize(**inputs)
    except Exception as error:  # mrcal raises bare Exceptions of its own
        raise CalibrationError(
            f"the calibration cannot be solved ({error}); check that the board's corners are "
            "counted alike in every view, and that its tilt changes from view to view"
        ) from error
    for name in ("intrinsics", key_in(inputs, POSES), key_in(inputs, BOARDS)):
        if inputs[name] is not None and not np.isfinite(inputs[name]).all():
            raise CalibrationError(
                "the calibration does not converge; record the board at more tilts, and over all "
                "of the image"
            )
