"""Run time against error: the settings of ``--quality``, and what is expected of each.

Every setting is a point of :mod:`workstation.benchmarks.pipeline`, which draws them among others.
What is expected is what :mod:`workstation.quality_curve` has as measured, relative to ``normal``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from fitting.reflectance.clusters import ClusterOptions
from fitting.reflectance.maps import MapOptions
from fitting.reflectance.solver import SolverOptions
from fitting.surface import SurfaceOptions
from workstation.processing import ProcessingOptions, plain_options
from workstation.quality_curve import shipped_curve
from workstation.reflectance_processing import ReflectanceOptions


class Quality(StrEnum):
    """How much time is spent on how small an error."""

    DRAFT = "draft"
    NORMAL = "normal"
    BEST = "best"


@dataclass(frozen=True)
class Expectation:
    """What a quality costs and gives, relative to ``normal``, as measured on simulated paintings.

    Attributes
    ----------
    fit_time : float
        Processor time of fitting the reflectance of as large a canvas.
    height_error : float
        RMS error of heights against the truth at the places of ``normal``'s texels.
    heldout_db : float
        PSNR of photographs kept out of the fit, minus that of ``normal``.
    """

    fit_time: float
    height_error: float
    heldout_db: float


def expectation(quality: Quality) -> Expectation:
    """What a quality costs and gives, as the curve that comes with the program has it."""
    curve = shipped_curve()
    point, usual = curve.quality(quality), curve.quality(Quality.NORMAL)
    return Expectation(
        point.fit_seconds / usual.fit_seconds,
        point.height_mm / usual.height_mm,
        point.heldout_db - usual.heldout_db,
    )


def quality_options(quality: Quality) -> ProcessingOptions:
    """Options of every stage for a quality."""
    if quality is Quality.DRAFT:
        return ProcessingOptions(
            surface=SurfaceOptions(pitch_factor=1.6),
            reflectance=ReflectanceOptions(
                maps=MapOptions(
                    clusters=ClusterOptions(most=3, survey=1000, per_material=200),
                    solver=SolverOptions(starts=1, weak_starts=1, tolerance=1e-3),
                    refine_normals=False,
                )
            ),
        )
    if quality is Quality.BEST:
        # More starts, a larger survey and a finer tolerance gain nothing: texels do.
        return ProcessingOptions(surface=SurfaceOptions(pitch_factor=0.7))
    return ProcessingOptions()


def stated_options(quality: Quality) -> dict[str, Any]:
    """Options of a quality by their dotted names, as plain values.

    Of another quality than normal, those that differ from normal's.
    """
    found = _flat(plain_options(asdict(quality_options(quality))))
    if quality is Quality.NORMAL:
        return found
    usual = stated_options(Quality.NORMAL)
    return {
        name: value for name, value in found.items() if name not in usual or usual[name] != value
    }


def describe(quality: Quality) -> str:
    """A sentence on the error that a quality leaves, to be said before it is known."""
    expected = expectation(quality)
    if quality is Quality.NORMAL:
        return "errors as each stage predicts them"
    return (
        f"height errors {expected.height_error:.2g} times those of normal, photographs kept out "
        f"of the fit {expected.heldout_db:+.1f} dB, as measured on simulated paintings"
    )


def _flat(options: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in options.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value
    return found
