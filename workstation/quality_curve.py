"""Run time against error of the whole pipeline, as measured: points, and the file they are kept in.

``impasto bench pipeline`` measures a curve and writes it; the one that comes with the program,
``quality_curve.json``, was written so. It says when, on which machine, and for which options of
each quality, and :mod:`workstation.quality` takes from it what a quality is expected to give.
"""

from __future__ import annotations

import json
import math
import os
import platform
import re
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from devices.errors import ImpastoError
from workstation.json_output import write_json
from workstation.pareto_front import pareto_front

FORMAT = "impasto-quality-curve-2"
QUALITY = "quality"
# Of time, error of heights, and decibels. Measured again, a setting takes some hundredths of its
# time more or less, and errors that differ by less are no reason to choose.
ALIKE = (math.log(1.03), math.log(1.02), 0.1)
_SHIPPED = Path(__file__).with_name("quality_curve.json")


class QualityCurveError(ImpastoError):
    """A file of a measured curve cannot be read."""


@dataclass(frozen=True)
class CurvePoint:
    """Run time and error of a setting.

    Attributes
    ----------
    curve, name : str
        What is varied, and its value.
    seconds : float
        Of the processor, for the whole of processing.
    fit_seconds : float
        Of these, for fitting the reflectance.
    recording_s : float
        That recording is expected to take at the rig, but for what is done by hand.
    height_mm : float
        RMS error of heights on a grid that is the same for all.
    heldout_db : float
        PSNR of photographs that the setting does not see.
    texels : int
    frames : int
        Recorded for it.
    default : bool
    """

    curve: str
    name: str
    seconds: float
    fit_seconds: float
    recording_s: float
    height_mm: float
    heldout_db: float
    texels: int
    frames: int
    default: bool

    @property
    def total_s(self) -> float:
        """Recording and processing."""
        return self.recording_s + self.seconds

    @property
    def costs(self) -> tuple[float, float, float]:
        """Logarithms of time and of the error of heights, and decibels; smaller is better."""
        return math.log(self.total_s), math.log(self.height_mm), -self.heldout_db

    @property
    def label(self) -> str:
        """What it is called in pictures."""
        return self.name if self.curve == QUALITY else f"{self.curve} {self.name}"


@dataclass(frozen=True)
class QualityCurve:
    """Measured points with what they were measured on.

    Attributes
    ----------
    points : tuple of CurvePoint
    scene : str
        What was digitised.
    measured : str
        The day.
    software : str
    machine : str
    options : dict of str to dict
        Of each quality then; of another than normal, those that differ from normal's.
    """

    points: tuple[CurvePoint, ...]
    scene: str
    measured: str
    software: str
    machine: str
    options: dict[str, dict[str, Any]]

    def quality(self, name: str) -> CurvePoint:
        """The point of a quality.

        Raises
        ------
        QualityCurveError
            It was not measured.
        """
        for point in self.points:
            if (point.curve, point.name) == (QUALITY, name):
                return point
        raise QualityCurveError(f"the curve of {self.scene} has no quality {name}")

    @property
    def front(self) -> list[CurvePoint]:
        """Points that no other beats in time and both errors, the quickest first.

        By less than :data:`ALIKE` nothing is beaten.
        """
        return pareto_front(self.points, lambda point: point.costs, alike=ALIKE)

    def save(self, path: Path) -> None:
        """Write the curve as JSON, whole or not at all."""
        write_json(path, {"format": FORMAT} | asdict(self))

    @classmethod
    def load(cls, path: Path) -> QualityCurve:
        """Read what :meth:`save` wrote.

        Raises
        ------
        QualityCurveError
            It is no such file, or damaged.
        """
        try:
            found = json.loads(path.read_text())
            if found.pop("format") != FORMAT:
                raise ValueError(f"not of the format {FORMAT}")
            points = tuple(_point(values) for values in found.pop("points"))
            curve = cls(points=points, **found)
            texts = (curve.scene, curve.measured, curve.software, curve.machine)
            if not all(isinstance(text, str) for text in texts):
                raise TypeError("a text is none")
            if not all(isinstance(one, dict) for one in dict(curve.options).values()):
                raise TypeError("options are no table")
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise QualityCurveError(
                f"{path}: no curve of impasto bench pipeline, or damaged ({error}); measure it "
                "with impasto bench pipeline --pictures DIR"
            ) from None
        return curve


@cache
def shipped_curve() -> QualityCurve:
    """The curve that comes with the program."""
    return QualityCurve.load(_SHIPPED)


def this_machine() -> str:
    """What the processor is called, and how many there are."""
    name = platform.machine()
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.M)
    except OSError:
        found = None
    return f"{os.cpu_count()} × {found[1] if found else name}"


def _point(values: dict[str, Any]) -> CurvePoint:
    point = CurvePoint(**values)
    figures = (
        point.seconds,
        point.fit_seconds,
        point.recording_s,
        point.height_mm,
        point.heldout_db,
    )
    if not all(isinstance(figure, float | int) for figure in figures):
        raise TypeError(f"a figure of {point.curve} {point.name} is no number")
    return point
