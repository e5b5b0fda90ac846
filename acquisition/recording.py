"""Recording a plan: the scene is set for each frame, the frame taken, checked and put on the disk.

Scans and photographs are recorded alike. What is left out is decided from the frames on the disk
alone, so that a recording that was cut off anywhere goes on as if it had not been.
A frame is put on the disk while the next one is exposed.
Lights go out and motion stops on every way out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from acquisition.adaptive_bracket import AdaptiveBracket, Need
from acquisition.disk_space import bytes_needed, frame_bytes, require_space
from acquisition.frame_choice import Choice
from acquisition.frame_files import Samples
from acquisition.metered_code import MeteredCode
from acquisition.patterns import BLACK, WHITE
from acquisition.plan import Plan, PlannedFrame, Purpose
from acquisition.scene_setting import SceneSetter
from acquisition.session_writer import SessionWriter
from acquisition.write_behind import WriteBehind
from devices.errors import DeviceError, FrameOrderError
from devices.frame_order import differ_beyond_noise
from devices.interfaces import Frame
from devices.manual_mount import nobody_confirms
from devices.rig import Rig


def record_plan(
    writer: SessionWriter,
    rig: Rig,
    *,
    advance: Callable[[str], None] = lambda frame_id: None,
    confirm: Callable[[str], bool] = nobody_confirms,
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Capture what a session still misses of its plan, and finish it.

    Also goes on with a resumed session. Everything is dark and still afterwards, whatever happens.

    Parameters
    ----------
    writer : SessionWriter
        The session being recorded.
    rig : Rig
        With the devices that the plan needs.
    advance : callable, optional
        Called with each frame id once it is taken or skipped; it may be on its way to the disk yet.
    confirm : callable, optional
        Asks the person at the desk to put a target before the painting; true once that is done.
    wait : callable, optional
        Waits for some seconds while the lamp warms up.

    Raises
    ------
    DeviceError
        The devices are not those of the plan, one of them failed, or a frame came twice, out of
        turn, or from before its light was there; or white is darker than black.
    SessionError
        The disk is full, or fails.
    """
    plan = writer.plan
    missing = len(writer.missing)
    require_space(writer.path, bytes_needed(plan, frames=missing), what=f"{missing} frames")
    scene = SceneSetter(plan, rig, confirm=confirm, wait=wait)
    flats = _Flats(plan)
    rig.begin_recording()
    with WriteBehind() as disk:
        try:
            _check_devices(plan, rig)
            rig.blank()
            for planned, need in _needs(writer, disk):
                if need is None or need.needed:
                    frame = _take(writer, rig, planned, scene=scene)
                    flats.check(planned, frame.image)
                    write = partial(_record, writer, planned, frame, need)
                else:
                    write = partial(_skip, writer, planned, need)
                disk.submit(write)
                advance(planned.id)
            disk.settle()
            writer.finish()
        finally:
            rig.make_safe()


def _needs(
    writer: SessionWriter, disk: WriteBehind
) -> Iterator[tuple[PlannedFrame, Need | Choice | None]]:
    """Frames that are missing, each with whether it is needed; None for those that surely are.

    In the order of the plan, but that metering frames come before those that they tell of.
    """
    missing = set(writer.missing)
    brackets, metered = _Brackets(writer), MeteredCode(writer)
    for number, planned in enumerate(writer.plan.frames):
        if planned.id not in missing:
            continue
        if brackets.asks_of(number) or metered.reads_for(planned):
            disk.settle()
        for frame in metered.frames_before(planned):
            missing.discard(frame.id)
            yield frame, None
            disk.settle()
        if planned.id not in missing:
            continue
        choice = metered.choice_of(planned)
        yield planned, brackets.need_of(number) if choice is None else choice


def _take(writer: SessionWriter, rig: Rig, planned: PlannedFrame, *, scene: SceneSetter) -> Frame:
    """Take one frame."""
    if planned.exposure_s is None:
        raise DeviceError(f"frame {planned.id}: the plan names no exposure")
    # Another one may be on its way to the disk.
    require_space(writer.path, 2 * frame_bytes(writer.plan), what=f"frame {planned.id}")
    scene.set_for(planned)
    return rig.capture(planned.exposure_s)


def _record(
    writer: SessionWriter, planned: PlannedFrame, frame: Frame, need: Need | Choice | None
) -> None:
    writer.record(
        planned.id,
        frame.image,
        sequence=frame.sequence,
        exposure_applied_s=frame.exposure_applied_s,
        monotonic_s=frame.monotonic_s,
        wall_time=frame.wall_time,
        subject=frame.subject,
        needed_by=None if need is None else need.pixels,
    )


def _skip(writer: SessionWriter, planned: PlannedFrame, need: Need | Choice) -> None:
    writer.skip(planned.id, reason=need.reason, pixels=need.pixels, saturating=need.saturating)


