"""Lines of a simulated GRBL 1.1h controller: settings, homing, jogs, and blocks of G-code.

``ok`` comes when a move is queued; outputs and pauses wait until all that is queued is done.
"""

from __future__ import annotations

import math
from dataclasses import replace

from devices.simulated.grbl_gcode import Block, Modes, RefusedLineError, read_block, read_jog
from devices.simulated.grbl_realtime import Answer, Program, RealtimeProgram, vector_text
from devices.simulated.grbl_state import State

_SOFT_LIMIT, _HOMING_RESET, _HOMING_DOOR, _STILL_CLOSED, _NOT_FOUND = 2, 6, 7, 8, 9


class Firmware(RealtimeProgram):
    """The controller's program, with what it does with lines."""

    def _answer(self, line: str) -> Answer:
        """Do a line; the number of its error, or 0."""
        try:
            if line == "*":
                return 11
            if not line:
                return 0
            if line.startswith("$"):
                return (yield from self._do_system(line))
            if self.state in (State.ALARM, State.JOG):
                return 9
            planner, mist = self._machine.planner, "M" in self._build.options
            block = read_block(line, self._modes, planner.end, mist=mist)
            yield from self._do_block(block)
        except RefusedLineError as refused:
            return refused.code
        return 0

    def _do_system(self, line: str) -> Answer:
        """A line that begins with a dollar."""
        idle = self.state in (State.IDLE, State.ALARM)
        if line == "$":
            self._say("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")
        elif line.startswith("$J"):
            return (yield from self._do_jog(line))
        elif line == "$$":
            if self.state in (State.RUN, State.HOLD):
                return 8
            self.replies.extend(self._settings.lines())
        elif line == "$G":
            self._say(f"[GC:{self._modes}]")
        elif line == "$X":
            return self._unlock()
        elif line == "$C":
            return self._toggle_check()
        elif line[1] in "$GCX":
            return 3
        elif not idle:
            return 8
        elif line == "$H":
            return (yield from self._do_home())
        else:
            return self._do_idle_system(line)
        return 0

    def _do_idle_system(self, line: str) -> int:
        """The rest of the dollar lines, which nothing must run beside."""
        if line == "$#":
            self._tell_parameters()
        elif line == "$I":
            self._say(f"[VER:{self._build.version}.{self._build.date}:]")
            self._say(f"[OPT:{self._build.options},15,128]")
        elif line == "$SLP":
            self._flags.sleep = True
        elif line == "$N":
            self.replies.extend(("$N0=", "$N1="))
        elif line[1] in "#HIRS":
            return 3
        else:
            self._store(line)
        return 0

    def _store(self, line: str) -> None:
        """``$n=value``."""
        number, equals, value = line[1:].partition("=")
        if not _is_number(number):
            raise RefusedLineError(2)
        if not equals:
            raise RefusedLineError(3)
        if not _is_number(value):
            raise RefusedLineError(2)
        if float(number) > 255:
            raise RefusedLineError(3)
        self._settings.store(int(float(number)), float(value))

    def _unlock(self) -> int:
        if self.state is State.ALARM:
            if self._machine.door_open:
                return 13
            self._say("[MSG:Caution: Unlocked]")
            self.state = State.IDLE
        return 0

    def _toggle_check(self) -> int:
        if self.state is State.CHECK:
            self.kill()
            self._say("[MSG:Disabled]")
        elif self.state is not State.IDLE:
            return 8
        else:
            self.state = State.CHECK
            self._say("[MSG:Enabled]")
        return 0

    def _tell_parameters(self) -> None:
        for name in ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30"):
            self._say(f"[{name}:0.000,0.000,0.000]")
        self._say(f"[G92:{vector_text(self._modes.offset)}]")
        self._say("[TLO:0.000]")
        self._say("[PRB:0.000,0.000,0.000:0]")

    def _do_jog(self, line: str) -> Answer:
        if self.state not in (State.IDLE, State.JOG):
            return 8
        if not line.startswith("$J="):
            return 3
        block = read_jog(line[3:], self._modes, self._machine.planner.end)
        assert block.target is not None  # a jog without a target was refused
        if self._settings[20] and not self._within_travel(block.target):
            return 15
        yield from self._queue(block)
        if self._queued and self.state is State.IDLE:
            self.state = State.JOG
            self._machine.start()
        return 0

    def _do_block(self, block: Block) -> Program:
        """A line of G-code: outputs wait for motion to end, motion waits for room in the queue."""
        old, new = self._modes, block.modes
        spins = new.spindle != "M5" and new.spindle_speed != old.spindle_speed
        if self.state is not State.CHECK and (new.spindle != old.spindle or spins):
            yield from self._drain()
            if self._abort:
                return
            self._modes = replace(self._modes, spindle=new.spindle, spindle_speed=new.spindle_speed)
            self._apply_spindle()
        if self.state is not State.CHECK and new.coolant != old.coolant:
            yield from self._drain()
            if self._abort:
                return
            self._modes = replace(self._modes, coolant=new.coolant)
            self._apply_coolant()
        if block.dwell_s and self.state is not State.CHECK:
            yield from self._drain()
            yield from self._delay(block.dwell_s)
        if new.offset != old.offset:
            self._cadence.offset_changed()
        self._modes = replace(new, flow="")
        if block.target is not None:
            yield from self._do_motion(block)
        yield from self._flow(new.flow)

    def _flow(self, word: str) -> Program:
        """Pause, or end of a programme."""
        if not word or self._abort:
            return
        yield from self._drain()
        if word == "M0":
            self._flags.hold = True
            yield from self._attend()
        else:
            kept = Modes(tool=self._modes.tool, feed=self._modes.feed, offset=self._modes.offset)
            self._modes = replace(kept, motion="G1")
            self._apply_spindle()
            self._apply_coolant()
            self._say("[MSG:Pgm End]")

    def _do_motion(self, block: Block) -> Program:
        assert block.target is not None
        if self._settings[20] and not self._within_travel(block.target):
            yield from self._stop_at_soft_limit()
        elif self.state is not State.CHECK:
            yield from self._queue(block)

    def _stop_at_soft_limit(self) -> Program:
        """A target beyond the travel: come to a stand, then alarm."""
        self._soft_limit = True
        if self.state is State.RUN:
            self._flags.hold = True
            while True:
                yield from self._attend()
                if self._abort:
                    return
                if self.state is State.IDLE:
                    break
                yield lambda: self._called
        self.kill(_SOFT_LIMIT)
        yield from self._attend()

    def _queue(self, block: Block) -> Program:
        settings, planner = self._settings, self._machine.planner
        while True:
            yield from self._attend()
            if self._abort:
                return
            if planner.free:
                break
            self._flags.start = True
            yield from self._attend()
            yield lambda: self._called or bool(planner.free)
        assert block.target is not None
        planner.add(
            block.target,
            block.feed,
            max_rates=[settings[110 + axis] / 60 for axis in range(3)],
            accelerations=[settings[120 + axis] for axis in range(3)],
            junction_deviation=settings[11],
        )

    def _drain(self) -> Program:
        """Wait until all that is queued is done."""
        self._flags.start |= self._queued
        while True:
            yield from self._attend()
            if self._abort or not (self._queued or self.state is State.RUN):
                return
            yield lambda: self._called

    def _within_travel(self, target: tuple[float, float, float]) -> bool:
        spans = (self._machine.travel(axis) for axis in range(3))
        return all(low <= at <= high for at, (low, high) in zip(target, spans, strict=True))

    def _do_home(self) -> Answer:
        """A homing cycle; of all bytes, only a reset is attended to."""
        if not self._settings[22]:
            return 5
        if self._machine.door_open:
            return 13
        self.state = State.HOME
        for axes in self._build.homing_cycles:
            failed = yield from self._home_axes(axes)
            if failed:
                self.kill(self._alarm or failed)
                yield from self._attend()
                return 0
        yield from self._attend()
        if not self._abort:
            self.state = State.IDLE
        return 0

    def _home_axes(self, axes: tuple[int, ...]) -> Answer:
        """Seek, pull off, approach, pull off; the number of the alarm if it fails."""
        machine = self._machine
        for phase in range(4):
            approach = phase % 2 == 0
            fine = machine.start_homing_phase(axes, approach=approach, first=phase == 0)
            self.wake_s = end = machine.homing_phase_ends_s
            yield lambda end=end: (  # type: ignore[misc]
                machine.now_s >= end - 1e-9 or self._flags.reset or self._flags.door
            )
            machine.end_homing_phase()
            if self._flags.reset:
                return _HOMING_RESET
            if self._flags.door:
                return _HOMING_DOOR
            if not fine:
                return _NOT_FOUND if approach else _STILL_CLOSED
            yield from self._delay(self._settings[26] / 1000)
            if self._flags.reset:
                return _HOMING_RESET
        machine.found_home(axes)
        return 0


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
