"""Where a command may write: never over, into or around what it reads, nor into what others made.

Sessions, digital copies and calibrations are whole: a file more or less in one of them, and it is
not what was recorded or computed any more. What is looked at are names and the headers of JSON
files, so that a command can ask before it loads what its work needs.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from enum import StrEnum
from pathlib import Path

from devices.errors import ImpastoError


class DestinationError(ImpastoError):
    """A command was asked to write where something is that it must not change."""


class Kind(StrEnum):
    """Folders that commands make."""

    SESSION = "session"
    COPY = "digital copy"
    CALIBRATION = "calibration"
    DEMO = "demo"


# By it alone a folder is known as a demo, which --force may replace with all that it holds.
DEMO_FILE = "demo.json"
DEMO_FORMAT = "impasto-demo-1"
# Of JSON files that only such a folder holds, and what their format begins with. Named here, not
# where they are written, because importing that takes the numerical libraries.
_HEADERS = {
    Kind.SESSION: ("plan.json", "impasto-plan-"),
    Kind.COPY: ("copy.json", "impasto-copy-"),
    Kind.DEMO: (DEMO_FILE, "impasto-demo-"),
}
# Of a rig, or of a light arm by itself.
_CALIBRATIONS = (("camera.cameramodel", "projector.cameramodel"), ("light-arm.json",))
# Bytes of a name that leave room for what it is called while it is made (acquisition.atomic_files).
_LONGEST_NAME = 255 - len("..in-progress-12345678")
# A demo has places for other things; the rest is whole.
_WHOLE = (Kind.SESSION, Kind.COPY, Kind.CALIBRATION)


def kind_of(folder: Path) -> Kind | None:
    """What a folder is, by the files that only such a one holds; None if it is none of them."""
    for kind, (name, format_) in _HEADERS.items():
        if _format(folder / name).startswith(format_):
            return kind
    for names in _CALIBRATIONS:
        if all((folder / name).is_file() for name in names):
            return Kind.CALIBRATION
    return None


def check_destinations(
    *inputs: Path | None,
    makes: Mapping[str, Path | None] | None = None,
    fills: Mapping[str, Path | None] | None = None,
    writes: Mapping[str, Path | None] | None = None,
    beside: Mapping[str, Path | None] | None = None,
) -> None:
    """Refuse outputs that would change what is read, or one another, before any work.

    Parameters
    ----------
    inputs : Path or None
        Files and folders that the command reads; None where one was not named.
    makes : mapping of str to Path or None
        Folders that appear whole, by the option that names them. Nothing else is written into them.
        Whether one that exists may be replaced, :func:`check_replaced` tells.
    fills : mapping of str to Path or None
        Folders that files are added to.
    writes : mapping of str to Path or None
        Files.
    beside : mapping of str to Path or None
        Files that come with what is made; the folder that they lie in is made if needed.

    Raises
    ------
    DestinationError
        An output is, holds or lies in something that is read; lies in any session, copy or
        calibration; is or lies in what another option makes; or cannot be written there: a file
        where a folder is, the other way round, a file without a folder to lie in, or a name too
        long for the file system.
    """
    made, filled, written, coming = map(_named, (makes, fills, writes, beside))
    read = [path for path in inputs if path is not None]
    for name, path in (*made, *filled, *written, *coming):
        _check_name(name, path)
        _check_against_inputs(name, path, read)
        _check_surroundings(name, path)
    for name, path in filled:
        _check_filled(name, path)
    for name, path in written:
        if reason := why_no_file(path):
            raise DestinationError(f"{name} {reason}")
    for name, path in coming:
        if path.is_dir():
            raise DestinationError(f"{name} {path} is a folder: choose another place")
    _check_against_each_other(made, [*made, *filled, *written])
    _check_against_each_other([*coming, *written], [*filled, *written])


def check_replaced(path: Path, kind: Kind, *, force: bool, option: str = "--out") -> None:
    """Refuse a folder to be made that is there, unless it is to be replaced and is of its kind.

    Raises
    ------
    DestinationError
    """
    if not path.exists() and not path.is_symlink():
        return
    if kind_of(path) is not kind:
        raise DestinationError(
            f"{option} {path} exists already and is no {kind}: choose another place, or remove it "
            "first"
        )
    if not force:
        raise DestinationError(
            f"{option} {path} exists already; choose another place, or replace it with --force"
        )


def _check_against_inputs(name: str, path: Path, inputs: Iterable[Path]) -> None:
    for given in inputs:
        whole = _is_input_whole(given)
        for output in _places(path):
            for read in _places(given):
                if output == read:
                    raise DestinationError(
                        f"{name} {path} is what is read from: choose another place"
                    )
                if output in read.parents:
                    raise DestinationError(
                        f"{name} {path} holds {given}, which is read from: choose another place"
                    )
                if whole and read in output.parents:
                    raise DestinationError(
                        f"{name} {path} lies in {given}, which is read from and would not be what "
                        "it was any more: choose another place"
                    )


def _is_input_whole(folder: Path) -> bool:
    """Whether what is read takes nothing else into its folder, even if it is damaged."""
    named = any((folder / name).is_file() for name in ("plan.json", "copy.json"))
    return named or kind_of(folder) in _WHOLE


def _check_name(name: str, path: Path) -> None:
    if len(os.fsencode(path.name)) > _LONGEST_NAME:
        raise DestinationError(
            f"{name}: the name {path.name[:20]}… is too long, since it has a longer one while it "
            f"is made; choose one of {_LONGEST_NAME} bytes at most"
        )


def _check_surroundings(name: str, path: Path) -> None:
    for output in _places(path):
        for around in output.parents:
            kind = kind_of(around)
            if kind in _WHOLE:
                raise DestinationError(
                    f"{name} {path} lies in {around}, a {kind}, which would not be what it was any "
                    "more: choose another place"
                )
    near = next((place for place in path.absolute().parents if place.exists()), None)
    if near is not None and not near.is_dir():
        raise DestinationError(f"{name} {path}: {near} is no folder; choose another place")


def _check_filled(name: str, path: Path) -> None:
    kind = kind_of(path)
    if kind in _WHOLE:
        raise DestinationError(
            f"{name} {path} is a {kind}, which would not be what it was any more: choose another "
            "place"
        )
    if path.exists() and not path.is_dir():
        raise DestinationError(f"{name} {path} is a file; name a folder")


def why_no_file(path: Path) -> str | None:
    """Why a file cannot be written at a place, which is named; None if nothing is in the way."""
    if path.is_dir():
        return f"{path} is a folder; name a file"
    if path.exists() and not path.is_file():
        return f"{path} is a device or pipe, which it would replace; name a file"
    if not path.parent.is_dir():
        return f"{path}: there is no folder {path.parent}; make it first"
    return None


def _check_against_each_other(
    holders: Iterable[tuple[str, Path]], outputs: Iterable[tuple[str, Path]]
) -> None:
    for holder, outer in holders:
        for name, path in outputs:
            if name == holder:
                continue
            for place in _places(path):
                if any(place == o or o in place.parents for o in _places(outer)):
                    raise DestinationError(
                        f"{name} {path} is or lies in what {holder} names: choose another place"
                    )


def _named(outputs: Mapping[str, Path | None] | None) -> list[tuple[str, Path]]:
    return [(name, path) for name, path in (outputs or {}).items() if path is not None]


def _places(path: Path) -> set[Path]:
    """Where a path lies: as a link would be replaced, and as it would be followed."""
    whole = path.resolve()
    if path.name in ("", ".."):
        return {whole}
    return {path.parent.resolve() / path.name, whole}


def _format(file: Path) -> str:
    try:
        header = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError):
        return ""
    found = header.get("format") if isinstance(header, dict) else None
    return found if isinstance(found, str) else ""
