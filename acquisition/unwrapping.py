r"""Fringe orders: how certain they are, and whether neighbours bear them out.

*In time.* A coarse coordinate of standard deviation s₁ names the order of a fringe of period L and
standard deviation s₂ wrongly where their errors differ by more than L/2, which noise does with
probability :math:`\operatorname{erfc}(L / (2\sqrt2 \sqrt{s_1^2 + s_2^2}))`: for equal phase noise
σ_φ and a ratio r of periods, :math:`\operatorname{erfc}(\pi / (\sqrt2\,\sigma_\varphi
\sqrt{1 + r^2}))`. Pixels in which that exceeds a limit are uncertain: the limit is the rate at
which a wrong order is accepted by this step. An uncertain order is kept only where neighbours bear
it out, and none where the probability is so large that neighbours err together.

*In space.* Phase runs on from pixel to pixel, whatever the order. Where coordinates jump by whole
periods and the phase does not jump, the order of one side is wrong. Pixels are joined into
components that do not jump; a component whose border to larger ones jumps by the same whole
periods nearly everywhere, with the phase going on, is moved by those periods; one whose border
contradicts itself is rejected. Where both axes were decoded, the phases of both must go on: a step
of the surface moves the coordinate along the baseline by any amount, not by whole periods. A pixel
of arbitrary coordinates is taken for one to be repaired with the probability that its phase falls
within the tolerance around that of its neighbours, some 2 × 5 √2 σ_x / L per axis.

*Steps of the surface.* A frame stands before its wall by the same height everywhere, and that can
be worth whole periods by chance. Then it is no small part that contradicts its neighbours, and it
does so along a line that has nothing to do with the panel: a wrong code is wrong from a certain
coordinate on, wherever that is seen. So its border keeps to one coordinate in every order that it
meets, or to some that nothing passes unbroken; while a frame's upper and lower sides run across the
orders, and the coordinates of upright sides are passed above and below it. Large components whose
border is not of that kind are left as they were decoded.

If a large share of the picture contradicts its neighbours in that way, it is no noise: pictures of
the code were taken for one another, and the decoding is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfcinv

from acquisition import order_kernels as kernels
from acquisition.errors import DecodingError
from acquisition.passages import Passages, sampling_stride
from acquisition.patterns import Axis

# Neighbours' coordinates differ by no more than this many times the median difference.
_SLOPE_ALLOWANCE = 4.0
# Neighbours may be this many pixels apart, where those between them are rejected.
_FARTHEST = 4
# Pixels of a component that counts towards a systematic contradiction.
_SUBSTANTIAL_PIXELS = 30
_SUBSTANTIAL_SHARE = 1e-3
# A border keeps to a coordinate where most of it is within this share of a period; one that does in
# this share of the orders is a code's.
_KEEPS_SHARE = 0.75
_KEEPS_PERIODS = 0.1
# Wrong code breaks off along this share of its components' borders, at coordinates that nothing
# passes elsewhere, even where they also follow steps of a surface.
_UNPASSED_SHARE = 0.05
# Smaller components are put right whatever their border: that one goes on all around by chance is
# no rarer, but what is at stake is.
_STEP_SHARE = 0.03
_LEAST_OF_A_BORDER = 20


@dataclass(frozen=True)
class UnwrappedAxis:
    """Coordinates of one axis as decoded, and what they may be wrong by.

    Attributes
    ----------
    coordinate : (rows, cols) float64 array
        NaN where rejected.
    variance : (rows, cols) float32 array
    period_px : float
        Period of the finest fringe.
    extent : int
        Pixels of the panel along the axis.
    """

    coordinate: NDArray[np.float64]
    variance: NDArray[np.float32]
    period_px: float
    extent: int


@dataclass(frozen=True)
class OrderCheck:
    """Outcome of the spatial check.

    Attributes
    ----------
    coordinates : dict
        (rows, cols) float64 array by axis: repaired.
    wrong : (rows, cols) bool array
        Pixels whose order their neighbours contradict, in no way that can be put right.
    repaired_pixels : int
    rejected_pixels : int
    """

    coordinates: dict[Axis, NDArray[np.float64]]
    wrong: NDArray[np.bool_]
    repaired_pixels: int
    rejected_pixels: int


def certainty_sigmas(probability: float) -> float:
    """Standard deviations that noise exceeds, on either side, with a probability."""
    return float(np.sqrt(2) * erfcinv(probability))


def wrong_order_probability(
    sigma_rad: NDArray[np.float64] | float, ratio: float
) -> NDArray[np.float64] | float:
    """Probability that noise of the phases gives a wrong order between two fringes.

    Parameters
    ----------
    sigma_rad : float or array
        Standard deviation of both phases.
    ratio : float
        Coarse period over fine period.
    """
    from scipy.special import erfc

    return erfc(np.pi / (np.sqrt(2) * sigma_rad * np.sqrt(1 + ratio**2)))


def check_orders(
    axes: dict[Axis, UnwrappedAxis],
    *,
    uncertain: NDArray[np.unsignedinteger] | None = None,
    small: int = 8,
    agreement: float = 0.75,
    contradicted_share: float = 0.1,
) -> OrderCheck:
    """Hold the fringe orders of every pixel against those of its neighbours.

    Parameters
    ----------
    axes : dict
        :class:`UnwrappedAxis` by axis, one or two.
    uncertain : (rows, cols) array of unsigned integers, optional
        Not 0 where an order is rejected unless its component is larger than ``small``, or repaired.
    small : int
        Components of no more pixels that jump against all their neighbours are rejected.
    agreement : float
        Share of a component's border that must agree about its repair.
    contradicted_share : float
        Share of the pixels in substantial components of wrong order at which the code itself is
        taken to be wrong.

    Returns
    -------
    OrderCheck

    Raises
    ------
    DecodingError
        The orders contradict the phase over more than ``contradicted_share`` of the picture.
    """
    names = list(axes)
    pair = axes[names[0]], axes[names[-1]]
    x, y = (axis.coordinate for axis in pair)
    halves = (pair[0].period_px / 2, pair[1].period_px / 2)
    wrong = np.zeros(x.shape, np.bool_)
    coordinates = {name: axes[name].coordinate for name in names}
    slopes = np.array([_usual_slope(x), _usual_slope(y)])
    if (slopes > _SLOPE_ALLOWANCE * np.array(halves) / 2).any():
        # Periods of four pixels and less cannot be followed from pixel to pixel.
        wrong |= uncertain != 0 if uncertain is not None else False
        return OrderCheck(coordinates, wrong, 0, int(wrong.sum()))
    found = _find_components(x, y, halves, whole=x.size > small)
    if found is None:
        return OrderCheck(coordinates, wrong, 0, 0)
    jumps = kernels.list_jumps(
        x,
        y,
        pair[0].variance,
        pair[1].variance,
        2 * np.array(halves),
        slopes,
        _reach(slopes, halves),
        found.slot,
        found.down,
        found.labels,
        found.first_run,
        found.component,
    )
    verdict, shift = _judge_but_steps(jumps, found.sizes, pair, slopes, small, agreement)
    _refuse_contradiction(names, verdict, shift, found.sizes, contradicted_share)
    where = (found.slot, found.labels, found.first_run, found.component)
    if verdict.any():
        for name, moves in zip(names, shift.T, strict=False):
            moved, axis = coordinates[name].copy(), axes[name]
            own = np.ascontiguousarray(moves)
            kernels.apply_verdicts(moved, axis.period_px, axis.extent, own, verdict, *where, wrong)
            coordinates[name] = moved
    if uncertain is not None:
        supported = (found.sizes > small) | (verdict == kernels.REPAIR)
        kernels.reject_unsupported(uncertain, *where, supported, wrong)
    repaired = int(found.sizes[verdict == kernels.REPAIR].sum())
    return OrderCheck(coordinates, wrong, repaired, int(wrong.sum()))


@dataclass(frozen=True)
class _Components:
    """Pixels joined where coordinates do not jump; see :mod:`acquisition.order_kernels`.

    ``sizes`` (components,) counts their pixels; ``component`` (runs,) names that of each run;
    ``first_run`` (rows + 1,) numbers the runs; ``labels`` and ``slot`` lead from a pixel to its
    run; ``down`` (rows,) counts the jumps between each row and the next.
    """

    sizes: NDArray[np.int64]
    component: NDArray[np.int64]
    first_run: NDArray[np.int64]
    labels: NDArray[np.int32]
    slot: NDArray[np.int64]
    down: NDArray[np.int64]


def _find_components(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    halves: tuple[float, float],
    *,
    whole: bool,
) -> _Components | None:
    """Components of a picture; None where there are none, or (if ``whole`` is enough) only one."""
    along, down = kernels.rows_with_jumps(x, y, *halves)
    if whole and not along.any() and not down.any():
        return None
    broken = along > 0
    slot = np.where(broken, np.cumsum(broken) - 1, -1)
    labels = np.empty((int(broken.sum()), x.shape[1]), np.int32)
    runs = kernels.label_runs(x, y, *halves, slot, labels)
    first_run = np.concatenate([[0], np.cumsum(runs)])
    if first_run[-1] == 0:
        return None
    component, sizes = kernels.join_runs(x, y, *halves, slot, down, labels, first_run)
    return _Components(sizes, component, first_run, labels, slot, down)


def _usual_slope(coordinate: NDArray[np.float64]) -> float:
    """How much a coordinate may change from a pixel to the next without being a jump.

    Infinite where no pixel has a neighbour to compare it with.
    """
    pictures = (coordinate, coordinate.T)
    medians = [_median_step(lines[:: sampling_stride(len(lines))]) for lines in pictures]
    there = [median for median in medians if np.isfinite(median)]
    return _SLOPE_ALLOWANCE * max(there, default=float("inf"))


def _median_step(lines: NDArray[np.float64]) -> float:
    """Median change from pixel to pixel along lines; NaN where no two are within two pixels."""
    # Of a mosaic with one colour saturated every second pixel is left.
    for apart in (1, 2):
        every = sampling_stride(lines.shape[1])
        steps = np.abs(lines[:, apart::every] - lines[:, :-apart:every])
        there = steps[np.isfinite(steps)]
        if len(there):
            return float(np.median(there)) / apart
    return float("nan")


def _reach(slopes: NDArray[np.float64], halves: tuple[float, float]) -> int:
    """How far apart pixels may be compared: the usual slope takes a quarter of a period at most.

    Beyond, the surface itself would be counted as a whole period.
    """
    steepest = max(slope / (2 * half) for slope, half in zip(slopes, halves, strict=True))
    return _FARTHEST if steepest * _FARTHEST <= 1 else max(1, int(1 / steepest))


def _judge_but_steps(
    jumps: NDArray[np.int64],
    sizes: NDArray[np.int64],
    pair: tuple[UnwrappedAxis, UnwrappedAxis],
    slopes: NDArray[np.float64],
    small: int,
    agreement: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Verdict and shift of every component, with those kept that a step of the surface parts."""
    steps, of_the_code = np.zeros((2, len(sizes)), np.bool_)
    passages: list[Passages] = []
    while True:
        verdict, shift = _judge(jumps, sizes, steps, small, agreement)
        suspects = (sizes > _STEP_SHARE * sizes.sum()) & (verdict != kernels.KEEP)
        suspects &= shift.any(axis=1) & ~of_the_code
        if not suspects.any():
            return verdict, shift
        if not passages:
            count = 1 if pair[0] is pair[1] else 2
            passages = [
                Passages.of(
                    (pair[n].coordinate, pair[n].period_px),
                    (pair[1 - n].coordinate, pair[1 - n].period_px),
                )
                for n in range(count)
            ]
        for one in np.nonzero(suspects)[0]:
            of_the_code[one] = _is_of_the_code(one, jumps, pair, slopes, passages)
            steps[one] = not of_the_code[one]


