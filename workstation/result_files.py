"""Results of stages on disk: frozen dataclasses of arrays, in one NumPy archive.

The archive holds the arrays, and a JSON tree that says how they make up the result. Only
dataclasses and enums of Impasto's own packages are made from it, so that reading a file runs no
code that it brings. Whoever writes one keeps its digest, without which it is not read: damage, or
another result in its place, is noticed before anything is made of it.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import math
from dataclasses import fields, is_dataclass
from enum import Enum
from io import BufferedRandom, BufferedReader
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from acquisition.atomic_files import file_in_progress
from devices.errors import ImpastoError

# Where the types of results come from.
PACKAGES = ("devices", "acquisition", "calibration", "fitting", "render", "workstation")
_TREE = "tree"


class ResultFileError(ImpastoError):
    """A stored result cannot be read, or a result cannot be stored."""


def write_result(result: Any, path: Path) -> str:
    """Write a result, whole or not at all.

    Parameters
    ----------
    result : Any
        Dataclasses, enums, arrays, tuples, lists, dictionaries, numbers, texts and None.
    path : Path

    Returns
    -------
    str
        SHA-256 of the file, which :func:`read_result` asks for.

    Raises
    ------
    ResultFileError
        It holds something else.
    """
    arrays: list[NDArray[Any]] = []
    tree = json.dumps(_encode(result, arrays))
    named = {f"a{number}": array for number, array in enumerate(arrays)}
    with file_in_progress(path) as unfinished, unfinished.open("w+b") as file:
        np.savez(file, **{_TREE: np.array(tree)}, **named)
        return _digest(file)


def read_result(path: Path, digest: str) -> Any:
    """Read what :func:`write_result` wrote.

    Parameters
    ----------
    path : Path
    digest : str
        What writing it returned.

    Raises
    ------
    ResultFileError
        The file is missing, is not what was written, or is of another version.
    """
    try:
        with path.open("rb") as file:
            if _digest(file) != digest:
                raise ResultFileError("is not what was written: damaged, or another result")
            file.seek(0)
            with np.load(file, allow_pickle=False) as archive:
                return _decode(json.loads(str(archive[_TREE])), archive)
    except ImpastoError as error:
        raise ResultFileError(f"{path}: {error}") from None
    except OSError as error:
        raise ResultFileError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, KeyError, TypeError, AttributeError, ImportError, BadZipFile) as error:
        raise ResultFileError(f"{path}: no result, or of another version ({error})") from None


def _digest(file: BufferedReader | BufferedRandom) -> str:
    file.seek(0)
    return hashlib.file_digest(file, "sha256").hexdigest()


def _encode(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """A value as JSON, its arrays appended to the list and named by their place in it."""

    def encode(inner: Any) -> Any:
        return _encode(inner, arrays)

    match value:
        case Enum():
            return {"enum": _name(type(value)), "value": encode(value.value)}
        case None | bool() | int() | str():
            return value
        case float():
            return value if math.isfinite(value) else {"float": str(value)}
        case np.ndarray() | np.generic():
            if value.dtype.hasobject:
                raise ResultFileError("an array of objects cannot be stored")
            arrays.append(np.asarray(value))
            return {"scalar" if isinstance(value, np.generic) else "array": len(arrays) - 1}
        case tuple() | list():
            return {type(value).__name__: [encode(inner) for inner in value]}
        case dict():
            return {"dict": [[encode(key), encode(inner)] for key, inner in value.items()]}
        case Path():
            return {"path": str(value)}
        case _ if is_dataclass(value) and not isinstance(value, type):
            content = {f.name: encode(getattr(value, f.name)) for f in fields(value) if f.init}
            return {"dataclass": _name(type(value)), "fields": content}
    raise ResultFileError(f"a {type(value).__name__} cannot be stored")


def _decode(tree: Any, archive: Any) -> Any:
    if not isinstance(tree, dict):
        return tree

    def decode(inner: Any) -> Any:
        return _decode(inner, archive)

    match tree:
        case {"array": int(number)}:
            return archive[f"a{number}"]
        case {"scalar": int(number)}:
            return archive[f"a{number}"][()]
        case {"float": str(text)}:
            return float(text)
        case {"tuple": list(inner)}:
            return tuple(map(decode, inner))
        case {"list": list(inner)}:
            return list(map(decode, inner))
        case {"dict": list(pairs)}:
            return {decode(key): decode(inner) for key, inner in pairs}
        case {"path": str(text)}:
            return Path(text)
        case {"enum": str(name), "value": value}:
            return _type(name, Enum)(decode(value))
        case {"dataclass": str(name), "fields": dict(content)}:
            kind = _type(name, None)
            return kind(**{field: decode(inner) for field, inner in content.items()})
    raise ResultFileError(f"nothing is made of {sorted(tree)}")


def _name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _type(name: str, base: type | None) -> Any:
    module, _, qualified = name.partition(":")
    if module.partition(".")[0] not in PACKAGES:
        raise ResultFileError(f"{name} is none of Impasto's types")
    kind: Any = importlib.import_module(module)
    for part in qualified.split("."):
        kind = getattr(kind, part)
    wanted = isinstance(kind, type) and (issubclass(kind, base) if base else is_dataclass(kind))
    if not wanted:
        raise ResultFileError(f"{name} is none of Impasto's types")
    return kind
