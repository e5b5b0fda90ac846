"""Recording a session so that a frame once acknowledged is never lost.

A frame goes to a temporary file, is flushed, renamed, and only then entered in the journal. A
recording cut off anywhere can be resumed and ends with the same manifest.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO

from acquisition.atomic_files import folder_in_progress, remove_leftovers, write_bytes
from acquisition.errors import SessionError
from acquisition.frame_files import Samples, encode_frame
from acquisition.journal import (
    AnyEvent,
    FrameRecorded,
    FrameSkipped,
    SkipReason,
    Start,
    Stop,
    StopReason,
    append_event,
    lock_journal,
    read_journal,
    settled_frames,
)
from acquisition.plan import Plan
from acquisition.session import (
    CALIBRATION_FOLDER,
    FRAMES_FOLDER,
    JOURNAL_FILE,
    MANIFEST_FILE,
    PLAN_FILE,
    RIG_FILE,
    Session,
    check_beginning,
    digests_of,
    frame_file,
    manifest_text,
    read_plan,
)
from devices.interfaces import Subject

_STAYS_VALID = "what was recorded stays valid, and can be resumed"


class SessionWriter:
    """A session being recorded; made by :meth:`create` or :meth:`resume`.

    As a context manager it notes in the journal why the recording ended: an error leaves it
    ``failed``, an interruption ``aborted``; :meth:`finish` makes it a success.
    """

    def __init__(
        self,
        path: Path,
        plan: Plan,
        recorded: dict[str, FrameRecorded],
        skipped: dict[str, FrameSkipped],
        *,
        lock: IO[bytes],
    ) -> None:
        self._path = path
        self._plan = plan
        self._recorded = recorded
        self._skipped = skipped
        self._lock = lock
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
            The folder holds something already, or cannot be written.
        """
        path = Path(path)
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise SessionError(f"{path} exists already; choose another place, or resume it")
        # An empty folder gives way; one in which another process begins a session meanwhile stays.
        with contextlib.suppress(OSError):
            path.rmdir()
        with _explaining(path, "no frame is recorded yet"), folder_in_progress(path) as begun:
            (begun / FRAMES_FOLDER).mkdir()
            if rig_toml is not None:
                write_bytes(begun / RIG_FILE, rig_toml.encode())
            if calibration is not None:
                _copy_files(calibration, begun / CALIBRATION_FOLDER)
            write_bytes(begun / PLAN_FILE, plan.model_dump_json(indent=1).encode())
            append_event(begun / JOURNAL_FILE, Start(**_now(), files=digests_of(begun)))
            # The lock stays with the file when the folder gets its name.
            lock = lock_journal(begun / JOURNAL_FILE)
        return cls(path, plan, {}, {}, lock=lock)

    @classmethod
    def resume(cls, path: Path) -> SessionWriter:
        """Go on with a session that was cut off.

        Raises
        ------
        SessionError
            No plan or journal, one that was damaged, a session that is complete, that is being
            recorded, or that cannot be written.
        """
        path = Path(path)
        plan = read_plan(path)
        journal = path / JOURNAL_FILE
        if not journal.exists():
            read_journal(journal)  # says what that means
        with _explaining(path, _STAYS_VALID), contextlib.ExitStack() as locked:
            lock = locked.enter_context(lock_journal(journal))
            events = read_journal(journal)
            if any(isinstance(e, Stop) and e.reason is StopReason.SUCCESS for e in events):
                raise SessionError(f"{path}: the recording is complete, there is nothing to resume")
            check_beginning(path, events)
            acknowledged, skipped = settled_frames(events)
            # A frame whose file was lost or altered since is taken again.
            recorded = {e.id: e for e in acknowledged.values() if _is_there(path, e)}
            _remove_unacknowledged(path, recorded)
            append_event(journal, Start(**_now(), resumed=True))
            locked.pop_all()
        return cls(path, plan, recorded, skipped, lock=lock)

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
        """Ids of the planned frames that are neither recorded yet nor skipped, in order."""
        settled = self._recorded.keys() | self._skipped.keys()
        return [frame.id for frame in self._plan.frames if frame.id not in settled]

    @property
    def so_far(self) -> Session:
        """What is recorded, as a session without a digest."""
        return Session(self._path, self._plan, "", dict(self._recorded), dict(self._skipped))

    def record(
        self,
        frame_id: str,
        image: Samples,
        *,
        sequence: int,
        exposure_applied_s: float | None = None,
        monotonic_s: float | None = None,
        wall_time: float | None = None,
        subject: Subject | None = None,
        needed_by: int | None = None,
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
        subject : Subject, optional
            What it is a picture of, as far as the rig knew.
        needed_by : int, optional
            Number of pixels that an adaptive bracket took it for.

        Raises
        ------
        SessionError
            Not a planned frame, recorded already, of the wrong size or type, or it cannot be
            written; then what was recorded before it stays valid.
        """
        if frame_id not in {frame.id for frame in self._plan.frames}:
            raise SessionError(f"frame {frame_id} is not in the plan")
        if frame_id in self._recorded or frame_id in self._skipped:
            raise SessionError(f"frame {frame_id} is recorded or skipped already")
        expected = (self._plan.crop.height, self._plan.crop.width)
        if image.shape != expected:
            raise SessionError(f"frame {frame_id} is {image.shape}, the plan says {expected}")
        content = encode_frame(image, name=frame_id)
        name = frame_file(frame_id)
        now = _now()
        event = FrameRecorded(
            wall_time=now["wall_time"] if wall_time is None else wall_time,
            monotonic_s=now["monotonic_s"] if monotonic_s is None else monotonic_s,
            id=frame_id,
            file=name,
            sha256=_sha256(content),
            sequence=sequence,
            exposure_applied_s=exposure_applied_s,
            subject=subject,
            needed_by=needed_by,
        )
        with _explaining(self._path / name, _STAYS_VALID):
            write_bytes(self._path / name, content)
            self._append(event)
        self._recorded[frame_id] = event

    def skip(self, frame_id: str, *, reason: SkipReason, pixels: int, saturating: int) -> None:
        """Note in the journal that a planned frame is not needed.

        Parameters
        ----------
        frame_id : str
        reason : SkipReason
        pixels : int
            Number that would have gained by it.
        saturating : int
            Number that it was predicted to saturate.

        Raises
        ------
        SessionError
            The plan does not leave this frame to the recording, it is recorded already, or the
            journal cannot be written.
        """
        if frame_id not in self._plan.optional_frames:
            raise SessionError(f"frame {frame_id} is none that the plan allows to be skipped")
        if frame_id in self._recorded or frame_id in self._skipped:
            raise SessionError(f"frame {frame_id} is recorded or skipped already")
        event = FrameSkipped(
            **_now(), id=frame_id, reason=reason, pixels=pixels, saturating=saturating
        )
        with _explaining(self._path / JOURNAL_FILE, _STAYS_VALID):
            self._append(event)
        self._skipped[frame_id] = event

    def finish(self) -> None:
        """Write the manifest and close the session.

        Raises
        ------
        SessionError
            Frames are still missing, or the manifest cannot be written.
        """
        if self.missing:
            raise SessionError(
                f"{self._path}: {len(self.missing)} frames are still to be captured, the first is "
                f"{self.missing[0]}"
            )
        with _explaining(self._path / MANIFEST_FILE, _STAYS_VALID):
            manifest = manifest_text(self._path, self._recorded.values())
            write_bytes(self._path / MANIFEST_FILE, manifest.encode())
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
            # A disk that is full may take no last line either; what is told is the first failure.
            with contextlib.suppress(OSError):
                self._stop(reason, str(error) if error else "left before the end")
        self._lock.close()

    def _stop(self, reason: StopReason, why: str) -> None:
        self._append(Stop(**_now(), reason=reason, why=why))
        self._open = False
        self._lock.close()

    def _append(self, event: AnyEvent) -> None:
        append_event(self._path / JOURNAL_FILE, event)


@contextlib.contextmanager
def _explaining(file: Path, so_far: str) -> Iterator[None]:
    """Say what a failure of the disk means for the session."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        advice = "free some space" if full else "look at the disk"
        raise SessionError(
            f"{file} cannot be written ({error.strerror or error}): {so_far}; {advice}, then go on"
        ) from error


def _copy_files(source: Path, destination: Path) -> None:
    """Copy a folder of files so that they are safe on the disk."""
    destination.mkdir()
    for file in sorted(source.iterdir()):
        if file.is_file():
            write_bytes(destination / file.name, file.read_bytes())


def _is_there(path: Path, entry: FrameRecorded) -> bool:
    """Whether a frame's file is what was written."""
    file = path / entry.file
    return file.is_file() and _sha256(file.read_bytes()) == entry.sha256


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
