"""The lamp at each pose of its arm, as a file: what reflectance needs of a light arm's calibration.

A JSON list of lamps in the rig's frame, with angles in degrees. Any calibration of an arm can write
it, and so can a dome whose lamps were surveyed by other means.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.atomic_files import write_bytes
from calibration.errors import CalibrationError
from calibration.flat_field import FlatField
from calibration.lamp import Lamp
from devices.interfaces import ArmPose
from fitting.errors import FittingError
from fitting.reflectance.recorded_photographs import LampPoses

FORMAT = "impasto-lamps-1"
_SAME_POSE = math.radians(0.01)


@dataclass(frozen=True)
class LampTable:
    """Lamps by the pose of their arm.

    Attributes
    ----------
    poses : tuple of ArmPose
    lamps : tuple of Lamp
        In the rig's frame, that of the scan's camera.
    flat_field : FlatField or None
        Vignetting of the camera by which the lamps' intensities were measured: it was divided out
        there, and is to be divided out of what is compared with them.
    """

    poses: tuple[ArmPose, ...]
    lamps: tuple[Lamp, ...]
    flat_field: FlatField | None = None

    @classmethod
    def of(
        cls, arm: LampPoses, poses: Iterable[ArmPose], *, flat_field: FlatField | None = None
    ) -> LampTable:
        """The lamps of a calibrated arm at some poses."""
        chosen = tuple(poses)
        return cls(chosen, tuple(arm.lamp(pose) for pose in chosen), flat_field)

    def lamp(self, pose: ArmPose) -> Lamp:
        """The lamp at a pose.

        Raises
        ------
        FittingError
            The pose is none of the table's.
        """
        for known, lamp in zip(self.poses, self.lamps, strict=True):
            off = abs((known.azimuth - pose.azimuth + math.pi) % (2 * math.pi) - math.pi)
            if max(off, abs(known.elevation - pose.elevation)) < _SAME_POSE:
                return lamp
        raise FittingError(
            f"no lamp is known at azimuth {math.degrees(pose.azimuth):.2f}°, elevation "
            f"{math.degrees(pose.elevation):.2f}°: the table has {len(self.poses)} other poses; "
            "calibrate the light arm with the photographs' own poses"
        )

    def save(self, path: Path) -> None:
        """Write the table."""
        rows = [
            {
                "azimuth_deg": math.degrees(pose.azimuth),
                "elevation_deg": math.degrees(pose.elevation),
                "position_mm": lamp.position.tolist(),
                "axis": lamp.axis.tolist(),
                "intensity": lamp.intensity.tolist(),
                "exponent": lamp.exponent,
            }
            for pose, lamp in zip(self.poses, self.lamps, strict=True)
        ]
        content: dict[str, Any] = {"format": FORMAT, "lamps": rows}
        field = self.flat_field
        if field is not None:
            content["vignetting"] = {
                "centre": field.centre.tolist(),
                "coefficients": field.coefficients.tolist(),
                "covariance": field.covariance.tolist(),
                "width": field.width,
                "height": field.height,
            }
        write_bytes(Path(path), (json.dumps(content, indent=1) + "\n").encode())

    @classmethod
    def load(cls, path: Path) -> LampTable:
        """Read a table.

        Raises
        ------
        FittingError
            The file is missing, is no table of lamps, or a lamp in it makes no sense.
        """
        try:
            content = json.loads(Path(path).read_text())
        except FileNotFoundError:
            raise FittingError(f"{path}: no such table of lamps") from None
        except (OSError, ValueError) as error:
            raise FittingError(f"{path}: not a table of lamps ({error})") from None
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise FittingError(f"{path}: not a table of lamps of format {FORMAT!r}")
        rows = content.get("lamps")
        poses, lamps = [], []
        for number, row in enumerate(rows if isinstance(rows, list) else [], start=1):
            try:
                poses.append(
                    ArmPose(math.radians(row["azimuth_deg"]), math.radians(row["elevation_deg"]))
                )
                lamps.append(
                    Lamp(row["position_mm"], row["axis"], row["intensity"], row["exponent"])
                )
            except (KeyError, TypeError, ValueError, CalibrationError) as error:
                raise FittingError(f"{path}, lamp {number}: {error}") from None
        if not poses:
            raise FittingError(f"{path}: the table holds no lamp")
        try:
            field = _vignetting(content.get("vignetting"))
        except (KeyError, TypeError, ValueError) as error:
            raise FittingError(f"{path}, vignetting: {error}") from None
        return cls(tuple(poses), tuple(lamps), field)


def _vignetting(given: dict[str, Any] | None) -> FlatField | None:
    if given is None:
        return None
    arrays = [
        np.asarray(given[name], np.float64) for name in ("centre", "coefficients", "covariance")
    ]
    if [a.shape for a in arrays] != [(2,), (3,), (3, 3)] or not all(
        np.isfinite(a).all() for a in arrays
    ):
        raise ValueError("a centre, three coefficients and their covariance are finite numbers")
    width, height = int(given["width"]), int(given["height"])
    return FlatField.of_vignetting(*arrays, width=width, height=height)
