"""The arm's lamp on an output of its controller: lit only at a stand, and seen to be as told.

The parser's modes, freshly echoed, tell whether the command was taken; the letters of the outputs
in a status report, where the firmware gives them, whether the output followed.
"""

from __future__ import annotations

from dataclasses import dataclass

from devices.errors import DeviceError
from devices.grbl.conversation import LIGHTS_OUT, Conversation
from devices.grbl.errors import AlarmError, DoorOpenError, LampError
from devices.grbl.messages import MachineState, ModalState, StatusReport
from devices.grbl.settings import SPINDLE_OUTPUTS, LampOutput

_WORD = {
    LampOutput.SPINDLE: "M3",
    LampOutput.SPINDLE_REVERSE: "M4",
    LampOutput.FLOOD: "M8",
    LampOutput.MIST: "M7",
}
# Letters by which reports name the outputs; some builds show both ways of the spindle alike.
_LETTERS = {
    LampOutput.SPINDLE: "SC",
    LampOutput.SPINDLE_REVERSE: "SC",
    LampOutput.FLOOD: "F",
    LampOutput.MIST: "M",
}


@dataclass(frozen=True)
class Lamp:
    """A lamp.

    Attributes
    ----------
    output : LampOutput
    spindle_speed : float
        What the spindle output is set to.
    timeout_s : float
        How long it may take until the controller tells whether it is lit.
    """

    output: LampOutput
    spindle_speed: float
    timeout_s: float

    def light(self, talk: Conversation, *, doing: str) -> None:
        """Light it, if the arm stands idle, and see that it is lit.

        Raises
        ------
        DeviceError
            The arm does not stand idle; a :class:`~devices.grbl.errors.LampError` if the lamp does
            not follow.
        """
        talk.synchronise(doing=doing)
        require_idle(talk.status(doing=doing), doing=doing)
        word = _WORD[self.output]
        spins = self.output in SPINDLE_OUTPUTS
        modes = talk.execute(f"{word}S{self.spindle_speed:.0f}" if spins else word, doing=doing)
        if word not in modes.words:
            raise LampError(f"the lamp was told {word}, and the controller did not take it")
        report, lit = talk.outputs(self.timeout_s, doing=doing)
        require_idle(report, doing=doing)
        if lit is not None and not set(lit) & set(_LETTERS[self.output]):
            raise LampError(
                f"the lamp does not light: the controller reports its {self.output} output off; "
                "look at lamp in rig.toml, at $30 and $31, and at the wiring"
            )

    def extinguish(self, talk: Conversation, *, doing: str) -> StatusReport:
        """Switch every output off, and see that it is.

        Returns
        -------
        StatusReport
            The last one.

        Raises
        ------
        DeviceError
            The arm does not stand idle; a :class:`~devices.grbl.errors.LampError` if an output
            stays on.
        """
        require_dark_modes(talk.execute(LIGHTS_OUT, doing=doing))
        report, lit = talk.outputs(self.timeout_s, doing=doing)
        require_idle(report, doing=doing)
        require_dark(lit)
        return report


def require_idle(report: StatusReport, *, doing: str) -> None:
    """Refuse any state but standing idle.

    Raises
    ------
    DeviceError
        Named by the state.
    """
    if report.state is MachineState.IDLE:
        return
    require_closed_door(report, doing=doing)
    if report.state is MachineState.ALARM:
        raise AlarmError(None, doing)
    raise DeviceError(
        f"the light arm's controller is in state {report.state} while {doing}; somebody else "
        "commands it, or a button was pressed"
    )


def require_closed_door(report: StatusReport, *, doing: str) -> None:
    """Refuse the state that an open door brings about.

    Raises
    ------
    DoorOpenError
    """
    if report.state is MachineState.DOOR:
        raise DoorOpenError(f"the safety door was opened while {doing}; close it and home the arm")


def require_dark(lit: str | None) -> None:
    """Refuse outputs that are on after they were switched off.

    Raises
    ------
    LampError
    """
    if lit:
        raise LampError(
            f"the lamp stays lit: the controller reports output {lit} on after it was switched "
            "off; cut the lamp's power, and nothing moves meanwhile"
        )


def require_dark_modes(modes: ModalState) -> None:
    """Refuse modes in which an output is on.

    Raises
    ------
    LampError
    """
    if not {"M5", "M9"} <= modes.words:
        raise LampError(
            "the lamp stays lit: the controller did not take the command that switches it off"
        )
