"""A processed session on disk: the copy, the pictures beside it, and the record of the run.

In the copy is nothing that differs from run to run. Where what lies beside it is,
:mod:`workstation.copy_places` tells.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat

from acquisition.atomic_files import file_in_progress, write_bytes
from calibration.srgb import encode_srgb
from fitting.copy_files import COPY_FILE, check_destination, write_copy
from fitting.digital_copy import DigitalCopy
from fitting.reflectance.held_out import Comparison
from fitting.reflectance.held_out_picture import draw_held_out
from fitting.reflectance.microfacet import microfacets_of
from fitting.relief_picture import draw_relief
from workstation.copy_places import held_out_picture, places_beside, relief_picture, run_file
from workstation.json_output import write_json
from workstation.processing import Processed
from workstation.quality import Quality
from workstation.reflectance_processing import comparison_figures
from workstation.stage_cache import digest_of_files

HELD_OUT_FOLDER = "held-out"
HELD_OUT_FILE = "held-out.json"
# Of a picture in a copy; reports show them no larger.
_LARGEST_SIDE_PX = 1000


def copy_title(copy: Path) -> str:
    """Name of a copy's folder, or of the one above where it is called copy, as ours are."""
    place = copy.resolve()
    return place.parent.name if place.name == "copy" else place.name


def check_copy_destination(out: Path, session_digest: str, *, force: bool) -> None:
    """Refuse to replace anything but a copy of the same session, unless that is asked for.

    Raises
    ------
    CopyError
    """
    try:
        provenance = json.loads((out / COPY_FILE).read_text())["provenance"]
        same = provenance["session"] == session_digest
    except (OSError, ValueError, KeyError, TypeError):
        same = False
    check_destination(out, replace=force or same)


def write_processed(
    done: Processed, out: Path, *, ggx: bool = False, exact_maps: bool = False
) -> None:
    """Write a copy and the pictures beside it.

    A copy that is there is replaced; see :func:`check_copy_destination`.

    Raises
    ------
    CopyError
        A folder that is no copy is in the way.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    # Where there is no room for the picture, no copy appears without it.
    with file_in_progress(relief_picture(out)) as picture:
        draw_relief(done.copy, picture)
        write_pictured(
            *(done.copy, out, done.comparisons), ggx=ggx, exact_maps=exact_maps, replace=True
        )


def write_pictured(
    copy: DigitalCopy,
    out: Path,
    comparisons: Sequence[Comparison],
    *,
    ggx: bool = False,
    exact_maps: bool = False,
    replace: bool = False,
) -> None:
    """Write a copy with pictures of what was kept out of its fit.

    What lies beside a copy that is replaced goes with it.
    """
    replaced = out.exists()
    maps = copy.reflectance
    facets = microfacets_of(maps) if ggx and maps is not None else None
    beside = partial(_write_comparisons, comparisons) if comparisons else _nothing
    write_copy(
        *(copy, out),
        replace=replace,
        microfacets=facets,
        exact_maps=exact_maps,
        beside=beside,
    )
    if replaced:
        for path in places_beside(out).values():
            path.unlink(missing_ok=True)
    if comparisons:
        draw_held_out(comparisons, held_out_picture(out))


class _Stage(BaseModel, strict=True):
    name: str
    seconds: FiniteFloat
    skipped: bool
    saved_s: FiniteFloat
    peak_mb: FiniteFloat = 0.0


class _Rays(BaseModel, strict=True):
    tested: int
    cast: int


class _Run(BaseModel, strict=True):
    """What reports take from the record of a run."""

    stages: list[_Stage]
    quality: Quality = Field(Quality.NORMAL, strict=False)
    expected_seconds: dict[str, FiniteFloat] | None = None
    rays: _Rays | None = None


def write_run(done: Processed, out: Path, more: dict[str, Any]) -> None:
    """Write the record of a run: of which copy it is, and what each stage took or would have."""
    reflectance = done.figures.get("reflectance") or {}
    record = {"stages": [asdict(run) for run in done.stages.runs], "rays": reflectance.get("rays")}
    write_json(run_file(out), {"copy": digest_of_files(out)} | more | record)


def read_run(out: Path) -> dict[str, Any] | None:
    """The record of the run that made a copy; None where there is none that makes sense."""
    try:
        found: dict[str, Any] = json.loads(run_file(out.resolve()).read_text())
        _Run.model_validate(found)
    except (OSError, ValueError, RecursionError):
        return None
    return found


def _nothing(folder: Path) -> None:
    """There is nothing to write beside."""


def _write_comparisons(comparisons: Sequence[Comparison], folder: Path) -> None:
    """Photographs that were kept out of the fit, and their renderings, as anybody can see them."""
    place = folder / HELD_OUT_FOLDER
    place.mkdir()
    rows = []
    for one in comparisons:
        seen = np.argwhere(np.isfinite(one.delta_e))
        (top, left), (bottom, right) = seen.min(axis=0), seen.max(axis=0) + 1
        here = np.s_[top:bottom, left:right]
        for what in ("measured", "rendered"):
            picture = _display(getattr(one, what)[here], one.white)
            write_bytes(place / f"{one.name}-{what}.png", picture)
        rows.append(comparison_figures(one))
    write_json(folder / HELD_OUT_FILE, rows)


def _display(radiance: NDArray[np.float32], white: float) -> bytes:
    shown = encode_srgb(np.clip(np.nan_to_num(radiance.astype(np.float64)) / white, 0.0, 1.0))
    picture = np.rint(255 * shown).astype(np.uint8)[..., ::-1]
    scale = min(1.0, _LARGEST_SIDE_PX / max(picture.shape[:2]))
    if scale < 1.0:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    done, png = cv2.imencode(".png", picture)
    assert done
    return png.tobytes()
