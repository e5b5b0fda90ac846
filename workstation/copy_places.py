"""What lies beside a digital copy: pictures, the record of the run, stored results of the stages.

Beside ``COPY`` lie ``COPY-relief.png``, ``COPY-held-out.png`` where photographs were kept out of
the fit, ``COPY-run.json`` with what each stage took, and the folder ``COPY-stages`` of stored
results, which may be deleted.
"""

from __future__ import annotations

from pathlib import Path


def stages_folder(copy: Path) -> Path:
    """Where results of the stages behind a copy are kept by default."""
    return copy.with_name(f"{copy.name}-stages")


def run_file(copy: Path) -> Path:
    """Where the record of the run that made a copy is."""
    return copy.with_name(f"{copy.name}-run.json")


def relief_picture(copy: Path) -> Path:
    """Where the picture of a copy's relief is."""
    return copy.with_name(f"{copy.name}-relief.png")


def held_out_picture(copy: Path) -> Path:
    """Where photographs that were kept out of the fit are, beside their renderings."""
    return copy.with_name(f"{copy.name}-held-out.png")


def places_beside(copy: Path) -> dict[str, Path]:
    """Every file beside a copy, by what it is."""
    return {
        "picture of the relief": relief_picture(copy),
        "picture of photographs kept out": held_out_picture(copy),
        "record of the run": run_file(copy),
    }
