"""Recording a session so that a frame once acknowledged is never lost.

A frame goes to a temporary file, is flushed, renamed, and only then entered in the journal. A
recording cut off anywhere can be resumed and ends with the same manifest.
"""

from __future__ import annotations

import hashlib
import time
from pathlib import Path
from types import TracebackType

from acquisition.atomic_files import folder_in_progress, remove_leftovers, write_bytes
from acquisition.errors import SessionError
from acquisition.frame_files import Samples, encode_frame
from acquisition.journal import (
    FrameRecorded,
    Start,
    Stop,
    StopReason,
    append_event,
    drop_torn_line,
    read_journal,
)
from acquisition.plan import Plan
from acquisition.session import (
    CALIBRATION_FOLDER,
    FRAMES_FOLDER,
    JOURNAL_FILE,
    MANIFEST_FILE,
    PLAN_FILE,
    RIG_FILE,
    frame_file,
    manifest_text,
    read_plan,
)


class SessionWriter:
    """A session being recorded; made by :meth:`create` or :meth:`resume`.

    As a context manager it notes in the journal why the recording ended: an error leaves it
    ``failed``, an interruption ``aborted``; :meth:`finish` makes it a success.
    """

    def __init__(self, path: Path, plan: Plan, recorded: dict[str, FrameRecorded]) -> None:
        self._path = path
        self._plan = plan
        self._recorded = recorded
        self._open = True

    @classmethod
    def create(
        cls,
        path: Path,
        plan: Plan,
        *,
        rig_toml: str | None = None,
        calibration: Path | None = None,
    ) -> SessionWriter:
        """Begin a session. Its folder appears with plan and journal in it, or not at all.

        Parameters
        ----------
        path : Path
            Folder to make; it must not exist, or be empty.
        plan : Plan
            What will be captured.
        rig_toml : str, optional
            Description of the rig in force.
        calibration : Path, optional
            Folder of the calibration in force; copied.

        Raises
        ------
        SessionError
            The folder holds something already.
        """
        path = Path(path)
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise SessionError(f"{path} exists already; choose another place, or resume it")
        with folder_in_progress(path, replace=True) as begun:
            (begun / FRAMES_FOLDER).mkdir()
            if rig_toml is not None:
                write_bytes(begun / RIG_FILE, rig_toml.encode())
            if calibration is not None:
                _copy_files(calibration, begun / CALIBRATION_FOLDER)
            write_bytes(begun / PLAN_FILE, plan.model_dump_json(indent=1).encode())
            append_event(begun / JOURNAL_FILE, Start(**_now()))
        return cls(path, plan, {})

    @classmethod
    def resume(cls, path: Path) -> SessionWriter:
        """Go on with a session that was cut off.

        Raises
        ------
        SessionError
            No plan or journal, a damaged journal, or a session that is complete.
        """
        path = Path(path)
        plan = read_plan(path)
        events = read_journal(path / JOURNAL_FILE)
        if any(isinstance(e, Stop) and e.reason is StopReason.SUCCESS for e in events):
            raise SessionError(f"{path}: the recording is complete, there is nothing to resume")
        drop_torn_line(path / JOURNAL_FILE)
        recorded = {}
        for event in events:
            if isinstance(event, FrameRecorded):
                file = path / event.file
                # A frame whose file was lost or altered since is taken again.
                if file.is_file() and _sha256(file.read_bytes()) == event.sha256:
                    recorded[event.id] = event
        _remove_unacknowledged(path, recorded)
        append_event(path / JOURNAL_FILE, Start(**_now(), resumed=True))
        return cls(path, plan, recorded)

    @property
    def path(self) -> Path:
        """The session's folder."""
        return self._path

    @property
    def plan(self) -> Plan:
        """What is being captured."""
        return self._plan

    @property
    def missing(self) -> list[str]:
        """Ids of the planned frames that are not recorded yet, in order."""
        return [frame.id for frame in self._plan.frames if frame.id not in self._recorded]

    def record(
        self,
        frame_id: str,
        image: Samples,
        *,
        sequence: int,
        exposure_applied_s: float | None = None,
        monotonic_s: float | None = None,
        wall_time: float | None = None,
    ) -> None:
        """Put a frame on the disk and acknowledge it in the journal.

        Parameters
        ----------
        frame_id : str
            Which planned frame this is.
        image : (rows, cols) uint8 or uint16 array
            Sensor numbers.
        sequence : int
            The camera's frame number.
        exposure_applied_s : float, optional
            Exposure that the camera reports.
        monotonic_s, wall_time : float, optional
            When it was exposed; now by default.

        Raises
        ------
        SessionError
            Not a planned frame, recorded already, or of the wrong size or type.
        """
        if frame_id not in {frame.id for frame in self._plan.frames}:
            raise SessionError(f"frame {frame_id} is not in the plan")
        if frame_id in self._recorded:
            raise SessionError(f"frame {frame_id} is recorded already")
        expected = (self._plan.crop.height, self._plan.crop.width)
        if image.shape != expected:
            raise SessionError(f"frame {frame_id} is {image.shape}, the plan says {expected}")
        content = encode_frame(image, name=frame_id)
        name = frame_file(frame_id)
        write_bytes(self._path / name, content)
        now = _now()
        event = FrameRecorded(
            wall_time=now["wall_time"] if wall_time is None else wall_time,
            monotonic_s=now["monotonic_s"] if monotonic_s is None else monotonic_s,
            id=frame_id,
            file=name,
            sha256=_sha256(content),
            sequence=sequence,
            exposure_applied_s=exposure_applied_s,
        )
        append_event(self._path / JOURNAL_FILE, event)
        self._recorded[frame_id] = event

    def finish(self) -> None:
        """Write the manifest and close the session.

        Raises
        ------
        SessionError
            Frames are still missing.
        """
        if self.missing:
            raise SessionError(
                f"{self._path}: {len(self.missing)} frames are still to be captured, the first is "
                f"{self.missing[0]}"
            )
        write_bytes(self._path / MANIFEST_FILE, manifest_text(self._path).encode())
        self._stop(StopReason.SUCCESS, "")

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._open:
            interrupted = kind is None or not issubclass(kind, Exception)
            reason = StopReason.ABORTED if interrupted else StopReason.FAILED
            self._stop(reason, str(error) if error else "left before the end")

    def _stop(self, reason: StopReason, why: str) -> None:
        append_event(self._path / JOURNAL_FILE, Stop(**_now(), reason=reason, why=why))
        self._open = False


def _copy_files(source: Path, destination: Path) -> None:
    """Copy a folder of files so that they are safe on the disk."""
    destination.mkdir()
    for file in sorted(source.iterdir()):
        if file.is_file():
            write_bytes(destination / file.name, file.read_bytes())


def _remove_unacknowledged(path: Path, recorded: dict[str, FrameRecorded]) -> None:
    """Remove what a killed recording left: temporary files, and frames not in the journal."""
    remove_leftovers(path)
    frames = path / FRAMES_FOLDER
    frames.mkdir(exist_ok=True)
    kept = {path / entry.file for entry in recorded.values()}
    for file in frames.iterdir():
        if file not in kept:
            file.unlink()


def _now() -> dict[str, float]:
    return {"wall_time": time.time(), "monotonic_s": time.monotonic()}


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