class _Brackets:
    """Which frames of brackets are needed, by what is on the disk of the frames before them."""

    def __init__(self, writer: SessionWriter) -> None:
        self._writer = writer
        self._plan = writer.plan
        self._name: str | None = None
        self._bracket: AdaptiveBracket | None = None
        self._added: set[str] = set()
        self._black_levels: dict[str | None, float] = {}

    def asks_of(self, number: int) -> bool:
        """Whether frames before a planned one, which must be on the disk, tell if it is needed."""
        frames = self._plan.frames
        name = frames[number].bracket
        asked = self._plan.bracketing is not None and name is not None
        return asked and number > 0 and frames[number - 1].bracket == name

    def need_of(self, number: int) -> Need | None:
        """Need of a planned frame; None where :meth:`asks_of` says no."""
        frames = self._plan.frames
        planned, rule = frames[number], self._plan.bracketing
        if rule is None or not self.asks_of(number):
            return None
        first = number
        while first > 0 and frames[first - 1].bracket == planned.bracket:
            first -= 1
        if self._name != planned.bracket or self._bracket is None:
            self._name, self._added = planned.bracket, set()
            self._bracket = AdaptiveBracket(
                rule,
                black_level=self._black_level(number),
                saturation_level=self._plan.saturation_level,
            )
        session = self._writer.so_far
        for before in frames[first:number]:
            if before.id in session.recorded and before.id not in self._added:
                exposure = session.exposure_s(before.id)
                assert exposure is not None  # in brackets every frame has one
                self._bracket.add(session.read_frame(before.id), exposure)
                self._added.add(before.id)
        after = frames[number + 1] if number + 1 < len(frames) else None
        follows = after is not None and after.bracket == planned.bracket
        assert planned.exposure_s is not None
        return self._bracket.need_of(
            planned.exposure_s, next_s=after.exposure_s if follows and after is not None else None
        )

    def _black_level(self, number: int) -> float:
        """Median of the last dark frame before a bracket, of the shortest exposure from there."""
        place = self._plan.frames[number].camera_position
        if place not in self._black_levels:
            dark = [
                frame
                for frame in self._plan.frames[:number]
                if frame.purpose is Purpose.DARK and frame.camera_position == place
            ]
            level = 0.0
            if dark:
                shortest = min(dark, key=lambda frame: frame.exposure_s or 0.0)
                level = float(np.median(self._writer.so_far.read_frame(shortest.id)))
            self._black_levels[place] = level
        return self._black_levels[place]


class _Flats:
    """The white and black frames of a scan, of which white must be the brighter one.

    A projector that shows each picture one late would otherwise shift a whole scan.
    """

    def __init__(self, plan: Plan) -> None:
        self._saturation_level = plan.saturation_level
        self._seen: dict[tuple[bool, str | None, float | None], tuple[str, Samples]] = {}

    def check(self, planned: PlannedFrame, image: Samples) -> None:
        """Hold a white frame against the last black one of its exposure, and a black against white.

        Raises
        ------
        FrameOrderError
            White is darker than black, by more than noise.
        """
        if planned.pattern not in (WHITE, BLACK):
            return
        is_white = planned.pattern == WHITE
        taken = planned.camera_position, planned.exposure_s
        self._seen[is_white, *taken] = planned.id, image
        if (not is_white, *taken) not in self._seen:
            return
        white_id, white = self._seen[True, *taken]
        black_id, black = self._seen[False, *taken]
        if white.mean() < black.mean() and differ_beyond_noise(
            white, black, saturation_level=self._saturation_level
        ):
            raise FrameOrderError(
                f"frame {white_id} (white) is darker than frame {black_id} (black): the projector "
                "shows each picture later than it says; raise its latency in rig.toml, and scan "
                "anew"
            )


def _check_devices(plan: Plan, rig: Rig) -> None:
    """Refuse devices that the plan was not made for: its patterns would mean something else."""
    devices = [("camera", rig.camera.capabilities, plan.camera)]
    if any(frame.pattern is not None for frame in plan.frames):
        devices.append(("projector", rig.projector.capabilities, plan.projector))  # type: ignore[arg-type]
    for name, device, planned in devices:
        if device.size != (planned.width, planned.height):
            raise DeviceError(
                f"the plan is for a {name} of {planned.width}×{planned.height} pixels, this one "
                f"has {device.size[0]}×{device.size[1]}; connect the right one, or make a new plan"
            )
    mosaic = rig.camera.capabilities.bayer
    # Plans of earlier versions do not say which.
    if plan.camera.mosaic not in (None, mosaic):
        raise DeviceError(
            f"the plan is for a camera with a mosaic of {plan.camera.mosaic}, this one "
            f"{'is monochrome' if mosaic is None else f'has {mosaic}'}; connect the right one, set "
            "its pixel format back, or make a new plan"
        )
    saturation = rig.camera.capabilities.saturation_level
    if saturation != plan.saturation_level:
        raise DeviceError(
            f"the plan is for a camera that saturates at {plan.saturation_level}, this one does at "
            f"{saturation}; set the pixel format back, or make a new plan"
        )
    unknown = [name for name in plan.camera_positions if name not in rig.camera_positions]
    if unknown:
        raise DeviceError(
            f"the plan has the camera at {unknown[0]!r}, which this rig has no place for; name it "
            "in the [mount] table of rig.toml, or make a new plan"
        )
    for frame in plan.frames:
        if frame.arm_pose is not None:
            rig.arm.capabilities.limits.check(frame.arm_pose)
