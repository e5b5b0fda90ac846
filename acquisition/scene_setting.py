"""Setting the scene for a planned frame: camera, target, light arm, lamp and projector.

Whatever moves, moves in the dark. What stands as it should already is left alone, so that a bracket
costs one move of the arm.
"""

from __future__ import annotations

from collections.abc import Callable

from acquisition.patterns import describe, pattern_image
from acquisition.plan import Plan, PlannedFrame, Purpose
from devices.errors import DeviceError
from devices.interfaces import ArmPose, Projection
from devices.rig import Rig

_TARGETS = {Purpose.FLAT_TARGET: "flat white target", Purpose.COLOUR_CHART: "colour chart"}


class SceneSetter:
    """Makes a rig's scene what a planned frame is to be a picture of.

    Parameters
    ----------
    plan : Plan
    rig : Rig
    confirm : callable
        Asks the person at the desk to do something; true once it is done.
    wait : callable
        Waits for some seconds.
    """

    def __init__(
        self,
        plan: Plan,
        rig: Rig,
        *,
        confirm: Callable[[str], bool],
        wait: Callable[[float], None],
    ) -> None:
        self._plan = plan
        self._rig = rig
        self._confirm = confirm
        self._wait = wait
        # What the rig was told, not what it says of itself, which is rounded to the arm's steps.
        self._pose: ArmPose | None = None
        self._position: str | None = None
        self._target: str | None = None
        self._warm = False

    def set_for(self, planned: PlannedFrame) -> None:
        """Set the scene; returns once everything stands still and is lit as planned.

        Raises
        ------
        DeviceError
            A device failed, or nobody confirmed that a target was put up or taken away.
        """
        self._place_camera(planned.camera_position)
        self._put_target(_TARGETS.get(planned.purpose))
        if planned.pattern is None:
            self._blank()
        self._move_light(planned.arm_pose)
        self._switch_lamp(planned.lamp_on)
        if planned.pattern is not None:
            panel = self._rig.projector.capabilities
            image = pattern_image(
                planned.pattern,
                width=panel.width,
                height=panel.height,
                response=self._plan.response,
            )
            self._rig.show(Projection(f"{planned.id} {describe(planned.pattern)}", image))

    def _place_camera(self, position: str | None) -> None:
        if position is None or position == self._position:
            return
        self._rig.place_camera(position)
        self._position = position

    def _put_target(self, target: str | None) -> None:
        if target == self._target:
            return
        self._blank()
        self._switch_lamp(False)
        if self._target is not None:
            self._ask(f"Take the {self._target} away.", f"the {self._target} is away")
            self._target = None
        if target is not None:
            self._ask(
                f"Put the {target} before the painting, in its plane.",
                f"the {target} is before the painting",
            )
            self._target = target

    def _ask(self, request: str, done: str) -> None:
        if not self._confirm(request):
            raise DeviceError(f"nobody confirmed that {done}; resume when somebody is at the desk")

    def _blank(self) -> None:
        if self._rig.subject.projection is not None:
            self._rig.blank()

    def _move_light(self, pose: ArmPose | None) -> None:
        if pose is None:
            return
        if self._rig.arm.pose is None:
            # Homing is motion too, which nobody wants under light.
            self._blank()
            self._rig.arm.home()
            self._pose = None
        if pose != self._pose:
            self._rig.move_light(pose)
            self._pose = pose

    def _switch_lamp(self, on: bool) -> None:
        if on == self._rig.subject.lamp_on:
            return
        self._rig.switch_lamp(on)
        if on and not self._warm:
            self._wait(self._plan.lamp_warm_up_s)
            self._warm = True
