"""What is said of a calibration in a few lines, and what to be warned of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from workstation.light_calibration import CalibratedLights
from workstation.rig_calibration import CalibratedRig


@dataclass(frozen=True)
class Messages:
    """Lines for the operator."""

    said: tuple[str, ...]
    warnings: tuple[str, ...]


def messages_on_rig(done: CalibratedRig) -> Messages:
    """On camera and projector."""
    calibration = done.calibration
    solution = calibration.solution
    said = [
        f"{len(calibration.views)} poses, {int(solution.inliers.sum())} corners, "
        f"{calibration.rig.camera.model}: {solution.rms_per_point_px:.3f} px per point at "
        f"{calibration.working_distance_mm:.0f} mm"
    ]
    if done.heights is not None:
        said.append(
            f"heights by this calibration are uncertain by {1000 * done.heights.rms_mm:.1f} µm "
            f"about their plane, lengths by {100 * done.heights.scale_sigma:.3f} %"
        )
    warnings = [f"{pose.name} was left out: {pose.why}" for pose in done.poses.unread]
    warnings += [f"left out {corner}" for corner in calibration.rejected_corners]
    warnings += [f"{v.gate}: {v.remedy}" for v in done.gates.failures if not v.refuses]
    return Messages(tuple(said), tuple(warnings))


def messages_on_lights(lights: CalibratedLights) -> Messages:
    """On the light arm."""
    arm, sigma = lights.arm, lights.direction_sigma_deg()
    residuals = arm.residual_deg[np.isfinite(arm.residual_deg)]
    said = (
        f"light arm from {len(lights.spheres)} spheres, {len(arm.poses)} poses: highlights off by "
        f"{np.sqrt(np.mean(residuals**2)):.2f}° RMS, directions known to {np.median(sigma):.3f}° "
        f"({sigma.max():.3f}° at worst)"
    )
    warnings = []
    for number in arm.suspect:
        azimuth, elevation = np.degrees([arm.poses[number].azimuth, arm.poses[number].elevation])
        warnings.append(
            f"the highlights at azimuth {azimuth:.1f}°, elevation {elevation:.1f}° are off by more "
            "than noise explains"
        )
    if arm.inflation > 1:
        warnings.append(
            "highlights are off by more than noise explains at all poses: the arm sags in another "
            "way than the model's, has play, or a sphere was loose"
        )
    if arm.shading_excess > 1:
        warnings.append(
            "the white target is no matt one, or the lamp falls off by another law than a power of "
            "the cosine; where the lamp is was told by the highlights"
        )
    return Messages((said,), tuple(warnings))
