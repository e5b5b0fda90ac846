"""A light arm on a GRBL 1.1 controller.

The controller acknowledges a move when it is queued, so the arm asks for its status until it stands
idle at its target. The lamp is put out, and seen to be out, before anything moves, and is lit only
while the arm stands idle. Whatever goes wrong, an interruption included, the arm is stopped by
every means (hold, then reset, which also cuts every output) before the error is raised, and must be
homed again: what it did meanwhile is not known. Nothing that moves is ever sent twice.
"""

from __future__ import annotations

import atexit
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError
from devices.grbl.codes import Setting
from devices.grbl.conversation import Conversation
from devices.grbl.errors import PositionUntrustedError, StopFailedError
from devices.grbl.fitness import check_fitness
from devices.grbl.greeting import accept_banner, greet
from devices.grbl.lamp import (
    Lamp,
    require_closed_door,
    require_dark,
    require_dark_modes,
    require_idle,
)
from devices.grbl.mechanics import read_mechanics
from devices.grbl.messages import Alarm, Banner, MachineState, Message, Notice, StatusReport
from devices.grbl.serial_line import SerialLine, SerialPort, open_serial_port
from devices.grbl.settings import GrblSettings
from devices.interfaces import ArmCapabilities, ArmPose

_POLL_S = 0.05
# Reports that must say alike that the arm has arrived.
_CONFIRMATIONS = 2
_DOOR = "MSG:Check Door"
_NOT_HOMED = "it was not homed since the controller was connected"


