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
from workstation.benchmarks.registration_bound import pose_bound
from workstation.benchmarks.simulated_photographs import OTHER_LENS, RIG, VIEWS, photograph

_HERE = np.zeros(6)
_WRONG = 0.2
_BOUND = 1.2
_DRAWS = 400


@dataclass(frozen=True)
class _Errors:
    """Errors of registered views, three of each seed.

    Attributes
    ----------
    errors : (views, 6) float64 array
        Of turn (rad) and shift (mm).
    covariance : (views, 6, 6) float64 array
        As predicted.
    """

    errors: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def spread(self) -> float:
        """Errors over their predicted standard deviations, root mean square."""
        root = np.linalg.cholesky(self.covariance)
        white = np.linalg.solve(root, self.errors[..., np.newaxis])
        return float(np.sqrt(np.mean(white**2)))

    @property
    def size(self) -> NDArray[np.float64]:
        """Root mean square error of turn and of shift (2,)."""
        return np.sqrt(np.mean(self.errors.reshape(-1, 2, 3) ** 2, axis=(0, 2)))

    @property
    def expected(self) -> NDArray[np.float64]:
        """The same as predicted, and scaled by how predictions turned out.

        The size follows from a view or two that are known worst. All numbers of all views say
        whether predictions hold, which is told several times better.
        """
        return self.spread * _size(self.covariance)

    def of_seeds(self, seeds: NDArray[np.int_]) -> _Errors:
        """Those of some seeds, for the bootstrap."""
        views = len(VIEWS)
        chosen = (seeds[:, np.newaxis] * views + np.arange(views)).ravel()
        return _Errors(self.errors[chosen], self.covariance[chosen])


def _size(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    return np.sqrt(np.mean(variance.reshape(-1, 2, 3), axis=(0, 2)))


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
    turn, shift = plain.size
    return [
        Record(
            name="uncertainty.pose_spread",
            value=plain.spread,
            unit="",
            bound=(0.9, 1.1),
            sense=Sense.WITHIN,
            runs=len(plain.errors),
            note=f"turn {np.degrees(turn):.2g}°, shift {shift:.2g} mm",
        ),
        _outliers(outliers, plain),
        _other_lens(lens, plain, seeds),
    ]


def _register(
    shot: CorrespondenceMap, scan: CorrespondenceMap, lens: Lens, pose: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    view = register_view(shot, scan, RIG, lens=lens)
    return compose(pose, invert(view.rt_cam_rig)), view.covariance


def _collected(found: list[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> _Errors:
    errors, covariance = zip(*found, strict=True)
    return _Errors(np.array(errors), np.array(covariance))


def _outliers(disturbed: _Errors, plain: _Errors) -> Record:
    """Of the same noise: errors themselves are compared."""
    ratios = disturbed.size / plain.size
    return Record(
        name="registration.outliers_over_clean",
        value=float(ratios.max()),
        unit="",
        bound=_BOUND,
        sense=Sense.AT_MOST,
        runs=len(plain.errors),
        note=f"turn {ratios[0]:.3g}, shift {ratios[1]:.3g}: a fifth of the code wrong; "
        f"{disturbed.spread:.3g} of predicted spread",
    )


def _other_lens(lens: _Errors, plain: _Errors, seeds: int) -> Record:
    """Of noise of its own, so that the sizes of errors are compared by what is expected of them."""
    ratio = float((lens.expected / plain.expected).max())
    rng = np.random.default_rng(0)
    again = []
    for _ in range(_DRAWS):
        some = rng.integers(0, seeds, seeds)
        ends = lens.of_seeds(some), plain.of_seeds(some)
        again.append(
            [(ends[0].expected / ends[1].expected).max(), (ends[0].size / ends[1].size).max()]
        )
    sigma, raw_sigma = np.std(again, axis=0)
    least = [
        _size(np.array([pose_bound(each, pose) for pose in VIEWS.values()]))
        for each in (OTHER_LENS, RIG.camera)
    ]
    raw = float((lens.size / plain.size).max())
    over = float((plain.expected / least[1]).max())
    return Record(
        name="registration.lens_over_clean",
        value=ratio,
        unit="",
        bound=_BOUND,
        sense=Sense.AT_MOST,
        runs=len(plain.errors),
        note=f"± {sigma:.2g}, a longer lens, calibrated; errors of these runs alone {raw:.3g} ± "
        f"{raw_sigma:.2g}; at the Cramér–Rao bound {(least[0] / least[1]).max():.3g}, of which "
        f"errors are {over:.2g} times as large",
    )
