r"""Phase errors by harmonics of the projector's response, estimated from the fringes themselves.

A response that is not linear puts harmonics into a fringe, and N even steps fold those of orders
mN ± 1 onto the phase: it errs by a periodic function :math:`e(\varphi)` of the orders mN, the same
for every pixel. Two things show it without any knowledge of the scene:

* Along a line over a smooth surface the true phase has hardly any second difference, so that
  :math:`\varphi(x+d) - 2\varphi(x) + \varphi(x-d)` is that of e. With d of half a harmonic's period
  the harmonic counts fourfold. A robust linear fit over many lines gives the coefficients; slow
  curvature is fitted beside them, edges and relief are outliers.
* Between two fringes, the coarse coordinate less the fine one is the coarse fringe's error, as a
  function of the coarse phase (the fine fringe's own is smaller by the ratio of periods).

The phase is corrected by subtracting e(φ), and its variance grows by :math:`(1 - e'(\varphi))^2`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.fringes import Fringe
from acquisition.robust_spread import robust_spread

# Multiples of the number of steps that are fitted, and the highest order worth fitting.
_MULTIPLES = 5
_HIGHEST_ORDER = 16
_SHORTEST_PERIOD = 6.0
_LEAST_PERIODS = 2.0
# Turns between two pixels that are surely less than half a turn apart.
_SHORT_STEP = 0.2
_LEAST_EQUATIONS = 500
# Equations of one lag and direction beyond which more tell nothing new.
_ENOUGH_EQUATIONS = 12_000
_TUKEY = 4.685
_ITERATIONS = 12
# Turns from pixel to pixel below which harmonics are smooth, and pixels that suffice to tell.
_STEEP = 1 / 64
_FOR_STEEPNESS = 4096


@dataclass(frozen=True)
class PhaseSeries:
    """A Fourier series of the phase error in the raw phase.

    Attributes
    ----------
    orders : tuple of int
    cosine, sine : (orders,) float64 arrays
        Coefficients in turns.
    sigma : (orders,) float64 array
        Standard error of an amplitude in turns.
    """

    orders: tuple[int, ...]
    cosine: NDArray[np.float64]
    sine: NDArray[np.float64]
    sigma: NDArray[np.float64]

    @property
    def amplitudes_rad(self) -> NDArray[np.float64]:
        """Amplitude of every order in radians."""
        return 2 * np.pi * np.hypot(self.cosine, self.sine)

    @property
    def rows(self) -> NDArray[np.float32]:
        """(orders, 3) float32 array of order, cosine, sine, as the kernels take them."""
        columns = [np.array(self.orders, np.float64), self.cosine, self.sine]
        return np.ascontiguousarray(np.stack(columns, axis=1), np.float32)

    def error(self, turns: NDArray[np.floating]) -> NDArray[np.float64]:
        """Phase error in turns at raw phases in turns."""
        angle = 2 * np.pi * np.asarray(turns, np.float64)
        error = np.zeros(angle.shape)
        for order, cosine, sine in zip(self.orders, self.cosine, self.sine, strict=True):
            error += cosine * np.cos(order * angle) + sine * np.sin(order * angle)
        return error


def error_orders(fringe: Fringe) -> tuple[int, ...]:
    """Orders at which harmonics make a fringe's phase err."""
    even = np.sort(np.mod(fringe.shifts_rad, 2 * np.pi))
    gaps = np.diff(np.append(even, even[0] + 2 * np.pi))
    if np.ptp(gaps) < 1e-6:
        multiples = [fringe.steps * m for m in range(1, _MULTIPLES + 1)]
        return tuple(m for m in multiples if m <= max(_HIGHEST_ORDER, fringe.steps))
    return (1, 2, 3, 4)


def series_along_lines(
    lines: list[NDArray[np.floating]], good: list[NDArray[np.bool_]], orders: tuple[int, ...]
) -> PhaseSeries | None:
    """Phase error from the smoothness of phases along lines of pixels.

    Parameters
    ----------
    lines : list of (lines, pixels) arrays
        Raw phases in turns along rows, along columns.
    good : list of (lines, pixels) bool arrays
        Pixels to be used.
    orders : tuple of int
        Orders to be fitted.

    Returns
    -------
    PhaseSeries or None
        None where the lines show too few periods, or periods too short, to tell.
    """
    systems = []
    for turns, use in zip(lines, good, strict=True):
        period = _period_of_lines(turns, use)
        if _SHORTEST_PERIOD <= period <= turns.shape[1] / _LEAST_PERIODS:
            lags = sorted({max(1, round(period / (2 * order))) for order in orders})
            systems.append([_second_differences(turns, use, lag, orders) for lag in lags])
    if sum(len(part[1]) for parts in systems for part in parts) < _LEAST_EQUATIONS:
        return None
    solution, covariance = _robust_fit(*_stacked(systems, 2 * len(orders)))
    width = 2 * len(orders)
    return _series(orders, solution[:width], covariance[:width, :width])


