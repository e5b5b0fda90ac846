"""Talking with a GRBL controller whose replies may lag, merge, be lost or garbled.

GRBL numbers neither commands nor replies, so a reply alone proves nothing: an ``ok`` may belong to
the line before. But the line is first in, first out, and the number of the tool, which means
nothing to an arm, can be set to anything and is echoed by ``$G``. A number just made up that comes
back there proves that the controller has done all that was sent before it and that everything it
said before has been read; what it reports from then on is fresh.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from devices.deadline import Deadline
from devices.errors import DeviceTimeoutError
from devices.grbl.codes import RealtimeCommand
from devices.grbl.errors import AlarmError, ArmResetError, RefusedError
from devices.grbl.fitness import NEEDED
from devices.grbl.messages import (
    Acknowledged,
    Alarm,
    Banner,
    BuildOptions,
    MachineState,
    Message,
    ModalState,
    Refused,
    SettingValue,
    StatusReport,
)
from devices.grbl.serial_line import SerialLine

LIGHTS_OUT = "M5M9S0"
"""Words that switch every output off, and leave the spindle output no speed to come back with."""

# Attempts at a reading within one reply time-out.
_TRIES = 4
# A report tells the outputs at least this often (every 20th while busy, in GRBL 1.1).
_REPORTS_PER_OUTPUTS = 25
_TOOLS = 255
_RESETS = 2
_NUDGE_S = 0.5


class Conversation:
    """Exchanges with a controller, each within its time, each failure under its name.

    Parameters
    ----------
    line : SerialLine
    reply_timeout_s : float
        How long a reply may take.
    clock : callable, optional
        The monotonic clock.
    """

    def __init__(
        self,
        line: SerialLine,
        *,
        reply_timeout_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.line = line
        self._reply_timeout_s = reply_timeout_s
        self._clock = clock
        self.limit: Deadline | None = None
        """No wait goes on after this."""
        self._tool = int(1000 * clock()) % _TOOLS

    def receive(self, deadline: Deadline, *, doing: str) -> Message | None:
        """The next message that is no bad news; None if none came by the deadline.

        Parameters
        ----------
        deadline : Deadline
        doing : str
            What goes on meanwhile, for messages.

        Raises
        ------
        AlarmError, RefusedError, ArmResetError
            The controller stopped, refused a line, or started anew.
        """
        message = self.line.receive(deadline)
        if isinstance(message, Alarm):
            raise AlarmError(message.code, doing)
        if isinstance(message, Refused):
            raise RefusedError(message.code, doing)
        if isinstance(message, Banner):
            raise ArmResetError(
                f"the light arm's controller started anew while {doing} (power, cable, or the "
                "reset button); its position is lost, so home the arm"
            )
        return message

    def wait(self, seconds: float, *, doing: str) -> None:
        """Let time pass, and notice bad news.

        Raises
        ------
        DeviceError
            As :meth:`receive`.
        """
        deadline = self._after(seconds)
        while self.receive(deadline, doing=doing) is not None:
            pass

    def status(self, *, doing: str) -> StatusReport:
        """A status report, asked for again if it does not come or is garbled.

        Raises
        ------
        DeviceTimeoutError
            None came.
        """
        for _ in range(_TRIES):
            self.line.send_realtime(RealtimeCommand.STATUS)
            deadline = self._after(self._reply_timeout_s / _TRIES)
            while (message := self.receive(deadline, doing=doing)) is not None:
                if isinstance(message, StatusReport):
                    return message
        raise DeviceTimeoutError(
            f"the light arm's controller did not report its status in {self._reply_timeout_s:g} s "
            f"while {doing}; look at its power and cable"
        )

    def outputs(self, timeout_s: float, *, doing: str) -> tuple[StatusReport, str | None]:
        """A status report that tells which outputs are on.

        Parameters
        ----------
        timeout_s : float
            How long it may take until one comes; most reports do not tell.
        doing : str

        Returns
        -------
        StatusReport
            The last one.
        str or None
            Letters of the outputs that are on; None if the firmware's reports never tell.

        Raises
        ------
        DeviceTimeoutError
            Too few reports came.
        """
        end = self._after(timeout_s)
        for _ in range(_REPORTS_PER_OUTPUTS):
            report = self.status(doing=doing)
            if report.accessories is not None:
                return report, report.accessories
            if self._clock() >= end.at_s:
                raise DeviceTimeoutError(
                    f"the light arm's controller did not tell whether the lamp is lit while {doing}"
                )
        return report, None

    def acknowledge(self, line: str, deadline: Deadline, *, doing: str) -> None:
        """Send a line once, and wait for its ``ok``.

        Raises
        ------
        DeviceTimeoutError
            It did not come.
        """
        self.line.send_line(line)
        while self._clock() < deadline.at_s:
            soon = min(deadline, self._after(_NUDGE_S))
            while (message := self.receive(soon, doing=doing)) is not None:
                if isinstance(message, Acknowledged):
                    return
            # Some boards look at a line only when the next byte comes; this one does nothing else.
            self.line.send_realtime(RealtimeCommand.STATUS)
        raise DeviceTimeoutError(
            f"the light arm's controller did not finish {line} in time while {doing}"
        )

    def execute(self, line: str, *, doing: str) -> ModalState:
        """Send a line that moves nothing, and make sure that it was done."""
        self.line.send_line(line)
        return self.synchronise(doing=doing)

    def synchronise(self, *, doing: str) -> ModalState:
        """Wait until all that was sent is done and all that was said is read.

        Motion must have ended, and the controller be unlocked. Any modal motion is cancelled, so
        that an altered line cannot move the arm.

        Returns
        -------
        ModalState
            Of this moment.

        Raises
        ------
        DeviceTimeoutError
            The echo did not come, several times over.
        """
        made_up = set()
        for _ in range(_TRIES):
            self._tool = self._tool % _TOOLS + 1
            made_up.add(self._tool)
            self.line.send_line(f"G80T{self._tool}")
            self.line.send_line("$G")
            deadline = self._after(self._reply_timeout_s / _TRIES)
            while (message := self.receive(deadline, doing=doing)) is not None:
                if isinstance(message, ModalState) and message.tool in made_up:
                    return message
        raise DeviceTimeoutError(
            f"the light arm's controller did not answer in {self._reply_timeout_s:g} s while "
            f"{doing}; look at its power and cable"
        )

    def reset(self, *, doing: str) -> Banner:
        """Have the controller start anew: motion and every output stop at once.

        Raises
        ------
        DeviceTimeoutError
            It did not greet.
        """
        self.line.received()
        for _ in range(_RESETS):
            self.line.send_realtime(RealtimeCommand.RESET)
            deadline = self._after(self._reply_timeout_s)
            while (message := self.line.receive(deadline)) is not None:
                if isinstance(message, Banner):
                    return message
        raise DeviceTimeoutError(
            f"the light arm's controller did not start anew in {self._reply_timeout_s:g} s while "
            f"{doing}; look at its power and cable"
        )

    def read_settings(self, *, doing: str) -> dict[int, float]:
        """The controller's settings, read until two readings agree.

        Raises
        ------
        DeviceTimeoutError
            No two whole readings did.
        """
        before: dict[int, float] = {}
        for _ in range(2 * _TRIES):
            values = self._read_settings_once(doing=doing)
            if values == before and values.keys() >= NEEDED:
                return values
            before = values
        raise DeviceTimeoutError(
            "the settings of the light arm's controller cannot be read twice alike; look at its "
            "cable and earth"
        )

    def read_build_options(self, *, doing: str) -> str:
        """Codes of the firmware's build options; empty if it does not tell."""
        for _ in range(_TRIES):
            self.line.send_line("$I")
            deadline = self._after(self._reply_timeout_s / _TRIES)
            while (message := self.receive(deadline, doing=doing)) is not None:
                if isinstance(message, BuildOptions):
                    return message.codes
        return ""

    def hold(self, slow_down_s: float) -> bool:
        """Slow down to a stand.

        Parameters
        ----------
        slow_down_s : float
            How long that may take.

        Returns
        -------
        bool
            Whether the controller says that nothing moves.
        """
        self.line.send_realtime(RealtimeCommand.HOLD)
        end = self._clock() + slow_down_s
        while self._clock() < end:
            self.line.send_realtime(RealtimeCommand.STATUS)
            deadline = self._after(min(0.05, slow_down_s))
            while (message := self.line.receive(deadline)) is not None:
                if isinstance(message, (Alarm, Banner)):
                    return True
                if isinstance(message, StatusReport) and _stands_still(message):
                    return True
        return False

    def lights_out(self, timeout_s: float, *, after_reset: bool) -> bool | None:
        """Switch every output off, in any state of the controller.

        Parameters
        ----------
        timeout_s : float
            How long it may take until the controller tells.
        after_reset : bool
            Whether a reset was asked for, whose greeting may still come.

        Returns
        -------
        bool or None
            Whether they are off, as a controller under which nothing moves reports it; None if it
            does not say.
        """
        self.line.send_line(LIGHTS_OUT)
        said = None
        end = self._clock() + timeout_s
        while self._clock() < end:
            self.line.send_realtime(RealtimeCommand.STATUS)
            deadline = self._after(0.05)
            while (message := self.line.receive(deadline)) is not None:
                if isinstance(message, (Alarm, Banner)) and not after_reset:
                    return None
                if isinstance(message, StatusReport):
                    if message.accessories is None:
                        break
                    said = message.accessories == ""
                    if said and _stands_still(message):
                        return True
        return False if said is False else None

    def _read_settings_once(self, *, doing: str) -> dict[int, float]:
        values: dict[int, float] = {}
        self.line.send_line("$$")
        deadline = self._after(self._reply_timeout_s)
        while (message := self.receive(deadline, doing=doing)) is not None:
            if isinstance(message, SettingValue):
                values[message.number] = message.value
            if isinstance(message, Acknowledged) and values.keys() >= NEEDED:
                break
        return values

    def _after(self, seconds: float) -> Deadline:
        deadline = Deadline(self._clock() + seconds)
        return deadline if self.limit is None else min(deadline, self.limit)


def _stands_still(report: StatusReport) -> bool:
    """Whether nothing moves in the state that a report tells."""
    if report.state is MachineState.HOLD:
        return report.substate == 0
    if report.state is MachineState.DOOR:
        return report.substate in (0, 1)
    return report.state in (
        MachineState.IDLE,
        MachineState.ALARM,
        MachineState.SLEEP,
        MachineState.CHECK,
    )