def _is_of_the_code(
    component: np.int64,
    jumps: NDArray[np.int64],
    pair: tuple[UnwrappedAxis, UnwrappedAxis],
    slopes: NDArray[np.float64],
    passages: list[Passages],
) -> bool:
    """Whether a component's border of whole periods keeps to coordinates that nothing passes."""
    own = ((jumps[:, 0] == component) | (jumps[:, 1] == component)) & (jumps[:, 4] == 1)
    for number in range(len(passages)):
        jumping = own & (jumps[:, 2 + number] != 0)
        if pair[0] is not pair[1]:
            # What goes on in one axis only: no code makes both jump at one place.
            jumping &= jumps[:, 3 - number] == 0
        counted = int(jumping.sum())
        if counted < _LEAST_OF_A_BORDER:
            continue
        border, periods = jumps[jumping, 5], jumps[jumping, 2 + number]
        axis = pair[number]
        near = max(_KEEPS_PERIODS * axis.period_px, slopes[number] / 2)
        near = min(near, axis.period_px / 4)
        at = axis.coordinate.ravel()[border]
        orders, unpassed = passages[number].kept_to(at, periods * axis.period_px, near)
        if orders >= _KEEPS_SHARE or unpassed >= max(_LEAST_OF_A_BORDER, _UNPASSED_SHARE * counted):
            return True
    return False


