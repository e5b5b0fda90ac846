"""Registration of photographs against known poses: errors over their prediction, and disturbed.

A surface of thick strokes is scanned and photographed from three places for each seed, as
:mod:`workstation.benchmarks.simulated_photographs` makes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from calibration.lens import Lens, compose, invert
from calibration.registration import register_view
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.simulated_photographs import OTHER_LENS, RIG, VIEWS, photograph

_HERE = np.zeros(6)
_WRONG = 0.2


@dataclass(frozen=True)
class _Errors:
    """Errors (views, 6) of turn (rad) and shift (mm), and over their predicted spread."""

    errors: NDArray[np.float64]
    white: NDArray[np.float64]

    @property
    def spread(self) -> float:
        return float(np.sqrt(np.mean(self.white**2)))

    @property
    def turn(self) -> float:
        return float(np.sqrt(np.mean(self.errors[:, :3] ** 2)))

    @property
    def shift(self) -> float:
        return float(np.sqrt(np.mean(self.errors[:, 3:] ** 2)))


def registration_records(*, seeds: int = 20) -> list[Record]:
    """Spread of pose errors over their prediction, and errors with outliers and another lens."""
    clean: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    wrong: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    other: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    for seed in range(seeds):
        scan = photograph(_HERE, seed=seed)
        for number, pose in enumerate(VIEWS.values()):
            own = 1000 + 10 * seed + number
            clean.append(_register(photograph(pose, seed=own), scan, RIG.camera, pose))
            spoilt = photograph(pose, wrong=_WRONG, seed=own)
            wrong.append(_register(spoilt, scan, RIG.camera, pose))
            through = photograph(pose, lens=OTHER_LENS, seed=own)
            other.append(_register(through, scan, OTHER_LENS, pose))
    plain, outliers, lens = (_collected(found) for found in (clean, wrong, other))
    runs = len(plain.errors)
    note = f"turn {np.degrees(plain.turn):.2g}°, shift {plain.shift:.2g} mm"
    return [
        Record(
            name="uncertainty.pose_spread",
            value=plain.spread,
            unit="",
            bound=(0.9, 1.1),
            sense=Sense.WITHIN,
            runs=runs,
            note=note,
        ),
        _compared("outliers", outliers, plain, f"a fifth of the code wrong; {outliers.spread:.3g}"),
        _compared("lens", lens, plain, f"a longer lens, calibrated; {lens.spread:.3g}"),
    ]


def _register(
    shot: CorrespondenceMap, scan: CorrespondenceMap, lens: Lens, pose: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    view = register_view(shot, scan, RIG, lens=lens)
    error = compose(pose, invert(view.rt_cam_rig))
    return error, np.linalg.solve(np.linalg.cholesky(view.covariance), error)


def _collected(found: list[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> _Errors:
    errors, white = zip(*found, strict=True)
    return _Errors(np.array(errors), np.array(white))


def _compared(name: str, disturbed: _Errors, plain: _Errors, note: str) -> Record:
    ratios = disturbed.turn / plain.turn, disturbed.shift / plain.shift
    return Record(
        name=f"registration.{name}_over_clean",
        value=max(ratios),
        unit="",
        bound=1.2,
        sense=Sense.AT_MOST,
        runs=len(plain.errors),
        note=f"turn {ratios[0]:.3g}, shift {ratios[1]:.3g}: {note} of predicted spread",
    )