class GrblLightArm:
    """Fills :class:`~devices.interfaces.LightArm`; for one thread.

    Parameters
    ----------
    settings : GrblSettings
    open_port : callable, optional
        Opens the port; by default, the serial port that the settings name.
    clock : callable, optional
        The monotonic clock; a simulated one in tests.

    Raises
    ------
    DeviceError
        Nothing answers on the port as GRBL 1.1, or its settings are not fit for the rig.
    """

    def __init__(
        self,
        settings: GrblSettings,
        *,
        open_port: Callable[[], SerialPort] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings = settings
        self._open_port = open_port or (lambda: open_serial_port(settings.port, settings.baud_rate))
        self._clock = clock
        self._pose: ArmPose | None = None
        self._untrusted_because = _NOT_HOMED
        self._lamp_on = False
        self._slow_down_s = 0.0  # what a hold needs to take effect: nothing while nothing moves
        self._settled = False
        self._stays_lit = False
        self._lost = False
        self._closed = False
        self._talk = self._new_conversation()
        try:
            self._begin()
        except BaseException:
            self._talk.line.close()
            raise
        if open_port is None:
            # A real arm goes dark and still though whoever opened it forgets to close it.
            atexit.register(self.close)

    @property
    def capabilities(self) -> ArmCapabilities:
        """What the arm is."""
        return ArmCapabilities(self._model, self._mechanics.limits, self._mechanics.speed)

    @property
    def pose(self) -> ArmPose | None:
        """Where it stands; None before homing, and after a reset, an alarm or a failed move."""
        self._notice()
        return self._pose

    @property
    def lamp_on(self) -> bool:
        """Whether the lamp was last switched on, and the controller has not started anew since."""
        self._notice()
        return self._lamp_on

    @property
    def longest_stop_s(self) -> float:
        """How long, at most, an operation goes on after its deadline: the arm is being stopped."""
        # Two tries of a reset, one look at the outputs; again if the port had to be reopened.
        return 2 * (self._mechanics.slow_down_s + 3 * self._settings.reply_timeout_s)

    def home(self, *, deadline: Deadline | None = None) -> None:
        """Start the controller anew, find the zero of both axes, and trust the position.

        A controller that was unplugged is connected again first.

        Parameters
        ----------
        deadline : Deadline, optional
            By default, what its settings allow for homing.

        Raises
        ------
        DeviceError
            An end switch is not found, the door is open, not done in time, the controller is gone.
        """
        self._require_open()
        with self._operation("homing", deadline):
            self._distrust("homing was not finished")
            if self._lost:
                self._reconnect(deadline)
            self._talk.reset(doing="homing")
            report, lit = self._talk.outputs(self._settings.lamp_timeout_s, doing="homing")
            require_closed_door(report, doing="homing")
            require_dark(lit)
            self._lamp_on = False
            by = self._by(self._mechanics.homing_s, deadline)
            self._talk.acknowledge("$H", by, doing="homing")
            require_dark_modes(self._talk.synchronise(doing="homing"))
            report = self._talk.status(doing="homing")
            require_idle(report, doing="homing")
            pose = self._mechanics.pose_in(report)
            if not self._mechanics.is_at(report, self._mechanics.homes):
                raise DeviceError(
                    f"homing ended at {pose}, not at the pull-off from the end switches; look at "
                    "$23, $27 and the firmware's homing cycles"
                )
            self._pose = pose

    def move_to(self, pose: ArmPose, *, deadline: Deadline | None = None) -> None:
        """Put the lamp out, move, and return once the arm stands still at ``pose``.

        Parameters
        ----------
        pose : ArmPose
        deadline : Deadline, optional
            When it must be there, if earlier than distance, feed and acceleration allow for.

        Raises
        ------
        DeviceError
            Outside the limits, position not trusted, an alarm, or not there by the deadline; then
            motion was stopped.
        """
        self._require_open()
        self._mechanics.limits.check(pose)
        start = self.pose
        if start is None:
            raise PositionUntrustedError(
                f"the light arm does not know where it stands ({self._untrusted_because}); home it"
            )
        doing = f"moving to {pose}"
        with self._operation(doing, deadline):
            report = self._lamp.extinguish(self._talk, doing=doing)
            self._lamp_on = False
            targets = self._mechanics.coordinates_of(pose)
            arrival = self._by(self._mechanics.travel_time(report, targets), deadline)
            self._distrust("its last move was not finished")
            self._slow_down_s = self._mechanics.slow_down_s
            self._talk.line.send_line(self._mechanics.move_line(targets))
            report = self._await_arrival(targets, arrival, doing=doing)
            self._slow_down_s = 0.0
            self._pose = self._mechanics.pose_in(report)

    def switch_lamp(self, on: bool) -> float:
        """Switch the lamp; returns the monotonic time since when it is so.

        Raises
        ------
        DeviceError
            The lamp does not answer (:class:`~devices.grbl.errors.LampError`), or the arm is
            moving.
        """
        self._require_open()
        doing = f"switching the lamp {'on' if on else 'off'}"
        with self._operation(doing, self._soon()):
            if on:
                self._lamp_on = True  # before it is, so that an interruption finds it so
                self._lamp.light(self._talk, doing=doing)
                self._talk.wait(self._settings.lamp_settle_s, doing=doing)
            else:
                self._lamp.extinguish(self._talk, doing=doing)
                self._lamp_on = False
            return self._clock()

    def unlock(self) -> None:
        """Lift the lock of an alarm without homing, to use the lamp where the arm stands.

        The position stays untrusted.

        Raises
        ------
        DeviceError
            The door is open, or the controller does not unlock.
        """
        self._require_open()
        with self._operation("unlocking", self._soon()):
            self._distrust("it was unlocked without homing")
            self._talk.reset(doing="unlocking")
            self._talk.acknowledge(
                "$X", Deadline(self._clock() + self._settings.reply_timeout_s), doing="unlocking"
            )
            self._lamp.extinguish(self._talk, doing="unlocking")
            self._lamp_on = False

    def stop(self) -> None:
        """Stop motion and put the lamp out, by every means there is; harmless at any time.

        An arm that stands idle keeps its position.

        Raises
        ------
        StopFailedError
            Nothing confirmed it.
        """
        if self._closed:
            return
        self._notice()
        if self._settled:
            self._lamp_on = False
            try:
                if self._talk.lights_out(self._settings.reply_timeout_s, after_reset=False):
                    return
            except DeviceLostError:
                self._lost = True
        self._halt()

    def close(self) -> None:
        """Stop, and release the arm; harmless when closed already."""
        try:
            self.stop()
        finally:
            self._closed = True
            self._talk.line.close()
            atexit.unregister(self.close)

    @contextmanager
    def _operation(self, doing: str, deadline: Deadline | None) -> Iterator[None]:
        """Whatever ends the work inside early, the arm stands still in the dark before it gets out.

        Raises
        ------
        StopFailedError
            It failed, and nothing confirmed that the arm stopped.
        """
        self._settled = False
        self._talk.limit = deadline
        try:
            yield
        except BaseException as error:
            self._talk.limit = None
            self._lost |= isinstance(error, DeviceLostError)
            self._distrust(f"{doing} failed")
            try:
                self._halt()
            except StopFailedError as failure:
                if isinstance(error, DeviceError):
                    raise StopFailedError(f"{error}; and {failure}") from error
                # An interruption stays one; closing the rig stops the arm, and says so, again.
            raise
        self._talk.limit = None
        self._settled = True

    def _halt(self) -> None:
        """Stop by every means, whatever state things are in.

        Raises
        ------
        StopFailedError
            Nothing confirmed it.
        """
        self._distrust(self._untrusted_because)
        try:
            dark = self._hold_and_reset()
        except DeviceLostError:
            # Opening its port again resets many a board, and a plug may be back in by now.
            try:
                self._talk.line.close()
                self._talk = self._new_conversation()
                dark = self._hold_and_reset()
            except DeviceError as error:
                self._lost = True
                raise StopFailedError(
                    f"the light arm could not be told to stop ({error}): cut the power of arm and "
                    "lamp"
                ) from error
        if not dark:
            raise StopFailedError(
                "the light arm's controller did not confirm that motion stopped and the lamp is "
                "out: cut the power of arm and lamp"
            )
        self._slow_down_s = 0.0
        self._lamp_on = False
        self._settled = True

    def _hold_and_reset(self) -> bool:
        """Hold, reset, every output off; whether the controller confirms it."""
        still = self._talk.hold(self._slow_down_s)
        try:
            self._talk.reset(doing="stopping")
            anew = True
        except DeviceTimeoutError:
            anew = False
        dark = self._talk.lights_out(self._settings.reply_timeout_s, after_reset=True)
        if dark is not None:
            self._stays_lit = not dark
        # Starting anew cuts motion and outputs, unless a report said otherwise.
        return (anew or still) if dark else anew and not self._stays_lit

    def _await_arrival(
        self, targets: list[float], arrival: Deadline, *, doing: str
    ) -> StatusReport:
        """Ask until the controller stands idle at its target."""
        confirmations, idle_since = 0, self._clock()
        while True:
            report = self._talk.status(doing=doing)
            if report.state is not MachineState.IDLE:
                confirmations, idle_since = 0, math.inf
                if report.state not in (MachineState.JOG, MachineState.RUN):
                    require_idle(report, doing=doing)
            elif self._mechanics.is_at(report, targets):
                confirmations += 1
                if confirmations == _CONFIRMATIONS:
                    return report
                continue
            else:
                confirmations, idle_since = 0, min(idle_since, self._clock())
                if self._clock() - idle_since > self._settings.reply_timeout_s:
                    raise DeviceError(
                        f"the light arm stands still at {self._mechanics.pose_in(report)} while "
                        f"{doing}; the command was lost or altered on its way, or somebody held it"
                    )
            self._talk.wait(min(_POLL_S, arrival.at_s - self._clock()), doing=doing)
            if self._clock() >= arrival.at_s:
                raise DeviceTimeoutError(
                    f"the light arm did not arrive in time while {doing}; it was at "
                    f"{self._mechanics.pose_in(report)}"
                )

    def _by(self, time_s: float, deadline: Deadline | None) -> Deadline:
        """The deadline of a motion that should take ``time_s``, or an earlier one asked for."""
        settings = self._settings
        own = Deadline(self._clock() + settings.move_margin * time_s + settings.reply_timeout_s)
        return own if deadline is None else min(own, deadline)

    def _soon(self) -> Deadline:
        """When switching the lamp, with all that is looked at before and after, must be done."""
        settings = self._settings
        return Deadline(
            self._clock()
            + 3 * settings.reply_timeout_s
            + settings.lamp_timeout_s
            + settings.lamp_settle_s
        )

    def _distrust(self, why: str) -> None:
        self._pose = None
        self._untrusted_because = why

    def _notice(self) -> None:
        """Take note of an alarm or a reset that nobody asked for, between two operations."""
        if not self._settled or self._closed:
            return
        try:
            messages = self._talk.line.received()
        except DeviceLostError:
            self._lost = True
            self._distrust("the controller is gone")
            self._settled = False
            return
        if any(map(_puts_out, messages)):
            self._distrust("the controller stopped or started anew by itself, or its door opened")
            self._lamp_on = False
            self._settled = False

    def _require_open(self) -> None:
        if self._closed:
            raise DeviceError("the light arm was closed; open the rig again")

    def _new_conversation(self) -> Conversation:
        line = SerialLine(self._open_port(), name=self._settings.port, clock=self._clock)
        return Conversation(line, reply_timeout_s=self._settings.reply_timeout_s, clock=self._clock)

    def _reconnect(self, limit: Deadline | None) -> None:
        self._talk.line.close()
        self._talk = self._new_conversation()
        self._talk.limit = limit
        self._begin()
        self._lost = False

    def _begin(self) -> None:
        """Make the controller start from a known state, and read and check its settings."""
        doing = "connecting"
        settings, name = self._settings, self._settings.port
        boot_s, limit = settings.boot_timeout_s, self._talk.limit
        if limit is not None:
            boot_s = max(0.0, min(boot_s, limit.at_s - self._clock()))
        greet(self._talk.line, name=name, boot_timeout_s=boot_s, may_reset=True, clock=self._clock)
        self._model = accept_banner(self._talk.reset(doing=doing), name=name)
        options = self._talk.read_build_options(doing=doing)
        values = self._talk.read_settings(doing=doing)
        check_fitness(values, settings)
        self._mechanics = read_mechanics(values, build_options=options, settings=settings)
        self._lamp = Lamp(
            settings.lamp,
            settings.lamp_power * values[Setting.SPINDLE_MAX],
            settings.lamp_timeout_s,
        )
        self._settled = True


def _puts_out(message: Message) -> bool:
    """Whether a message tells that the controller has put the lamp out by itself."""
    door = isinstance(message, Notice) and message.text == _DOOR
    return door or isinstance(message, (Alarm, Banner))