def _judge(
    jumps: NDArray[np.int64],
    sizes: NDArray[np.int64],
    steps: NDArray[np.bool_],
    small: int,
    agreement: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    order, rank = kernels.component_rank(sizes)
    # A jump from a to b by n periods: b must move by -n to agree with a, and a by n to agree with
    # b. Listed from the component that would move.
    back = jumps[:, [1, 0, 2, 3, 4]] * np.array([1, 1, -1, -1, 1])
    both = np.concatenate([jumps[:, :5], back])
    both = np.ascontiguousarray(both[np.argsort(both[:, 0], kind="stable")])
    first_jump = np.searchsorted(both[:, 0], np.arange(len(sizes) + 1))
    verdict, shift = kernels.judge_components(
        order, rank, first_jump, both, sizes, steps, small, agreement
    )
    return verdict, shift


def _refuse_contradiction(
    names: list[Axis],
    verdict: NDArray[np.int64],
    shift: NDArray[np.int64],
    sizes: NDArray[np.int64],
    contradicted_share: float,
) -> None:
    total = sizes.sum()
    substantial = sizes >= max(_SUBSTANTIAL_PIXELS, _SUBSTANTIAL_SHARE * total)
    contradicted = substantial & ((verdict == kernels.REPAIR) | (verdict == kernels.AMBIGUOUS))
    for name, moves in zip(names, shift.T, strict=False):
        share = sizes[contradicted & (moves != 0)].sum() / total
        if share > contradicted_share:
            raise DecodingError(
                f"the fringe orders of the {name}s jump by whole periods where the phase goes on, "
                f"over {share:.0%} of the decoded picture: frames of the {name}s' code were "
                "probably taken for one another; check their order and names"
            )
