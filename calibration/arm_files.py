"""A calibrated light arm as a file: JSON, with the covariance and what the fit left."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquisition.atomic_files import write_bytes
from calibration.arm_geometry import ArmParameters
from calibration.errors import CalibrationError
from calibration.light_arm import LightArm
from devices.interfaces import ArmPose

ARM_FILE = "light-arm.json"
FORMAT = "impasto-light-arm-1"
_NUMBERS = 17


def save_light_arm(arm: LightArm, path: Path) -> None:
    """Write an arm's calibration, whole or not at all."""
    fitted = arm.parameters
    content = {
        "format": FORMAT,
        "parameters": {
            "rt_rig_ring": fitted.rt_rig_ring.tolist(),
            "radius_mm": fitted.radius_mm,
            "elevation_zero": fitted.elevation_zero,
            "lean": fitted.lean,
            "sag": fitted.sag,
            "aim": fitted.aim.tolist(),
            "intensity": fitted.intensity.tolist(),
            "exponent": fitted.exponent,
        },
        "covariance": arm.covariance.tolist(),
        "poses": [[pose.azimuth, pose.elevation] for pose in arm.poses],
        "residual_deg": [_finite_or_none(r) for r in arm.residual_deg],
        "suspect": list(arm.suspect),
        "inflation": arm.inflation,
        "shading_excess": arm.shading_excess,
        "shading_misfit": _finite_or_none(arm.shading_misfit),
        "sphere_shift_sigmas": arm.sphere_shift_sigmas.tolist(),
        "radius_error": _finite_or_none(arm.radius_error),
        "radius_sigma": _finite_or_none(arm.radius_sigma),
        "matt": arm.matt,
        "placed_by_highlights": arm.placed_by_highlights,
    }
    write_bytes(Path(path), (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def load_light_arm(path: Path) -> LightArm:
    """Read an arm's calibration.

    Raises
    ------
    CalibrationError
        The file is missing, is none of an arm, or holds numbers that make no sense.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise CalibrationError(f"{path}: no such calibration of a light arm") from None
    except (OSError, ValueError) as error:
        raise CalibrationError(f"{path}: not a calibration of a light arm ({error})") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CalibrationError(f"{path}: not a calibration of a light arm of format {FORMAT!r}")
    try:
        arm = _arm(content)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise CalibrationError(f"{path}: {type(error).__name__}: {error}") from None
    variances, _ = np.linalg.eigh(arm.covariance)
    if not (variances > -1e-9 * max(float(variances[-1]), 1e-30)).all():
        raise CalibrationError(f"{path}: its covariance has negative variances")
    # Position, axis and intensity of a lamp are checked where one is made.
    arm.lamp(arm.poses[0])
    return arm


def _arm(content: dict[str, Any]) -> LightArm:
    given = content["parameters"]
    parameters = ArmParameters(
        rt_rig_ring=_array(given["rt_rig_ring"], (6,)),
        radius_mm=_positive(given["radius_mm"]),
        elevation_zero=_number(given["elevation_zero"]),
        lean=_number(given["lean"]),
        sag=_number(given["sag"]),
        aim=_array(given["aim"], (3,)),
        intensity=_array(given["intensity"], (3,)),
        exponent=_number(given["exponent"]),
    )
    poses = tuple(ArmPose(_number(a), _number(e)) for a, e in content["poses"])
    if not poses:
        raise ValueError("there is no pose")
    residual = np.array([np.nan if r is None else _number(r) for r in content["residual_deg"]])
    if len(residual) != len(poses):
        raise ValueError(f"{len(residual)} residuals of {len(poses)} poses")
    return LightArm(
        parameters,
        _array(content["covariance"], (_NUMBERS, _NUMBERS)),
        poses,
        residual,
        tuple(int(n) for n in content["suspect"]),
        _positive(content["inflation"]),
        _positive(content["shading_excess"]),
        # Files of before these were kept lack them.
        shading_misfit=_number_or_nan(content.get("shading_misfit")),
        sphere_shift_sigmas=np.array([_number(n) for n in content.get("sphere_shift_sigmas", ())]),
        radius_error=_number_or_nan(content.get("radius_error")),
        radius_sigma=_number_or_nan(content.get("radius_sigma")),
        matt=bool(content.get("matt", True)),
        placed_by_highlights=bool(content.get("placed_by_highlights", False)),
    )


def _finite_or_none(value: float) -> float | None:
    """JSON knows no NaN."""
    return float(value) if np.isfinite(value) else None


def _number(value: Any) -> float:
    number = float(value)
    if not np.isfinite(number):
        raise ValueError(f"{value} is not finite")
    return number


def _number_or_nan(value: Any) -> float:
    return float("nan") if value is None else _number(value)


def _positive(value: Any) -> float:
    number = _number(value)
    if not number > 0:
        raise ValueError(f"{value} is not positive")
    return number


def _array(value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = np.asarray(value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"an array of {shape} finite numbers was expected, not {array.shape}")
    return array