_System = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.intp]]


def _stacked(systems: list[list[_System]], width: int) -> _System:
    """Systems of all directions and lags in one; the slow curvature of each direction its own."""
    slow = systems[0][0][0].shape[1] - width
    designs, differences, clusters, before = [], [], [], 0
    for number, parts in enumerate(systems):
        for harmonic, difference, line in parts:
            design = np.zeros((len(harmonic), width + slow * len(systems)))
            design[:, :width] = harmonic[:, :width]
            own = width + slow * number
            design[:, own : own + slow] = harmonic[:, width:]
            designs.append(design)
            differences.append(difference)
            clusters.append(line + before)
        before = 1 + max(int(cluster.max(initial=0)) for cluster in clusters)
    return np.concatenate(designs), np.concatenate(differences), np.concatenate(clusters)


def series_of_coarse(
    coarse_turns: NDArray[np.floating], apart_turns: NDArray[np.floating], orders: tuple[int, ...]
) -> PhaseSeries | None:
    """Phase error of a coarse fringe from its disagreement with a finer one.

    Parameters
    ----------
    coarse_turns : (n,) array
        Raw coarse phases in turns.
    apart_turns : (n,) array
        Coarse less fine coordinate, in turns of the coarse fringe.
    orders : tuple of int
        Orders to be fitted, beside a constant.

    Returns
    -------
    PhaseSeries or None
        The constant is order 0; None where there are too few pixels.
    """
    if len(apart_turns) < _LEAST_EQUATIONS:
        return None
    fitted = (0, *orders)
    angle = 2 * np.pi * np.asarray(coarse_turns, np.float64)
    columns = [np.ones(len(angle))]
    for order in orders:
        columns += [np.cos(order * angle), np.sin(order * angle)]
    solution, covariance = _robust_fit(np.stack(columns, axis=1), apart_turns)
    # The constant has no sine.
    solution = np.insert(solution, 1, 0.0)
    covariance = np.insert(np.insert(covariance, 1, 0.0, axis=0), 1, 0.0, axis=1)
    return _series(fitted, solution, covariance)


