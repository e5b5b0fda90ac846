"""What the demo's copy is off by: held against the simulated truth, which nothing else may see."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquisition.session import Session
from calibration.lamp import Lamp
from calibration.lens import compose, invert, transform
from devices.interfaces import ArmPose
from devices.simulated.rig import SimulatedRig
from devices.simulated.truth import truth_of
from fitting.digital_copy import DigitalCopy
from fitting.reflectance.lamp_table import LampTable
from workstation.demonstration import (
    HeightError,
    align_to_truth,
    measure_height_error,
    points_in_truth,
    rt_true_camera,
    true_geometry,
)
from workstation.processing import Processed
from workstation.report_maps import draw_map, percentiles
from workstation.report_page import Picture, Section, Table


@dataclass(frozen=True)
class DeclaredLamps:
    """The lamp of a simulated arm as it truly is, in the rig's frame."""

    rig: SimulatedRig

    def lamp(self, pose: ArmPose) -> Lamp:
        """The lamp at a pose, its intensity as the sensor's colours see it."""
        scene = self.rig.scene
        position = scene.arm.lamp_position(pose)
        axis = scene.lamp.axis(position, scene.arm)
        lamp = Lamp(position, axis, self._intensity(), scene.lamp.exponent)
        return lamp.transformed(invert(rt_true_camera(self.rig)))

    def _intensity(self) -> NDArray[np.float64]:
        scene = self.rig.scene
        sensor = scene.sensor
        # Sensor numbers per second that white paper gives which faces the lamp at its radius.
        numbers = sensor.rate_e_per_s * sensor.numbers_per_electron
        weights = sensor.weights(scene.lamp.colour).sum(axis=2).ravel()
        letters = "RGBG" if sensor.bayer is None else sensor.bayer.value
        of_letter = dict(zip(letters, weights, strict=True))
        colours = np.array([of_letter[letter] for letter in "RGB"])
        return np.asarray(math.pi * scene.arm.radius**2 * numbers * colours)


def declared_lamps(rig: SimulatedRig, photographs: Path) -> LampTable:
    """The true lamps at the poses of a session of photographs."""
    frames = Session.open(photographs).frames
    poses = dict.fromkeys(frame.arm_pose for frame in frames if frame.arm_pose is not None)
    return LampTable.of(DeclaredLamps(rig), poses)


@dataclass(frozen=True)
class DemoTruth:
    """The demo's copy against the truth.

    Attributes
    ----------
    heights : HeightError
        At the pose at which the copy fits the truth best.
    calibration_mm : float or None
        By which the rig's uncertainty lets heights err beside their noise; None where it has none.
    error_mm : (rows, cols) float32 array
        Height minus truth; NaN in gaps.
    baseline_error_mm, baseline_sigma_mm : float
    lamp_direction_deg : float
        Median angle between lamps and true lamps, from the canvas's middle.
    lamp_direction_predicted_deg : float or None
        What the light arm's calibration predicts for it; None where the lamps were declared.
    camera_mm : dict of str to float
        By how far each place of the camera was missed.
    """

    heights: HeightError
    calibration_mm: float | None
    error_mm: NDArray[np.float32]
    baseline_error_mm: float
    baseline_sigma_mm: float
    lamp_direction_deg: float
    lamp_direction_predicted_deg: float | None
    camera_mm: dict[str, float]

    @property
    def predicted_mm(self) -> float:
        """RMS error of heights that noise and calibration predict."""
        return math.hypot(self.heights.predicted_rms_mm, self.calibration_mm or 0.0)

    @property
    def ratio(self) -> float:
        """Observed over predicted RMS error of heights."""
        return self.heights.observed_rms_mm / self.predicted_mm

    def figures(self) -> dict[str, Any]:
        """Plain JSON values."""
        heights = self.heights
        return {
            "height_rms_mm": heights.observed_rms_mm,
            "height_rms_predicted_mm": self.predicted_mm,
            "height_rms_over_predicted": self.ratio,
            "height_bias_mm": heights.bias_mm,
            "z_spread": heights.spread,
            "texels_outside_canvas": heights.outside_canvas,
            "height_sigma_by_noise_mm": heights.predicted_rms_mm,
            "height_sigma_by_calibration_mm": self.calibration_mm,
            "baseline_error_mm": self.baseline_error_mm,
            "baseline_sigma_mm": self.baseline_sigma_mm,
            "lamp_direction_deg": self.lamp_direction_deg,
            "lamp_direction_predicted_deg": self.lamp_direction_predicted_deg,
            "camera_mm": self.camera_mm,
        }

    def _row_of_lamps(self) -> tuple[str, ...]:
        name, observed = "direction of the lamp, median", f"{self.lamp_direction_deg:.3f}°"
        predicted = self.lamp_direction_predicted_deg
        if predicted is None:
            return name, "", observed
        return name, f"{predicted:.3f}°", observed, _over(self.lamp_direction_deg, predicted)

    def section(self, copy: DigitalCopy) -> Section:
        """The part of the demo's report."""
        heights = self.heights
        um = 1000.0
        rows = (
            (
                "height, RMS",
                f"{um * self.predicted_mm:.1f} µm",
                f"{um * heights.observed_rms_mm:.1f} µm",
                f"{self.ratio:.2f}",
            ),
            ("spread of height errors over their standard errors", "1", f"{heights.spread:.2f}"),
            ("mean error of height", "0 µm", f"{um * heights.bias_mm:z.2f} µm"),
            (
                "baseline of camera and projector",
                f"{um * self.baseline_sigma_mm:.0f} µm",
                f"{um * self.baseline_error_mm:.0f} µm",
                _over(abs(self.baseline_error_mm), self.baseline_sigma_mm),
            ),
            self._row_of_lamps(),
            *(
                (f"place of the camera, {name}", "", f"{off:.2f} mm")
                for name, off in self.camera_mm.items()
            ),
            ("texels on the frame or beyond", "0", str(heights.outside_canvas)),
        )
        observed = um * np.abs(self.error_mm.astype(np.float64))
        predicted = um * np.sqrt(copy.height_field.variance.astype(np.float64))
        # One scale for both, which are to be compared.
        _, most = percentiles(copy, observed, (0.0, 98.0))
        scale = dict(colours="magma", span=(0.0, most))
        return Section(
            "Against the truth",
            "The painting was made by code, so its true shape is known. Nothing above this line "
            "has seen it; the copy was only turned and shifted to where it fits best.",
            tables=(Table(rows, ("", "predicted", "observed", "ratio")),),
            pictures=(
                Picture(
                    "Predicted standard error of the height, µm",
                    draw_map(copy, predicted, scale="standard error, µm", **scale),  # type: ignore[arg-type]
                ),
                Picture(
                    "Observed error of the height, µm, without its sign",
                    draw_map(copy, observed, scale="error, µm", **scale),  # type: ignore[arg-type]
                ),
            ),
        )


