"""What a copy's report is drawn from, held against what the copy says that it was made from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from acquisition.session import Session
from fitting.copy_files import COPY_FILE
from fitting.errors import CopyError
from workstation.copy_places import run_file
from workstation.copy_writing import read_run
from workstation.stage_cache import digest_of_files

# Digits of a digest that tell two apart at a glance.
_DIGITS = 12


@dataclass(frozen=True)
class ReportSources:
    """What belongs to a copy.

    Attributes
    ----------
    session, photographs : Session or None
        None where they were not named.
    run : dict or None
        Record of the run that made the copy; None where there is none, or another copy's.
    warnings : tuple of str
        What was left out.
    """

    session: Session | None
    photographs: Session | None
    run: dict[str, Any] | None
    warnings: tuple[str, ...]


def find_sources(
    copy: Path,
    provenance: Mapping[str, Any],
    *,
    session: Path | None = None,
    photographs: Path | None = None,
    calibration: Path | None = None,
) -> ReportSources:
    """Open what a copy was made from.

    Parameters
    ----------
    copy : Path
    provenance : mapping
        Of the copy.
    session, photographs : Path, optional
        Sessions that are said to be behind it.
    calibration : Path, optional
        That which is said to be behind it.

    Raises
    ------
    CopyError
        The copy was made from others, or what it says of its making makes no sense.
    SessionError
        A session is damaged.
    """
    _check_provenance(copy, provenance)
    if calibration is not None:
        _check_calibration(provenance, calibration)
    scan = _opened(copy, provenance, "session", session)
    pictures = _opened(copy, provenance, "photographs", photographs)
    run, doubt = _run_of(copy)
    return ReportSources(scan, pictures, run, () if doubt is None else (doubt,))


class _Noise(BaseModel, strict=True):
    predicted_mm: float
    observed_mm: float


class _Shape(BaseModel, strict=True):
    bow_x_mm: float
    bow_y_mm: float
    twist_mm: float
    bow_x_sigma_mm: float
    bow_y_sigma_mm: float
    twist_sigma_mm: float


class _CalibrationError(BaseModel, strict=True):
    height_sigma_mm: float


class _Errors(BaseModel, strict=True):
    height_sigma_mm: float = math.nan
    height_noise: _Noise | None = None
    canvas_shape: _Shape | str | None = None
    calibration_uncertainty: _CalibrationError | str | None = None


class _Material(BaseModel, strict=True):
    k: float
    variant: str
    misfit: float
    misfit_relative: float


class _Reflectance(BaseModel, strict=True):
    materials: list[_Material] | None = None


class _Provenance(BaseModel, strict=True):
    """What reports take from a copy's provenance, beside texts and parameters."""

    errors: _Errors = _Errors()
    reflectance: _Reflectance | None = None
    warnings: list[Any] = []


def _check_provenance(copy: Path, provenance: Mapping[str, Any]) -> None:
    try:
        _Provenance.model_validate(dict(provenance))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, ("provenance", *first["loc"])))
        raise CopyError(
            f"{copy / COPY_FILE}: {where}: {first['msg']}; it is damaged: process the session again"
        ) from None


def calibration_behind(
    provenance: Mapping[str, Any], session: Session, named: Path | None = None
) -> Path | None:
    """Folder of the calibration that a copy was made with; None if it is not at hand.

    Parameters
    ----------
    provenance : mapping
        Of the copy.
    session : Session
        Its own calibration is looked at.
    named : Path, optional
        Another one that is said to be it.

    Raises
    ------
    CopyError
        The named one is not it.
    """
    if named is not None:
        _check_calibration(provenance, named)
        return named
    used, own = provenance.get("calibration"), session.calibration_folder
    return own if own is not None and used in (None, digest_of_files(own)) else None


def _check_calibration(provenance: Mapping[str, Any], folder: Path) -> None:
    digest, used = digest_of_files(folder), str(provenance.get("calibration"))
    if digest != used:
        raise CopyError(
            f"{folder} is not the calibration behind this copy: its digest begins with "
            f"{digest[:_DIGITS]}, that of the copy's with {used[:_DIGITS]}; name that one, or "
            "leave it out"
        )


def _opened(
    copy: Path, provenance: Mapping[str, Any], name: str, path: Path | None
) -> Session | None:
    if path is None:
        return None
    found, used = Session.open(path), provenance.get(name)
    if used is None:
        raise CopyError(
            f"{copy} does not say that it was made from a session"
            f"{' of photographs' if name == 'photographs' else ''}: leave {path} out"
        )
    if found.digest != used:
        raise CopyError(
            f"{path} is not what {copy} was made from: its digest begins with "
            f"{found.digest[:_DIGITS]}, that of the copy's {name} with {str(used)[:_DIGITS]}; name "
            f"that one with --{name}, or leave it out"
        )
    return found


def _run_of(copy: Path) -> tuple[dict[str, Any] | None, str | None]:
    """Record of the run that made a copy, and what is wrong with one that did not."""
    run = read_run(copy)
    if run is None or run.get("copy") == digest_of_files(copy):
        return run, None
    return None, (
        f"{run_file(copy.resolve())} is not the record of this copy as it is now: left out; "
        "process the session again"
    )
