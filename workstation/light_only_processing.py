"""From pictures under known light directions to the copy of a flat object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fitting.digital_copy import DigitalCopy
from fitting.reflectance.held_out import Comparison
from workstation.processing_figures import reflectance_provenance
from workstation.reflectance_processing import ReflectanceOptions, add_reflectance


def process_light_only(
    path: Path,
    *,
    pitch_mm: float = 1.0,
    linear: bool = False,
    options: ReflectanceOptions | None = None,
    begin: Callable[[str], None] = lambda stage: None,
) -> tuple[DigitalCopy, list[Comparison], dict[str, Any]]:
    """Reflectance of a flat object from an ``.lp`` file and its pictures.

    Parameters
    ----------
    path : Path
        The ``.lp`` file; its pictures lie beside it.
    pitch_mm : float
        Size of a pixel on the object.
    linear : bool
        Whether 8-bit pictures hold linear values.
    options : ReflectanceOptions, optional
    begin : callable, optional

    Returns
    -------
    copy : DigitalCopy
        Flat.
    comparisons : list of Comparison
    figures : dict

    Raises
    ------
    ImpastoError
    """
    from fitting.reflectance.light_only import read_light_only

    begin("reading the pictures")
    copy, photographs = read_light_only(path, pitch_mm=pitch_mm, linear=linear)
    added = add_reflectance(copy, photographs, options=options, begin=begin)
    figures = {
        "texels": int(copy.height_field.mask.sum()),
        "shape": list(copy.height_field.shape),
        "pitch_mm": pitch_mm,
        "reflectance": added.figures,
    }
    provenance = copy.provenance | {
        "software": f"impasto {version('impasto')}",
        "pictures": [photograph.name for photograph in photographs],
        "reflectance": reflectance_provenance(added.figures),
    }
    return replace(added.copy, provenance=provenance), added.comparisons, figures
