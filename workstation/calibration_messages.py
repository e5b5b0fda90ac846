"""What is said of a calibration in a few lines, and what to be warned of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acquisition.session_mosaic import warning_of_colours
from calibration.gate_limits import Gate
from calibration.verdicts import GateReport
from workstation.light_calibration import CalibratedLights
from workstation.rig_calibration import CalibratedRig
from workstation.surface_figures import surface_figures, surface_sentences


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
    figures = surface_figures(calibration)
    if figures is not None:
        said += surface_sentences(figures)
    if done.poses.unread:
        total = len(done.poses.unread) + len(done.poses.views)
        said.append(f"in {len(done.poses.unread)} of {total} sessions no board was measured")
    said += _on_gates(done.gates)
    warnings = [f"{pose.name} was left out: {pose.why}" for pose in done.poses.unread]
    warnings += [f"left out {corner}" for corner in calibration.rejected_corners]
    warnings += [
        f"{pose.name} was held out, but not reconstructed: {pose.why}"
        for pose in done.unreconstructed
    ]
    # What the views' gate would say stands above, view by view.
    warnings += [
        f"{v.gate}: {v.remedy}"
        for v in done.gates.failures
        if not (v.refuses or v.gate == Gate.VIEWS)
    ]
    warnings += [f"{v.name} was left out: {v.why}" for v in calibration.rejected_views]
    return Messages(tuple(said), tuple(warnings))


def _on_gates(gates: GateReport) -> list[str]:
    if not gates.not_tested:
        return []
    return [f"not tested: {'; '.join(map(str, gates.not_tested))}"]


def messages_on_lights(lights: CalibratedLights) -> Messages:
    """On the light arm."""
    arm, sigma = lights.arm, lights.direction_sigma_deg()
    residuals = arm.residual_deg[np.isfinite(arm.residual_deg)]
    said = (
        f"light arm from {len(lights.spheres)} spheres, {len(arm.poses)} poses: highlights off by "
        f"{np.sqrt(np.mean(residuals**2)):.2f}° RMS, directions known to {np.median(sigma):.3f}° "
        f"({sigma.max():.3f}° at worst)"
    )
    warnings = [f"{v.gate}: {v.remedy}" for v in lights.gates.failures if not v.refuses]
    grey = warning_of_colours(lights.white.session, lights.white.mosaic)
    if grey is not None:
        warnings.append(grey)
    if arm.shading_excess > 1 and arm.placed_by_highlights:
        warnings.append(
            f"the white target's radiance is off by {arm.shading_misfit:.1%} from what a lamp that "
            "falls off by a power of the cosine would make of it, and contradicts the highlights; "
            "where the lamp is was told by these alone"
        )
    return Messages((said, *_on_gates(lights.gates)), tuple(warnings))
