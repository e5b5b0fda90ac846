"""Planning photographs under the light arm: from each place of the camera, under each light.

From every place the projected code comes first, by which a photograph is registered to the scan
(F. Larue, J.-M. Dischler, *Automatic Registration and Calibration for Efficient Surface Light Field
Acquisition*, VAST 2006). Frames without light follow, then the lamp at every pose with a bracket of
exposures each, and one pose again and again, which shows whether the lamp has drifted. A white
target and a colour chart are photographed from the first place, before the camera leaves it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from acquisition.errors import SessionError
from acquisition.light_poses import order_by_travel, spread_poses
from acquisition.patterns import Axis, Pattern
from acquisition.plan import Bracketing, Crop, Imager, Plan, PlannedFrame, Purpose
from acquisition.scan_plan import check_exposures, code_patterns
from devices.interfaces import ArmPose
from devices.rig import Rig

# A lamp that is switched on cold.
_WARM_UP_S = 120.0


@dataclass(frozen=True, kw_only=True)
class PhotographChoices:
    """What is to be photographed.

    Attributes
    ----------
    exposures_s : tuple of float
        The bracket of each light.
    code_exposures_s : tuple of float
        Exposures of the projected code.
    poses : int
        Number of poses of the lamp, spread evenly over what the arm reaches.
    least_elevation : float
        Of the lamp above the canvas, radians.
    camera_positions : tuple of str or None
        Places of the camera, in order; by default, all that the rig has.
    period_px, steps
        Of the fringes of the code.
    adaptive : bool
        Whether exposures that no pixel needs are left out.
    reference_every : int
        Poses after which the first pose is taken again.
    flat_target, colour_chart : bool
        Whether they are photographed: the target under every light, the chart under the first.
    warm_up_s : float or None
        By default two minutes with a real lamp, and none with a simulated one.
    """

    exposures_s: tuple[float, ...]
    code_exposures_s: tuple[float, ...]
    poses: int = 24
    least_elevation: float = 0.0
    camera_positions: tuple[str, ...] | None = None
    period_px: float = 24.0
    steps: int = 8
    adaptive: bool = True
    reference_every: int = 12
    flat_target: bool = False
    colour_chart: bool = False
    warm_up_s: float | None = None


def plan_photographs(rig: Rig, choices: PhotographChoices) -> Plan:
    """Plan photographs for a rig.

    Parameters
    ----------
    rig : Rig
        With camera, projector and light arm; it is asked what it is, and nothing moves.
    choices : PhotographChoices

    Returns
    -------
    Plan

    Raises
    ------
    SessionError
        What is asked for cannot be planned: no pose or exposure, a place named twice.
    DeviceError
        The rig lacks a device, a place of its camera, or the range for an exposure.
    """
    camera, projector = rig.camera.capabilities, rig.projector.capabilities
    check_exposures(choices.exposures_s)
    check_exposures(choices.code_exposures_s)
    for exposure in (*choices.exposures_s, *choices.code_exposures_s):
        camera.check_exposure(exposure)
    if choices.reference_every < 1:
        raise SessionError("the reference pose comes after one pose or more")
    limits = rig.arm.capabilities.limits
    poses = spread_poses(limits, choices.poses, least_elevation=choices.least_elevation)
    # Homing leaves the arm at its lower ends.
    home = ArmPose(limits.azimuth[0], limits.elevation[0])
    ordered = order_by_travel(poses, start=home)
    shots = _Shots(choices, ordered, projector.size)
    warm_up_s = choices.warm_up_s
    if warm_up_s is None:
        warm_up_s = 0.0 if rig.source == "simulation" else _WARM_UP_S
    return Plan(
        camera=Imager(width=camera.width, height=camera.height, mosaic=camera.bayer),
        projector=Imager(width=projector.width, height=projector.height),
        crop=Crop(column=0, row=0, width=camera.width, height=camera.height),
        saturation_level=camera.saturation_level,
        frames=tuple(shots.at_all(_places(rig, choices.camera_positions))),
        source=rig.source,
        bracketing=Bracketing() if choices.adaptive else None,
        lamp_warm_up_s=warm_up_s,
    )


def _places(rig: Rig, asked: tuple[str, ...] | None) -> Sequence[str | None]:
    there = rig.camera_positions
    if asked is None:
        return there or (None,)
    unknown = [name for name in asked if name not in there]
    if unknown:
        raise SessionError(
            f"the rig has no camera position {unknown[0]!r}; "
            + (f"there are {', '.join(there)}" if there else "name some in its [mount] table")
        )
    if not asked or len(set(asked)) < len(asked):
        raise SessionError("photographs need at least one camera position, and each only once")
    return asked


class _Shots:
    """Makes the frames of a plan, and numbers them."""

    def __init__(
        self, choices: PhotographChoices, poses: list[ArmPose], projector_size: tuple[int, int]
    ) -> None:
        self._choices = choices
        self._poses = poses
        self._patterns = code_patterns(
            projector_size,
            axes=(Axis.COLUMN, Axis.ROW),
            periods_px=(choices.period_px,),
            steps=choices.steps,
        )
        self._exposures = sorted(choices.exposures_s)
        self._number = 0
        self._bracket = 0

    def at_all(self, places: Sequence[str | None]) -> Iterator[PlannedFrame]:
        for number, place in enumerate(places):
            yield from self._code(place)
            for exposure in self._exposures:
                yield self._frame(Purpose.DARK, place, exposure)
            yield from self._photographs(place)
            if number == 0 and self._choices.colour_chart:
                yield from self._lit(Purpose.COLOUR_CHART, place, self._poses[0])
            if number == 0 and self._choices.flat_target:
                for pose in self._poses:
                    yield from self._lit(Purpose.FLAT_TARGET, place, pose)

    def _code(self, place: str | None) -> Iterator[PlannedFrame]:
        for pattern in self._patterns:
            for exposure in sorted(self._choices.code_exposures_s):
                yield self._frame(Purpose.CODE, place, exposure, pattern=pattern)

    def _photographs(self, place: str | None) -> Iterator[PlannedFrame]:
        reference, every = self._poses[0], self._choices.reference_every
        for number, pose in enumerate(self._poses):
            if number % every == 0:
                yield from self._lit(Purpose.REFERENCE_POSE, place, reference)
            yield from self._lit(Purpose.PHOTOGRAPH, place, pose)
        yield from self._lit(Purpose.REFERENCE_POSE, place, reference)

    def _lit(self, purpose: Purpose, place: str | None, pose: ArmPose) -> Iterator[PlannedFrame]:
        """A bracket under the lamp at one pose."""
        self._bracket += 1
        for exposure in self._exposures:
            yield self._frame(purpose, place, exposure, pose=pose, bracket=f"b{self._bracket:04d}")

    def _frame(
        self,
        purpose: Purpose,
        place: str | None,
        exposure_s: float,
        *,
        pattern: Pattern | None = None,
        pose: ArmPose | None = None,
        bracket: str | None = None,
    ) -> PlannedFrame:
        self._number += 1
        return PlannedFrame(
            id=f"{self._number - 1:04d}",
            pattern=pattern,
            exposure_s=exposure_s,
            purpose=purpose,
            arm_pose=pose,
            lamp_on=pose is not None,
            camera_position=place,
            bracket=bracket,
        )
