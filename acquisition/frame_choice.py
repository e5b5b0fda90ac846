r"""Choosing the frames of a projected code that some pixel needs, by what metering predicts.

A pixel of a fringe of period L and modulation B, taken with N steps in noise σ, adds
:math:`N (2\pi B/L)^2 / 2\sigma^2` to the inverse variance of its coordinate; exposures and fringes
add up, as decoding joins them. Beginning with all frames, whatever costs the pixels least for each
frame saved is taken away, as long as no more than a few pixels miss what they need: their target,
or nearly what they could have if they miss it anyway. In the end nothing more can be taken away.
Steps are left alone where metering shows that fewer of them let harmonics of the projector's
response into the phase.

A finer fringe also needs coarser ones that tell its order: from one period to the next the
coordinate's error must stay within half a period but for a small probability. A Gray code needs one
exposure for each pixel at which its bits stand out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from acquisition.even_steps import even_steps, step_counts
from acquisition.fringes import Fringe, exposures_of_fringes, find_fringes
from acquisition.gray_decoding import GrayCode, find_gray_code
from acquisition.journal import SkipReason
from acquisition.metering import FringeLight, LightMap
from acquisition.patterns import Axis
from acquisition.plan import Metering, Plan
from acquisition.unwrapping import certainty_sigmas

# Pixels by which frames are chosen; the counts that are told are of all of them.
_SAMPLES = 30_000
# Of half a period, for the error of a coarser coordinate; the rest is for systematic errors.
_REACH = 0.9
# Of the target, for errors by harmonics that fewer steps leave.
_SYSTEMATIC = 0.5
# Standard deviations by which bits are to stand out.
_BIT_SIGMAS = 4.5


@dataclass(frozen=True)
class Choice:
    """Whether a frame of a projected code is needed.

    Attributes
    ----------
    needed : bool
    pixels : int
        Number that would miss what they need without it and the rest of the fringe or code at its
        exposure, or the steps that were added with it; of a frame that is not needed, number that
        would gain by all of those.
    saturating : int
        Number that saturate at its exposure.
    reason : SkipReason
        Why it is not needed, if it is not.
    """

    needed: bool
    pixels: int
    saturating: int
    reason: SkipReason


def choose_frames(plan: Plan, light: LightMap, *, exposure_s: float) -> dict[str, Choice]:
    """Choose among the frames that a plan leaves to metering.

    Parameters
    ----------
    plan : Plan
        Of a projected code from one place, with a rule for metering.
    light : LightMap
        As metered.
    exposure_s : float
        At which fringes were metered: what was taken for that is needed.

    Returns
    -------
    dict of str to Choice
        By id, of all frames with fringes and Gray codes.
    """
    rule = plan.metering or Metering()
    thin = light.thinned(max(1, len(light.white) // _SAMPLES))
    chosen: dict[str, Choice] = {}
    for axis in Axis:
        groups = [
            group for group in exposures_of_fringes(find_fringes(plan)) if group[0].axis is axis
        ]
        code = find_gray_code(plan, axis)
        if groups:
            counts = _thin_out(_AxisNeeds(groups, thin, rule, code is not None), exposure_s)
            needs = _AxisNeeds(groups, light, rule, code is not None)
            for place, count in np.ndenumerate(counts):
                chosen.update(_choices_of_fringe(needs, counts, place, int(count)))
        if code is not None:
            chosen.update(_choices_of_code(code, light, thin, rule))
    return chosen


class _AxisNeeds:
    """What the fringes of an axis do for each pixel, and what each pixel needs.

    ``fringes[f][e]`` is fringe f, from coarse to fine, at exposure e, from long to short.
    """

    def __init__(
        self, groups: list[tuple[Fringe, ...]], light: LightMap, rule: Metering, coded: bool
    ) -> None:
        self.fringes = groups
        self.rule = rule
        self.coded = coded
        self.full = np.array([[fringe.steps for fringe in group] for group in groups])
        metered = {
            f.fringe.period_px: f for f in light.fringes if f.fringe.axis is groups[0][0].axis
        }
        self._systematic_px = [metered[group[0].period_px].systematic_px for group in groups]
        self._per_step, self.saturated = [], []
        for group in groups:
            told = [self._tell(metered[group[0].period_px], fringe, light) for fringe in group]
            self._per_step.append(np.stack([information for information, _ in told], axis=1))
            self.saturated.append(np.stack([saturated for _, saturated in told], axis=1))
        self._sigmas = certainty_sigmas(rule.wrong_order_probability)
        total, ordered = self._evaluate(self.full)
        self.within_reach = ordered & (total > 0)
        target = 1 / rule.sigma_px(groups[0][0].axis) ** 2
        self._needed = np.minimum(target, total * np.float32(1 - rule.slack) ** 2)
        self.total = total

    @staticmethod
    def _tell(
        metered: FringeLight, fringe: Fringe, light: LightMap
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        assert fringe.exposure_s is not None  # frames of a metered plan have exposures
        return light.information_per_step(metered, fringe.exposure_s)

    def step_counts(self, number: int, fringe: Fringe) -> tuple[int, ...]:
        """Numbers of steps that a fringe can be taken with.

        All or none, where so few that harmonics of the response would show in the coordinate.
        """
        if self._systematic_px[number] > _SYSTEMATIC * self.rule.sigma_px(fringe.axis):
            return (fringe.steps,)
        return step_counts(fringe, self.rule)

    def information(self, counts: NDArray[np.intp]) -> NDArray[np.float32]:
        """Inverse variance (pixels,) of the coordinate with so many steps of each fringe."""
        return np.sum(
            [j @ n.astype(np.float32) for j, n in zip(self._per_step, counts, strict=True)], axis=0
        )

    def missing(self, counts: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Pixels that miss what they need with so many steps."""
        total, ordered = self._evaluate(counts)
        return self.within_reach & (~ordered | (total < self._needed))

    def imprecise(self, counts: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Pixels whose coordinate misses its variance with so many steps."""
        return self.within_reach & (self.information(counts) < self._needed)

    def _evaluate(self, counts: NDArray[np.intp]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Information, and whether every fringe's order is certain."""
        total = np.zeros(len(self._per_step[0]), np.float32)
        ordered = np.ones(len(total), np.bool_)
        for number, (per_step, steps) in enumerate(zip(self._per_step, counts, strict=True)):
            own = per_step @ steps.astype(np.float32)
            if number == 0:
                ordered &= own > 0
            elif steps.any():
                period = self.fringes[number][0].period_px
                with np.errstate(divide="ignore"):
                    variance = 1 / total + 1 / own
                certain = self._sigmas * np.sqrt(variance) < _REACH * period / 2
                # Where a finer fringe is too faint it adds nothing, and is not asked for its order.
                ordered &= certain | (own == 0)
            total += own
        return total, ordered


def _thin_out(needs: _AxisNeeds, metered_s: float) -> NDArray[np.intp]:
    """Steps (fringes, exposures) after everything that no pixel needs was taken away."""
    counts = needs.full.copy()
    most = needs.rule.least_share * len(needs.within_reach)
    while True:
        best: tuple[float, NDArray[np.intp]] | None = None
        before = needs.information(counts)
        for place in np.ndindex(*counts.shape):
            fewer = _fewer(needs, place, int(counts[place]), metered_s)
            if fewer is None:
                continue
            changed = counts.copy()
            changed[place] = fewer
            if np.count_nonzero(needs.missing(changed)) > most:
                continue
            loss = _loss(before, needs.information(changed), needs.within_reach)
            loss /= counts[place] - fewer
            if best is None or loss < best[0]:
                best = loss, changed
        if best is None:
            return counts
        counts = best[1]


def _fewer(needs: _AxisNeeds, place: tuple[int, ...], count: int, metered_s: float) -> int | None:
    """The next lower number of steps that a fringe can be taken with at an exposure."""
    fringe = needs.fringes[place[0]][place[1]]
    lower = [0, *needs.step_counts(place[0], fringe)]
    if fringe.exposure_s == metered_s:
        lower = lower[1:]
    below = [n for n in lower if n < count]
    return below[-1] if below else None


def _loss(
    before: NDArray[np.float32], after: NDArray[np.float32], counted: NDArray[np.bool_]
) -> float:
    """Mean share of information that pixels lose."""
    counted = counted & (before > 0)
    if not counted.any():
        return 0.0
    return float(np.mean(1 - after[counted] / before[counted]))


def _choices_of_fringe(
    needs: _AxisNeeds, counts: NDArray[np.intp], place: tuple[int, ...], count: int
) -> Iterator[tuple[str, Choice]]:
    """Choices for the frames of a fringe at one exposure, of which ``count`` are taken."""
    fringe = needs.fringes[place[0]][place[1]]
    steps = needs.step_counts(place[0], fringe)
    saturating = int(np.count_nonzero(needs.saturated[place[0]][:, place[1]]))
    taken = even_steps(fringe, count) if count else ()
    fewer, none, with_all = counts.copy(), counts.copy(), counts.copy()
    fewer[place] = max([0, *(n for n in steps if n < count)])
    none[place] = 0
    with_all[place] = fringe.steps
    first = even_steps(fringe, int(fewer[place])) if fewer[place] else ()
    missing_first = int(np.count_nonzero(needs.missing(none))) if first else 0
    missing_rest = int(np.count_nonzero(needs.missing(fewer)))
    lacking = needs.missing(counts)
    gaining = int(np.count_nonzero(lacking & ~needs.missing(with_all)))
    reason = SkipReason.PRECISE
    if count == 0 and saturating > 0.5 * len(lacking):
        reason = SkipReason.SATURATED
    elif place[0] < len(counts) - 1 and not needs.coded:
        reason = SkipReason.ORDER_KNOWN
    needed_by = dict.fromkeys(taken, missing_rest) | dict.fromkeys(first, missing_first)
    for name in fringe.frame_ids:
        yield name, Choice(name in taken, needed_by.get(name, gaining), saturating, reason)


def _choices_of_code(
    code: GrayCode, light: LightMap, thin: LightMap, rule: Metering
) -> Iterator[tuple[str, Choice]]:
    """Choices for a Gray code: the fewest exposures at which its bits stand out for all pixels."""
    exposures = sorted({f.exposure_s for f in code.bits[0] if f.exposure_s is not None})
    readable = _readable(thin, exposures, exposures)
    most = rule.least_share * len(readable)
    taken = exposures
    for chosen in _subsets(exposures):
        if np.count_nonzero(readable & ~_readable(thin, list(chosen), exposures)) <= most:
            taken = list(chosen)
            break
    all_readable = _readable(light, exposures, exposures)
    lacking = all_readable & ~_readable(light, taken, exposures)
    for exposure_s in exposures:
        needed = exposure_s in taken
        others = [e for e in taken if e != exposure_s]
        if needed:
            missed = all_readable & ~_readable(light, others, exposures) if others else all_readable
        else:
            missed = lacking & _readable(light, [*others, exposure_s], exposures)
        saturating = light.level(light.white, exposure_s) >= light.saturation_level
        choice = Choice(
            needed,
            int(np.count_nonzero(missed)),
            int(np.count_nonzero(saturating)),
            SkipReason.ORDER_KNOWN,
        )
        for frames in (*code.bits.values(), *code.inverses.values()):
            for frame in frames:
                if frame.exposure_s == exposure_s:
                    yield frame.id, choice


def _subsets(exposures: list[float]) -> Iterator[tuple[float, ...]]:
    """Choices of exposures, fewest first, and of as many the longest first."""
    for count in range(1, len(exposures) + 1):
        yield from combinations(reversed(exposures), count)


def _readable(light: LightMap, taken: list[float], exposures: list[float]) -> NDArray[np.bool_]:
    """Pixels at which bits stand out, held against the fringe's mean level as decoding does.

    The level comes from the longest exposure that does not saturate, in proportion to the exposure;
    bits of several exposures are added up, each cut off at the ceiling. A lit bit that is surely
    cut off is just above its level, and without noise.
    """
    ceiling = np.float32(light.saturation_level)
    mean = (light.white + light.black) / 2
    per_second = np.full(len(mean), np.inf, np.float32)
    for exposure_s in exposures:
        level, top = (light.level(radiance, exposure_s) for radiance in (mean, light.white))
        np.copyto(per_second, level / light.exposures_s[exposure_s], where=top < ceiling)
    lit, dark, lit_noise, dark_noise = (np.zeros(len(mean), np.float32) for _ in range(4))
    for exposure_s in taken:
        true_s = np.float32(light.exposures_s[exposure_s])
        level = np.minimum(per_second * true_s, ceiling - np.float32(0.5))
        top, bottom = (light.level(radiance, exposure_s) for radiance in (light.white, light.black))
        variance = light.variance(np.minimum(top, ceiling))
        cut_off = top - np.float32(_BIT_SIGMAS) * np.sqrt(variance) > ceiling
        lit += np.minimum(top, ceiling) - level
        lit_noise += np.where(cut_off, 0, variance)
        dark += level - np.minimum(bottom, ceiling)
        dark_noise += light.variance(np.minimum(bottom, ceiling))
    readable = lit > np.float32(_BIT_SIGMAS) * np.sqrt(lit_noise)
    readable &= dark > np.float32(_BIT_SIGMAS) * np.sqrt(dark_noise)
    return np.isfinite(per_second) & readable