def steep_harmonics(
    pictures: NDArray[np.float64],
    phasor: NDArray[np.complex128],
    *,
    light: NDArray[np.float64],
    use: NDArray[np.bool_],
    orders: Iterable[int],
) -> NDArray[np.float64]:
    """What follows a fringe's phase in pictures, where the phase is steep along rows.

    The response is the projector's, so that harmonic h leaves cos hφ and sin hφ in proportion to
    the projector's light.

    Parameters
    ----------
    pictures : (n, rows, cols) array
    phasor : (rows, cols) complex array
        Of the phase φ, in any proportion.
    light : (rows, cols) array
        In any unit.
    use : (rows, cols) bool array
        Pixels that tell.
    orders : iterable of int

    Returns
    -------
    (n, rows, cols) array, or (n, 1, 1)
        Zeros where the phase rises by so little from pixel to pixel that harmonics are smooth, or
        where there are too few pixels.
    """
    nothing = np.zeros((len(pictures), 1, 1))
    if phasor.shape[1] < 2 or use.sum() < _LEAST_EQUATIONS:
        return nothing
    rows = phasor[:: 1 + phasor.size // _FOR_STEEPNESS]
    turns = np.angle(rows[:, 1:] * rows[:, :-1].conj()) / (2 * np.pi)
    if not np.median(np.abs(turns)) > _STEEP:
        return nothing
    unit = phasor / np.maximum(np.abs(phasor), 1e-12)
    waves = [light * unit**order for order in orders]
    design = np.stack(
        [light, *(part for wave in waves for part in (wave.real, wave.imag))], axis=-1
    )
    told, observed = design[use], pictures[:, use].T
    every = 1 + len(told) // _ENOUGH_EQUATIONS
    told, observed = told[::every], observed[::every]
    kept = np.ones(len(told), np.bool_)
    for _ in range(3):
        solution = np.linalg.lstsq(told[kept], observed[kept], rcond=1e-8)[0]
        left = ((observed - told @ solution) ** 2).sum(axis=1)
        kept = left <= 9 * np.median(left)
    # Over a part of the period the waves and the plain light are told together only.
    follows = np.moveaxis(design @ solution, -1, 0)
    plain = np.median((told @ solution)[kept], axis=0) / np.median(told[kept, 0])
    return follows - plain[:, np.newaxis, np.newaxis] * light


def held_out_residual(
    phases: list[NDArray[np.floating]], good: list[NDArray[np.bool_]], orders: tuple[int, ...]
) -> NDArray[np.float64]:
    """Amplitudes in every other line of what the lines between them would subtract, radians."""
    half = series_along_lines([p[::2] for p in phases], [g[::2] for g in good], orders)
    if half is None:
        return np.full(len(orders), np.nan)
    rest = [p[1::2] for p in phases]
    # The error is linear in its coefficients, so what would be left of it is the difference.
    left = series_along_lines(rest, [g[1::2] for g in good], orders)
    if left is None:
        return np.full(len(orders), np.nan)
    return 2 * np.pi * np.hypot(left.cosine - half.cosine, left.sine - half.sine)


def _series(
    orders: tuple[int, ...], solution: NDArray[np.float64], covariance: NDArray[np.float64]
) -> PhaseSeries:
    variance = np.diag(covariance)
    sigma = np.sqrt((variance[0::2] + variance[1::2]) / 2)
    return PhaseSeries(orders, solution[0::2].copy(), solution[1::2].copy(), sigma)


def _period_of_lines(turns: NDArray[np.floating], use: NDArray[np.bool_]) -> float:
    """Period along the lines in pixels; infinite where the phase stands still."""
    period = float("inf")
    # From pixel to pixel noise outweighs a slow phase: the largest distance that is short against
    # the period counts.
    for apart in (1, 4, 16, 64):
        if apart >= turns.shape[1]:
            break
        step = turns[:, apart:] - turns[:, :-apart]
        step = np.abs(step - np.round(step))[use[:, apart:] & use[:, :-apart]]
        typical = float(np.median(step)) if len(step) else 0.0
        if not 0 < typical < _SHORT_STEP:
            break
        period = apart / typical
    return period


def _second_differences(
    turns: NDArray[np.floating], use: NDArray[np.bool_], lag: int, orders: tuple[int, ...]
) -> _System:
    """Design (harmonics, slow terms) of second differences at a lag, these, and their lines."""
    good = np.argwhere(use[:, 2 * lag :] & use[:, lag:-lag] & use[:, : -2 * lag])
    good = good[:: 1 + len(good) // _ENOUGH_EQUATIONS]
    line, start = good.T
    after, here, before = (turns[line, start + k * lag].astype(np.float64) for k in (2, 1, 0))
    rise, rise_before = after - here, here - before
    difference = (rise - np.round(rise)) - (rise_before - np.round(rise_before))
    columns: list[NDArray[np.float64]] = []
    for order in orders:
        for wave in (np.cos, np.sin):
            ahead, middle, behind = (wave(2 * np.pi * order * t) for t in (after, here, before))
            columns.append(ahead - 2 * middle + behind)
    # A smooth curve's second difference grows with the square of the lag.
    u, v = (good.astype(np.float64) / turns.shape - 0.5).T
    columns += [lag**2 * term for term in (np.ones(len(u)), u, v, u * u, u * v, v * v)]
    return np.stack(columns, axis=1), difference, line


def _robust_fit(
    design: NDArray[np.float64],
    observed: NDArray[np.floating],
    clusters: NDArray[np.intp] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least squares with Tukey's weights, and the covariance of the solution.

    Equations of one cluster share noise; their covariance is taken from the data, cluster by
    cluster.
    """
    observed = np.asarray(observed, np.float64)
    solution = np.zeros(design.shape[1])
    scale = 1.0
    for _ in range(_ITERATIONS):
        residual = observed - design @ solution
        scale = robust_spread(residual) + 1e-12
        far = residual / (_TUKEY * scale)
        weight = np.square(np.clip(1.0 - far * far, 0.0, None))
        weighted = design * weight[:, np.newaxis]
        normal = weighted.T @ design
        solution = np.linalg.lstsq(normal, weighted.T @ observed, rcond=1e-10)[0]
    inverse = np.linalg.pinv(normal, rcond=1e-10)
    if clusters is None:
        return solution, scale**2 * inverse
    pull = weighted * (observed - design @ solution)[:, np.newaxis]
    order = np.argsort(clusters, kind="stable")
    starts = np.flatnonzero(np.diff(clusters[order], prepend=-1))
    pulls = np.add.reduceat(pull[order], starts, axis=0)
    return solution, inverse @ (pulls.T @ pulls) @ inverse