def measure_truth(
    done: Processed,
    rig: SimulatedRig,
    lamps: LampTable,
    *,
    lamp_direction_predicted_deg: float | None = None,
) -> DemoTruth:
    """Hold a processed demo against its rig; the last is the error of directions predicted."""
    copy = done.copy
    pose = align_to_truth(copy, rig)
    heights = measure_height_error(copy, rig, rt_true_canvas=pose)
    points = points_in_truth(copy, rig, pose)
    off = np.full(copy.height_field.shape, np.nan, np.float32)
    truth = truth_of(rig.scene)
    off[copy.height_field.mask] = points[:, 2] - truth.height_at(points[:, 0], points[:, 1])
    known = done.figures["calibration_uncertainty"]
    # From the rig's frame, that of the calibrated camera, to the true one.
    to_truth = compose(pose, invert(copy.height_field.rt_cam_canvas))
    baseline = float(np.linalg.norm(done.rig.rt_proj_cam[3:]))
    true_baseline = float(np.linalg.norm(true_geometry(rig).rt_proj_cam[3:]))
    return DemoTruth(
        heights,
        known["height_sigma_mm"] if isinstance(known, dict) else None,
        off,
        baseline - true_baseline,
        _baseline_sigma(done),
        _lamp_direction(rig, lamps, to_truth),
        lamp_direction_predicted_deg,
        _camera_places(done, rig, to_truth),
    )


def _baseline_sigma(done: Processed) -> float:
    covariance = done.rig.covariance
    if covariance is None:
        return 0.0
    along = done.rig.rt_proj_cam[3:] / np.linalg.norm(done.rig.rt_proj_cam[3:])
    return float(np.sqrt(along @ covariance[-3:, -3:] @ along))


def _lamp_direction(rig: SimulatedRig, lamps: LampTable, to_truth: NDArray[np.float64]) -> float:
    def directions(places: Iterable[NDArray[np.float64]]) -> NDArray[np.float64]:
        found = np.array(list(places))
        return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))

    found = directions(transform(to_truth, lamp.position) for lamp in lamps.lamps)
    true = directions(rig.scene.arm.lamp_position(pose) for pose in lamps.poses)
    # Of unit vectors by the chord between them: the arc cosine is useless near one.
    angles = 2 * np.arcsin(np.clip(np.linalg.norm(found - true, axis=1) / 2, 0, 1))
    return float(np.degrees(np.median(angles)))


def _camera_places(
    done: Processed, rig: SimulatedRig, to_truth: NDArray[np.float64]
) -> dict[str, float]:
    if done.photographs is None:
        return {}
    return {
        str(name): float(
            np.linalg.norm(
                transform(to_truth, view.position) - rig.scene.cameras[str(name)].position
            )
        )
        for name, view in done.photographs.views.get().items()
    }


def _over(observed: float, predicted: float) -> str:
    return f"{observed / predicted:.2f}" if predicted > 0 else ""
