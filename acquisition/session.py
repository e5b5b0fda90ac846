"""Reading a session: every file checked against the manifest before it is believed.

A session is a folder with ``plan.json``, ``journal.jsonl``, ``frames/``, optionally ``rig.toml``
and ``calibration/``, and ``manifest.sha256``, which the recording writes last. The manifest covers
everything but the journal, whose times differ from one recording to the next and whose lines carry
checksums of their own, and the contact sheet, which can be drawn anew.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from acquisition.errors import SessionError
from acquisition.file_tree import files_below
from acquisition.frame_files import SUFFIX, Samples, decode_frame
from acquisition.journal import (
    AnyEvent,
    FrameRecorded,
    FrameSkipped,
    Start,
    Stop,
    StopReason,
    read_journal,
    settled_frames,
)
from acquisition.plan import Plan, PlannedFrame, Purpose

PLAN_FILE = "plan.json"
JOURNAL_FILE = "journal.jsonl"
MANIFEST_FILE = "manifest.sha256"
RIG_FILE = "rig.toml"
FRAMES_FOLDER = "frames"
CALIBRATION_FOLDER = "calibration"
CONTACT_SHEET_FILE = "contact-sheet.png"
# What the manifest does not cover.
_UNCOVERED = {JOURNAL_FILE, MANIFEST_FILE, CONTACT_SHEET_FILE}


@dataclass(frozen=True)
class Session:
    """A finished session on disk.

    Attributes
    ----------
    path : Path
        The folder.
    plan : Plan
        What was captured.
    digest : str
        SHA-256 of the manifest: the identity of everything recorded.
    recorded : dict
        :class:`~acquisition.journal.FrameRecorded` by frame id.
    skipped : dict
        :class:`~acquisition.journal.FrameSkipped` by frame id: planned, but not needed.
    """

    path: Path
    plan: Plan
    digest: str
    recorded: dict[str, FrameRecorded]
    skipped: dict[str, FrameSkipped] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path) -> Session:
        """Open a session and check that it is whole.

        Frame files are checked against their digests when they are read.

        Raises
        ------
        SessionError
            A file is missing, damaged, or not in the manifest; or the recording did not finish.
        """
        path = Path(path)
        if not path.is_dir():
            raise SessionError(f"{path}: no such session folder")
        plan = read_plan(path)
        events = read_journal(path / JOURNAL_FILE)
        recorded, skipped = settled_frames(events)
        last = events[-1] if events else None
        if not (isinstance(last, Stop) and last.reason is StopReason.SUCCESS):
            state = f"{last.reason}: {last.why}" if isinstance(last, Stop) else "cut off"
            raise SessionError(
                f"{path}: the recording did not finish ({state}; {len(recorded)} of "
                f"{len(plan.frames)} frames); resume it first"
            )
        manifest = _read_manifest(path / MANIFEST_FILE)
        _check_skipped(path, plan, recorded, skipped)
        _check_files(path, manifest, plan, recorded, skipped)
        digest = hashlib.sha256((path / MANIFEST_FILE).read_bytes()).hexdigest()
        return cls(path, plan, digest, recorded, skipped)

    @property
    def calibration_folder(self) -> Path | None:
        """Folder of the calibration in force at the recording, if there was one."""
        folder = self.path / CALIBRATION_FOLDER
        return folder if folder.is_dir() else None

    @property
    def frames(self) -> tuple[PlannedFrame, ...]:
        """Planned frames that were recorded, in the order of the plan."""
        return tuple(frame for frame in self.plan.frames if frame.id in self.recorded)

    def plan_of(self, purpose: Purpose, *, camera_position: str | None = None) -> Plan:
        """The part of the plan that was recorded for a purpose, as decoding takes it.

        Parameters
        ----------
        purpose : Purpose
        camera_position : str, optional
            By default, wherever the camera stood.

        Raises
        ------
        SessionError
            Nothing was recorded for it.
        """
        recorded = self.plan.model_copy(update={"frames": self.frames})
        part = recorded.only(purpose=purpose, camera_position=camera_position)
        if part is None:
            where = "" if camera_position is None else f" with the camera at {camera_position!r}"
            raise SessionError(f"{self.path} holds no frame for {purpose}{where}")
        return part

    def exposure_s(self, frame_id: str) -> float | None:
        """Exposure time of a frame: as the camera reported it, else as asked for, else None.

        Raises
        ------
        SessionError
            The frame was not recorded.
        """
        applied = self._entry(frame_id).exposure_applied_s
        if applied is not None:
            return applied
        return next(frame.exposure_s for frame in self.plan.frames if frame.id == frame_id)

    def read_frame(self, frame_id: str) -> Samples:
        """Sensor numbers of a frame.

        Returns
        -------
        (rows, cols) uint8 or uint16 array

        Raises
        ------
        SessionError
            The frame was not recorded, its file was altered, or it has another size than planned.
        """
        entry = self._entry(frame_id)
        file = self.path / entry.file
        try:
            content = file.read_bytes()
        except FileNotFoundError:
            raise SessionError(f"{file} is missing") from None
        if hashlib.sha256(content).hexdigest() != entry.sha256:
            raise SessionError(
                f"{file}: truncated or altered since it was recorded (digest differs); take it "
                "from a backup"
            )
        image = decode_frame(content, path=file)
        expected = (self.plan.crop.height, self.plan.crop.width)
        if image.shape != expected:
            raise SessionError(f"{file}: {image.shape}, the plan says {expected}")
        return image

    def _entry(self, frame_id: str) -> FrameRecorded:
        if frame_id not in self.recorded:
            raise SessionError(f"{self.path}: frame {frame_id} was not recorded")
        return self.recorded[frame_id]


def read_plan(path: Path) -> Plan:
    """Plan of a session folder.

    Raises
    ------
    SessionError
        Missing or malformed.
    """
    file = path / PLAN_FILE
    try:
        return Plan.model_validate_json(file.read_bytes())
    except FileNotFoundError:
        raise SessionError(f"{file} is missing: this is not a session") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise SessionError(f"{file}: {where}: {first['msg']}") from None


def frame_file(frame_id: str) -> str:
    """Path of a frame's file inside its session."""
    return f"{FRAMES_FOLDER}/{frame_id}{SUFFIX}"


