"""How long a plan takes: exposures, readout, travel of the arm, people who move things.

An estimate for planning a day, from what the devices say of themselves; while a recording runs, the
time left comes from its own pace.
"""

from __future__ import annotations

from dataclasses import dataclass

from acquisition.light_poses import travel
from acquisition.plan import Plan, Purpose
from devices.interfaces import ArmCapabilities, ArmPose

# Reading out, checking, compressing and writing a frame.
_FRAME_S = 0.15
# Until a lamp that was switched on is steady.
_LAMP_S = 0.5
_HOMING_S = 30.0
# Somebody moves the camera, or puts a target up and takes it away.
_BY_HAND_S = 120.0


@dataclass(frozen=True)
class Duration:
    """Seconds that a plan takes, by what they go into.

    Attributes
    ----------
    frames_s : float
        Exposures and everything else that each frame costs.
    light_s : float
        The arm's travel, and its lamp's warm-up.
    by_hand_s : float
        Moves of the camera and targets.
    """

    frames_s: float
    light_s: float
    by_hand_s: float

    @property
    def total_s(self) -> float:
        """All of it."""
        return self.frames_s + self.light_s + self.by_hand_s


def estimate_duration(
    plan: Plan, *, frame_period_s: float = 0.0, arm: ArmCapabilities | None = None
) -> Duration:
    """Time that a plan takes at most: brackets are reckoned whole.

    Parameters
    ----------
    plan : Plan
    frame_period_s : float
        Of the projector, which shows a pattern for two periods before it is there.
    arm : ArmCapabilities, optional
        For its speed; a plan without poses needs none.
    """
    frames_s = sum(
        (frame.exposure_s or 0.0) + _FRAME_S + (2 * frame_period_s if frame.pattern else 0.0)
        for frame in plan.frames
    )
    poses: list[ArmPose] = []
    for frame in plan.frames:
        if frame.arm_pose is not None and (not poses or frame.arm_pose != poses[-1]):
            poses.append(frame.arm_pose)
    light_s = 0.0
    if poses and arm is not None:
        home = ArmPose(arm.limits.azimuth[0], arm.limits.elevation[0])
        light_s = _HOMING_S + travel(poses, start=home) / arm.speed + _LAMP_S * len(poses)
        light_s += plan.lamp_warm_up_s
    targets = {f.purpose for f in plan.frames} & {Purpose.FLAT_TARGET, Purpose.COLOUR_CHART}
    moves = max(0, len(plan.camera_positions) - 1) + len(targets)
    return Duration(frames_s, light_s, moves * _BY_HAND_S)
