"""Run time against error: the settings of ``--quality``, and what is expected of each.

Every setting is a point of :mod:`workstation.benchmarks.pipeline`, which draws them among others.
The expectations below were measured on the simulated oil sketch of the demo, 42 photographs of 480
by 360 pixels (heights: of 128 by 96), relative to ``normal``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from fitting.reflectance.clusters import ClusterOptions
from fitting.reflectance.maps import MapOptions
from fitting.reflectance.solver import SolverOptions
from fitting.surface import SurfaceOptions
from workstation.processing import ProcessingOptions
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


EXPECTED = {
    Quality.DRAFT: Expectation(0.15, 1.5, -3.3),
    Quality.NORMAL: Expectation(1.0, 1.0, 0.0),
    Quality.BEST: Expectation(1.35, 0.88, 0.4),
}


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


def describe(quality: Quality) -> str:
    """A sentence on the error that a quality leaves, to be said before it is known."""
    expected = EXPECTED[quality]
    if quality is Quality.NORMAL:
        return "errors as each stage predicts them"
    return (
        f"height errors {expected.height_error:.2g} times those of normal, photographs kept out "
        f"of the fit {expected.heldout_db:+.1f} dB, as measured on simulated paintings"
    )