def digests_of(path: Path) -> dict[str, str]:
    """SHA-256 of every file below a session folder that the manifest covers, by its path."""
    return {
        name: hashlib.sha256((path / name).read_bytes()).hexdigest()
        for name in sorted(files_below(path).keys() - _UNCOVERED)
    }


def check_beginning(path: Path, events: Iterable[AnyEvent]) -> None:
    """Compare plan, rig and calibration of a session that has no manifest yet with its journal.

    Raises
    ------
    SessionError
        One of them was altered or is missing.
    """
    begun = next((e.files for e in events if isinstance(e, Start) and e.files), {})
    for name, digest in begun.items():
        file = path / name
        if not file.is_file():
            raise SessionError(f"{file} is missing: take it from a backup")
        if hashlib.sha256(file.read_bytes()).hexdigest() != digest:
            raise SessionError(
                f"{file}: altered since the recording began (digest differs); take it from a backup"
            )


def manifest_text(path: Path, recorded: Iterable[FrameRecorded]) -> str:
    """Manifest of a session folder: a digest and a path per line, sorted by path.

    Parameters
    ----------
    path : Path
    recorded : iterable of FrameRecorded
        Their digests are those of what was written; other files are read.
    """
    known = {entry.file: entry.sha256 for entry in recorded}

    def digest(name: str) -> str:
        return known.get(name) or hashlib.sha256((path / name).read_bytes()).hexdigest()

    covered = sorted(files_below(path).keys() - _UNCOVERED)
    return "".join(f"{digest(name)}  {name}\n" for name in covered)


def _read_manifest(file: Path) -> dict[str, str]:
    try:
        # Not read_text, to which other bytes than a newline are ends of lines too.
        *lines, rest = file.read_bytes().decode().split("\n")
    except FileNotFoundError:
        raise SessionError(
            f"{file} is missing though the recording finished: the session was damaged, take it "
            "from a backup"
        ) from None
    except UnicodeDecodeError:
        raise SessionError(f"{file}: not a text file") from None
    if rest:
        raise SessionError(f"{file}: its last line is torn; take it from a backup")
    entries: dict[str, str] = {}
    for number, line in enumerate(lines, start=1):
        digest, separator, name = line.partition("  ")
        if not separator or len(digest) != 64 or name in entries:
            raise SessionError(f"{file}, line {number}: not a digest and a path of its own")
        entries[name] = digest
    return entries


def _check_skipped(
    path: Path,
    plan: Plan,
    recorded: dict[str, FrameRecorded],
    skipped: dict[str, FrameSkipped],
) -> None:
    """Only frames that the plan leaves to the recording may be missing from it."""
    wrong = sorted((set(skipped) - plan.optional_frames) | (set(skipped) & set(recorded)))
    if wrong:
        raise SessionError(
            f"{path / JOURNAL_FILE} says that frame {wrong[0]} was skipped, and it was recorded or "
            "may not be skipped by the plan: the session was damaged, take it from a backup"
        )


def _check_files(
    path: Path,
    manifest: dict[str, str],
    plan: Plan,
    recorded: dict[str, FrameRecorded],
    skipped: dict[str, FrameSkipped],
) -> None:
    """Compare the folder with the manifest; frames by name and journal, the rest by content."""
    for frame in plan.frames:
        if frame.id in skipped:
            continue
        entry = recorded.get(frame.id)
        if entry is None:
            raise SessionError(f"{path}: frame {frame.id} is planned but was not recorded")
        if entry.file != frame_file(frame.id) or manifest.get(entry.file) != entry.sha256:
            raise SessionError(
                f"{path / MANIFEST_FILE} and {path / JOURNAL_FILE} disagree about frame {frame.id}"
            )
    there = files_below(path).keys() - _UNCOVERED
    missing, extra = sorted(set(manifest) - there), sorted(there - set(manifest))
    if missing:
        raise SessionError(f"{path / missing[0]} is missing ({len(missing)} files in all)")
    if extra:
        raise SessionError(f"{path / extra[0]} does not belong to the session; remove it")
    for name, digest in manifest.items():
        if name.startswith(f"{FRAMES_FOLDER}/"):
            continue
        if hashlib.sha256((path / name).read_bytes()).hexdigest() != digest:
            raise SessionError(f"{path / name}: altered since it was recorded (digest differs)")
