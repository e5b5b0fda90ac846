"""Which frames of a projected code a recording takes, by what is on the disk of its first frames.

The choice is a function of the plan and of those frames alone: a recording that is resumed, or
replayed, chooses the same.
"""

from __future__ import annotations

from acquisition.even_steps import metering_steps
from acquisition.frame_choice import Choice, choose_frames
from acquisition.fringes import find_fringes
from acquisition.metering import measure_light, metering_exposure
from acquisition.plan import Plan, PlannedFrame, Purpose
from acquisition.session_writer import SessionWriter


class MeteredCode:
    """Chooses frames of the projected codes of a session being recorded.

    Parameters
    ----------
    writer : SessionWriter
    """

    def __init__(self, writer: SessionWriter) -> None:
        self._writer = writer
        self._rule = writer.plan.metering
        self._exposures: dict[str | None, float] = {}
        self._chosen: dict[str | None, dict[str, Choice]] = {}

    def asks_of(self, frame: PlannedFrame) -> bool:
        """Whether frames before a planned one tell if it is needed."""
        return self._rule is not None and frame.is_metered

    def reads_for(self, frame: PlannedFrame) -> bool:
        """Whether frames will be read from the disk to tell, which must be there then."""
        return self.asks_of(frame) and frame.camera_position not in self._chosen

    def frames_before(self, frame: PlannedFrame) -> list[PlannedFrame]:
        """Frames that must be taken before it can be told whether a planned one is needed.

        White and black frames must be on the disk.
        """
        if not self.reads_for(frame):
            return []
        names = self._metering_frames(frame.camera_position)
        settled = self._writer.so_far.recorded
        return [f for f in self._writer.plan.frames if f.id in names and f.id not in settled]

    def choice_of(self, frame: PlannedFrame) -> Choice | None:
        """Whether a planned frame is needed; None where :meth:`asks_of` says no.

        Metering frames must be on the disk.
        """
        if not self.asks_of(frame):
            return None
        place = frame.camera_position
        if place not in self._chosen:
            if place not in self._exposures:
                self._metering_frames(place)
            self._chosen[place] = choose_frames(
                self._code(place),
                measure_light(
                    self._code(place),
                    self._writer.so_far.read_frame,
                    exposure_s=self._exposures[place],
                ),
                exposure_s=self._exposures[place],
            )
        return self._chosen[place].get(frame.id)

    def _metering_frames(self, place: str | None) -> set[str]:
        assert self._rule is not None  # nothing is metered without
        code = self._code(place)
        if place not in self._exposures:
            self._exposures[place] = metering_exposure(code, self._writer.so_far.read_frame)
        return {
            name
            for fringe in find_fringes(code)
            if fringe.exposure_s == self._exposures[place]
            for name in metering_steps(fringe, self._rule)
        }

    def _code(self, place: str | None) -> Plan:
        code = self._writer.plan.only(purpose=Purpose.CODE, camera_position=place)
        assert code is not None  # a frame of it was asked about
        return code
