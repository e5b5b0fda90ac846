"""What a simulated GRBL controller does with single bytes, inputs, holds, doors, alarms and resets.

Single bytes act at once, lines wait their turn, and ``ok`` comes when a move is queued. The program
is a generator that yields what it waits for, so that any clock can drive it; its flow follows the
sources and documents of GRBL 1.1.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator
from dataclasses import replace

from devices.simulated.grbl_gcode import Modes
from devices.simulated.grbl_machine import Machine
from devices.simulated.grbl_memory import ReportCadence, Settings
from devices.simulated.grbl_state import Build, Flags, State, Suspension

_RX_BYTES = 128
_LINE_BYTES = 79
_NEWLINES = b"\r\n"
_ALARM_DELAY_S = 0.5
# Delays before a resume brings back what a door switched off.
_SPINDLE_RESTORE_S, _COOLANT_RESTORE_S = 4.0, 1.0
_HARD_LIMIT, _SOFT_LIMIT, _ABORTED, _HOMING_RESET = 1, 2, 3, 6
_SPINDLE_LETTER = {"M3": "S", "M4": "C", "M5": ""}
_COOLANT_LETTER = {"M7": "M", "M8": "F"}

Program = Generator[Callable[[], bool], None, None]
"""Yields conditions that it waits for."""

Answer = Generator[Callable[[], bool], None, int]
"""A program that ends with the number of an error, or 0."""


class RealtimeProgram:
    """The controller's program and its memory.

    Parameters
    ----------
    machine : Machine
        What it drives.
    settings : Settings
    build : Build
    """

    def __init__(self, machine: Machine, settings: Settings, build: Build) -> None:
        self._machine = machine
        self._settings = settings
        self._build = build
        self.replies: deque[str] = deque()
        self.wake_s = math.inf
        self._rx: deque[int] = deque()
        self._alarm = 0
        self._forget()
        self.power_up()

    def _forget(self) -> None:
        """Back to what every start begins with."""
        self._flags = Flags()
        self._suspension = Suspension()
        self._abort = self._soft_limit = False
        self._alarm = 0
        self._feed_percent = self._rapid_percent = self._spindle_percent = 100
        self._cadence = ReportCadence()
        self._modes = Modes()
        self._rx.clear()
        self._line, self._comment, self._overflow = "", "", False

    def power_up(self) -> None:
        """Begin as after a power failure, or a pulse on the board's reset line."""
        self.state = State.ALARM if self._settings[22] else State.IDLE
        self._machine.forget_position()
        self._machine.set_spindle("")
        self._machine.set_coolant(frozenset())
        self._alarm = 0
        self._held_back = False
        self._program = self._run()
        self._ready: Callable[[], bool] = lambda: True
        self.wake_s = math.inf
        self.turn()

    def receive(self, byte: int) -> None:
        """Take a byte from the host, as its interrupt does."""
        self._held_back = False
        if not self._act_at_once(byte) and len(self._rx) < _RX_BYTES - 1:
            self._rx.append(byte)
            self._held_back = self._build.replies_lag and byte in _NEWLINES
        self.turn()

    def turn(self) -> None:
        """Let the program run until it waits for something."""
        if self._machine.now_s >= self.wake_s - 1e-9:
            self.wake_s = math.inf
        while self._ready():
            self._ready = next(self._program)

    def motion_ended(self) -> None:
        """The steppers came to the end of the queue, or of a hold."""
        self._flags.stop = True

    def open_door(self) -> None:
        """The door switch opens."""
        self._flags.door = True
        self.turn()

    def kill(self, alarm: int = 0) -> None:
        """Cut steppers and outputs, and ask for a reset, as an interrupt does.

        Parameters
        ----------
        alarm : int
            Number of the alarm; 0 for what follows from the state.
        """
        if alarm:
            self._alarm = alarm
        if self._flags.reset:
            return
        self._flags.reset = True
        self._machine.set_spindle("")
        self._machine.set_coolant(frozenset())
        if self._machine.moving or self.state is State.HOME:
            usual = _HOMING_RESET if self.state is State.HOME else _ABORTED
            self._alarm = self._alarm or usual
        self._machine.cut()

    def _act_at_once(self, byte: int) -> bool:
        """Whether a byte is a command by itself; it is then done or noted."""
        flags = self._flags
        if byte == 0x18:
            self.kill()
        elif byte == ord("?"):
            flags.report = True
        elif byte == ord("!"):
            flags.hold = True
        elif byte == ord("~"):
            flags.start = True
        elif byte == 0x84:
            flags.door = True
        elif byte == 0x85:
            flags.cancel |= self.state is State.JOG
        elif byte >= 0x80:
            self._override(byte)
        else:
            return False
        return True

    def _override(self, byte: int) -> None:
        """Speeds by share, and outputs toggled while the program runs."""
        planner = self._machine.planner
        feed = {0x90: None, 0x91: 10, 0x92: -10, 0x93: 1, 0x94: -1}
        spindle = {0x99: None, 0x9A: 10, 0x9B: -10, 0x9C: 1, 0x9D: -1}
        rapid = {0x95: 100, 0x96: 50, 0x97: 25}
        if byte in feed:
            step = feed[byte]
            self._feed_percent = 100 if step is None else self._feed_percent + step
            self._feed_percent = min(max(self._feed_percent, 10), 200)
            planner.feed_share = self._feed_percent / 100
        elif byte in rapid:
            self._rapid_percent = rapid[byte]
            planner.rapid_share = self._rapid_percent / 100
        elif byte in spindle:
            step = spindle[byte]
            self._spindle_percent = 100 if step is None else self._spindle_percent + step
            self._spindle_percent = min(max(self._spindle_percent, 10), 200)
        elif byte in (0xA0, 0xA1) and self.state in (State.IDLE, State.RUN, State.HOLD, State.JOG):
            word = "M8" if byte == 0xA0 else "M7"
            if word == "M8" or "M" in self._build.options:
                self._modes = replace(self._modes, coolant=self._modes.coolant ^ {word})
                self._apply_coolant()
        planner.plan()
        self._cadence.outputs_changed()

    def _say(self, line: str) -> None:
        self.replies.append(line)

    # The program.

    def _run(self) -> Program:
        while True:
            self._start_anew()
            yield from self._serve()

    def _start_anew(self) -> None:
        """What every reset does; the position survives it, and an alarm."""
        self._forget()
        machine = self._machine
        machine.set_spindle("")
        machine.set_coolant(frozenset())
        machine.planner.place(machine.planner.position)
        machine.planner.feed_share = machine.planner.rapid_share = 1.0
        self._say("")
        self._say(f"Grbl {self._build.version} ['$' for help]")

    def _serve(self) -> Program:
        """Line after line, until a reset."""
        if self.state in (State.ALARM, State.SLEEP):
            self._say("[MSG:'$H'|'$X' to unlock]")
            self.state = State.ALARM
        else:
            self.state = State.IDLE
            self._flags.door |= self._machine.door_open
        while True:
            while (line := self._next_line()) is not None:
                yield from self._attend()
                if self._abort:
                    return
                code = yield from self._answer(line)
                self._say("ok" if code == 0 else f"error:{code}")
            self._flags.start |= self._queued
            yield from self._attend()
            if self._abort:
                return
            yield lambda: self._called or self._line_waits

    @property
    def _queued(self) -> bool:
        return self._machine.planner.busy

    @property
    def _called(self) -> bool:
        """Whether a request waits."""
        closed = self._suspension.ajar and self._suspension.parked and not self._machine.door_open
        return bool(self._alarm) or closed or self._flags.any()

    @property
    def _line_waits(self) -> bool:
        return bool(self._rx) and not (self._held_back and len(self._rx) == 1)

    def _next_line(self) -> str | None:
        """The next whole line, upper case, without spaces and comments; ``*`` if too long."""
        while self._line_waits:
            byte = self._rx.popleft()
            if byte not in _NEWLINES:
                self._collect(chr(byte))
                continue
            line = "*" if self._overflow else self._line
            self._line, self._comment, self._overflow = "", "", False
            return line
        return None

    def _collect(self, letter: str) -> None:
        if self._overflow:
            return
        if self._comment:
            if self._comment == "(" and letter == ")":
                self._comment = ""
        elif letter in "(;":
            self._comment = letter
        elif letter > " " and letter != "/":
            if len(self._line) >= _LINE_BYTES:
                self._overflow = True
            else:
                self._line += letter.upper()

    def _delay(self, seconds: float) -> Program:
        """Wait, deaf to everything but what interrupts do."""
        end = self._machine.now_s + seconds
        self.wake_s = end
        yield lambda: self._machine.now_s >= end - 1e-9

    def _attend(self) -> Program:
        """Do what was requested by single bytes, inputs and the steppers."""
        while True:
            if self._alarm:
                yield from self._raise_alarm()
            if self._flags.reset:
                self._abort = True
                return
            if self._flags.report:
                self._flags.report = False
                self._say(self._status())
            if self._flags.hold or self._flags.door or self._flags.cancel or self._flags.sleep:
                self._interrupt()
            if self._flags.start:
                self._resume()
            if self._flags.stop:
                self._end_motion()
            if not self._suspension.any():
                return
            yield from self._park_or_restore()
            if self._suspension.any():
                yield lambda: self._called

    def _raise_alarm(self) -> Program:
        code = self._alarm
        self.state = State.ALARM
        self._say(f"ALARM:{code}")
        yield from self._delay(_ALARM_DELAY_S)
        if code in (_HARD_LIMIT, _SOFT_LIMIT):
            self._say("[MSG:Reset to continue]")
            self._flags.reset = False
            yield lambda: self._flags.reset
        self._alarm = 0

    def _interrupt(self) -> None:
        """A hold, a door, a cancelled jog: slow down, and wait."""
        flags, suspension, machine = self._flags, self._suspension, self._machine
        if self.state not in (State.ALARM, State.CHECK):
            if self.state in (State.RUN, State.JOG):
                machine.hold()
                suspension.jog_cancelled |= self.state is State.JOG
            elif self.state is State.IDLE:
                suspension.held = True
            if flags.hold and self.state not in (State.DOOR, State.JOG, State.SLEEP):
                self.state = State.HOLD
            if flags.door:
                self._say("[MSG:Check Door]")
                if not suspension.jog_cancelled and self.state is not State.SLEEP:
                    self.state = State.DOOR
                suspension.restoring = suspension.restored = False
                suspension.ajar = True
        if flags.sleep:
            self.state = State.SLEEP
            suspension.held = True
        flags.hold = flags.door = flags.cancel = flags.sleep = False

    def _resume(self) -> None:
        """Start what is queued, or go on after a hold."""
        suspension = self._suspension
        self._flags.start = False
        if self.state is State.DOOR and not suspension.ajar:
            if suspension.restored:
                self.state = State.IDLE
            elif suspension.parked:
                suspension.restoring = True
        if self.state is State.IDLE or (self.state is State.HOLD and suspension.held):
            self._suspension = Suspension()
            if self._queued:
                self.state = State.RUN
                self._machine.start()
            else:
                self.state = State.IDLE

    def _end_motion(self) -> None:
        """The steppers stand."""
        suspension, machine = self._suspension, self._machine
        self._flags.stop = False
        held = machine.holding
        machine.end_hold()
        waits = self.state in (State.HOLD, State.DOOR, State.SLEEP)
        if waits and not self._soft_limit and not suspension.jog_cancelled:
            suspension.held |= held
            return
        if suspension.jog_cancelled:
            machine.planner.place(machine.planner.position)
        if suspension.ajar:
            suspension.jog_cancelled, suspension.held = False, True
            self.state = State.DOOR
        else:
            self._suspension = Suspension()
            self.state = State.IDLE

    def _park_or_restore(self) -> Program:
        """What a door, once everything stands, does to the outputs."""
        suspension, machine = self._suspension, self._machine
        if not suspension.held or self.state not in (State.DOOR, State.SLEEP):
            return
        if not suspension.parked:
            machine.set_spindle("")
            machine.set_coolant(frozenset())
            self._cadence.outputs_changed()
            suspension.parked = True
        if suspension.ajar and not machine.door_open:
            suspension.ajar = False
        if suspension.restoring:
            yield from self._restore()

    def _restore(self) -> Program:
        """Switch on again what was on before the door opened, then go on."""
        suspension = self._suspension
        for lit, delay, apply in (
            (self._modes.spindle != "M5", _SPINDLE_RESTORE_S, self._apply_spindle),
            (bool(self._modes.coolant), _COOLANT_RESTORE_S, self._apply_coolant),
        ):
            if lit and not suspension.ajar:
                yield from self._delay(delay)
                if not (self._flags.reset or self._flags.door):
                    apply()
        if not (self._flags.reset or self._flags.door):
            suspension.restoring, suspension.restored = False, True
            self._flags.start = True
            self._resume()

    def _answer(self, line: str) -> Answer:
        """Do a line; the number of its error, or 0."""
        raise AssertionError("lines are for the subclass")

    def _apply_spindle(self) -> None:
        speed = self._modes.spindle_speed
        letter = _SPINDLE_LETTER[self._modes.spindle] if speed > 0 else ""
        if self._settings[32] and letter == "C":
            letter = ""  # laser mode: the power of M4 follows the speed of motion
        self._machine.set_spindle(letter)
        self._cadence.outputs_changed()

    def _apply_coolant(self) -> None:
        self._machine.set_coolant(frozenset(_COOLANT_LETTER[word] for word in self._modes.coolant))
        self._cadence.outputs_changed()

    def _status(self) -> str:
        """The answer to a question mark."""
        machine, suspension = self._machine, self._suspension
        state = str(self.state)
        if self.state is State.HOLD:
            state = "Jog" if suspension.jog_cancelled else f"Hold:{0 if suspension.held else 1}"
        elif self.state is State.DOOR:
            ready = 1 if suspension.ajar else 0
            state = f"Door:{3 if suspension.restoring else ready if suspension.parked else 2}"
        position = machine.planner.position
        mask = int(self._settings[10])
        if not mask & 1:
            x, y, z = (a - b for a, b in zip(position, self._modes.offset, strict=True))
            position = (x, y, z)
        parts = [state, f"{'MPos' if mask & 1 else 'WPos'}:{vector_text(position)}"]
        if mask & 2:
            parts.append(f"Bf:{machine.planner.free},{_RX_BYTES - len(self._rx)}")
        speed = machine.planner.speed if machine.stepping else 0.0
        parts.append(f"FS:{60 * speed:.0f},{self._modes.spindle_speed if self._lit else 0:.0f}")
        if machine.inputs:
            parts.append(f"Pn:{machine.inputs}")
        quiet = (State.IDLE, State.ALARM, State.CHECK, State.SLEEP)
        offset, overrides = self._cadence.next_fields(busy=self.state not in quiet)
        if offset:
            parts.append(f"WCO:{vector_text(self._modes.offset)}")
        if overrides:
            shares = (self._feed_percent, self._rapid_percent, self._spindle_percent)
            parts.append("Ov:" + ",".join(map(str, shares)))
            if machine.outputs:
                parts.append(f"A:{machine.outputs}")
        return f"<{'|'.join(parts)}>"

    @property
    def _lit(self) -> bool:
        return bool(set(self._machine.outputs) & set("SC"))


def vector_text(position: tuple[float, float, float]) -> str:
    """A position as reports tell it."""
    # Adding zero turns minus zero, which the firmware does not print, into zero.
    return ",".join(f"{round(value, 3) + 0.0:.3f}" for value in position)
