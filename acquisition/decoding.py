r"""Decoding: from frames of structured light to projector coordinates with their variance.

N phase steps give, per pixel, the mean A, the modulation B and the phase φ by linear least
squares; the fringe order comes from Gray code or from coarser fringes. For steps spread evenly
and noise σ the phase has :math:`\sigma_\varphi = \sqrt{2/N}\,\sigma/B`; here each sample's own
variance is propagated, so uneven steps and photon noise are covered.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import AxisCoordinate, CorrespondenceMap, Rejection
from acquisition.errors import DecodingError
from acquisition.frame_files import Samples
from acquisition.fringe_kernels import fit_fringe, gray_to_cell, shift_in_bit, unwrap
from acquisition.patterns import Axis, Gray, PhaseShift
from acquisition.plan import Plan, PlannedFrame
from acquisition.sample_noise import SampleNoise, fit_sample_noise

# Every how many pixels, along both directions, the noise is sampled: enough for a per cent.
_NOISE_STRIDE = 3


@dataclass(frozen=True, kw_only=True)
class DecodingOptions:
    """What decoding accepts.

    Attributes
    ----------
    noise : SampleNoise or None
        Calibrated noise of a sample; None estimates it from the fringes.
    minimum_modulation : float or None
        Smallest fringe amplitude in sensor numbers; None takes ``minimum_contrast`` times the
        noise of a sample.
    minimum_contrast : float
        Modulation over noise below which a phase is not trusted.
    order_sigmas : float
        Standard deviations by which phase and fringe order may disagree.
    """

    noise: SampleNoise | None = None
    minimum_modulation: float | None = None
    minimum_contrast: float = 3.0
    order_sigmas: float = 6.0


@dataclass(frozen=True)
class Fringe:
    """The steps of one fringe among the frames of a plan.

    Attributes
    ----------
    axis : Axis
    period_px : float
    origin_rad : float
    gamma : float
    shifts_rad : (steps,) float64 array
    frame_ids : tuple of str
        Frame of each step.
    """

    axis: Axis
    period_px: float
    origin_rad: float
    gamma: float
    shifts_rad: NDArray[np.float64]
    frame_ids: tuple[str, ...]

    @property
    def solution(self) -> NDArray[np.float64]:
        """(3, steps) pseudo-inverse from samples to (A, B cos φ, -B sin φ)."""
        design = np.stack(
            [np.ones_like(self.shifts_rad), np.cos(self.shifts_rad), np.sin(self.shifts_rad)],
            axis=1,
        )
        if len(self.shifts_rad) < 3 or np.linalg.matrix_rank(design, tol=1e-6) < 3:
            raise DecodingError(
                f"the {self.axis} fringe of period {self.period_px:g} px has "
                f"{len(self.shifts_rad)} steps that do not determine a phase; three distinct "
                "shifts are the least"
            )
        return np.ascontiguousarray(np.linalg.pinv(design))


@dataclass(frozen=True)
class _FittedFringe:
    fringe: Fringe
    turns: NDArray[np.float32]
    variance: NDArray[np.float32]  # of turns
    modulation: NDArray[np.float32]
    ambient: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    residual_rms: float


@dataclass(frozen=True)
class _Coarse:
    """A coordinate known to within ``half_width``, from Gray code or a coarser fringe."""

    coordinate: NDArray[np.float64]
    variance: NDArray[np.float32]
    half_width: float
    contradicts: NDArray[np.bool_] = field(repr=False)


ReadFrame = Callable[[str], Samples]


def find_fringes(plan: Plan) -> list[Fringe]:
    """Group the phase-shift frames of a plan into fringes, coarsest first within each axis."""
    groups: dict[tuple[Axis, float, float, float], list[tuple[float, str]]] = {}
    for frame in plan.frames:
        if isinstance(frame.pattern, PhaseShift):
            steps = groups.setdefault(frame.pattern.fringe, [])
            steps.append((frame.pattern.shift_rad, frame.id))
    fringes = [
        Fringe(*key, np.array([shift for shift, _ in steps]), tuple(i for _, i in steps))
        for key, steps in groups.items()
    ]
    return sorted(fringes, key=lambda fringe: (fringe.axis, -fringe.period_px))


def decode(
    plan: Plan, read_frame: ReadFrame, options: DecodingOptions | None = None
) -> CorrespondenceMap:
    """Decode the frames of a plan into a correspondence map.

    Parameters
    ----------
    plan : Plan
        What the frames are pictures of.
    read_frame : callable
        Takes a frame id to its (rows, cols) array of sensor numbers.
    options : DecodingOptions, optional
        Thresholds and noise.

    Returns
    -------
    CorrespondenceMap
        One coordinate for each axis that the plan has fringes for.

    Raises
    ------
    DecodingError
        No fringes, steps that do not determine a phase, orders that nothing resolves, or not one
        pixel decoded.
    """
    options = options or DecodingOptions()
    fringes = find_fringes(plan)
    if not fringes:
        raise DecodingError("the plan has no phase-shift frames, so there is nothing to decode")
    stacks = {f.frame_ids: _read_stack(f, plan, read_frame) for f in fringes}
    noise = options.noise or estimate_noise([(f, stacks[f.frame_ids]) for f in fringes])
    fitted = [_fit(f, stacks.pop(f.frame_ids), noise, plan.saturation_level) for f in fringes]

    sigma = np.sqrt(np.median([np.median(noise.variance(f.ambient)) for f in fitted]))
    least = options.minimum_modulation
    if least is None:
        least = options.minimum_contrast
    rejection = np.zeros(fitted[0].turns.shape, dtype=np.uint8)
    for fit in fitted:
        limit: NDArray[np.float64] | float = least
        if options.minimum_modulation is None:
            limit = least * np.sqrt(noise.variance(fit.ambient))
        rejection |= np.where(fit.modulation < limit, Rejection.LOW_MODULATION, 0).astype(np.uint8)
        rejection |= np.where(fit.saturated, Rejection.SATURATED, 0).astype(np.uint8)

    axes: dict[Axis, AxisCoordinate] = {}
    for axis in Axis:
        of_axis = [fit for fit in fitted if fit.fringe.axis is axis]
        if of_axis:
            coordinate, variance, wrong = _absolute(of_axis, plan, read_frame, options)
            extent = plan.projector.width if axis is Axis.COLUMN else plan.projector.height
            outside = ~((coordinate >= -0.5) & (coordinate <= extent - 0.5))
            rejection |= np.where(wrong, Rejection.WRONG_ORDER, 0).astype(np.uint8)
            rejection |= np.where(outside, Rejection.OUT_OF_RANGE, 0).astype(np.uint8)
            finest = of_axis[-1]
            axes[axis] = AxisCoordinate(
                coordinate,
                variance,
                finest.modulation,
                finest.fringe.period_px,
                finest.residual_rms,
            )
    valid = rejection == 0
    if not valid.any():
        raise DecodingError(_why_nothing(rejection, fitted, float(sigma)))
    for axis, decoded in axes.items():
        axes[axis] = AxisCoordinate(
            np.where(valid, decoded.coordinate, np.nan),
            np.where(valid, decoded.variance, np.inf).astype(np.float32),
            decoded.modulation,
            decoded.period_px,
            decoded.residual_rms,
        )
    ambient = np.mean([fit.ambient for fit in fitted], axis=0, dtype=np.float32)
    sigma = np.sqrt(np.median(noise.variance(ambient[valid])))
    return CorrespondenceMap(
        axes, ambient, rejection, (plan.crop.column, plan.crop.row), float(sigma)
    )


def estimate_noise(fringes: list[tuple[Fringe, Samples]]) -> SampleNoise:
    """Noise of a sample from the redundancy of the fringes.

    With four steps or more, the white part of each fringe's own residual; with three, the means
    of several fringes, which should agree; with a single three-step fringe, the differences of
    neighbouring pixels, which also hold texture, so that the noise is overestimated.

    Parameters
    ----------
    fringes : list of (Fringe, (steps, rows, cols) array)
        Fringes with their frames.

    Returns
    -------
    SampleNoise
    """
    redundant = [(f, stack) for f, stack in fringes if len(f.shifts_rad) > 3]
    if redundant:
        levels, sums, freedom = [], [], len(redundant[0][0].shifts_rad) - 3
        for fringe, stack in redundant:
            if len(fringe.shifts_rad) - 3 == freedom:
                level, squares = _white_residual(fringe, stack)
                levels.append(level)
                sums.append(squares)
        if sum(map(len, levels)) > 100:
            return fit_sample_noise(
                np.concatenate(levels),
                np.concatenate(sums),
                degrees_of_freedom=freedom,
                origin=f"white part of the residual of {freedom + 3} phase steps",
            )
    thin = (slice(None), slice(None, None, _NOISE_STRIDE))
    if len(fringes) > 1:
        steps = len(fringes[0][0].shifts_rad)
        means = np.stack([stack[thin].mean(axis=0).ravel() for _, stack in fringes])
        # Means of whole numbers are multiples of 1/steps, and medians of them would be too.
        means += np.random.default_rng(0).uniform(-0.5, 0.5, means.shape) / steps
        # Lamp flicker shifts a whole frame: it is no noise of the sample.
        means -= np.median(means - means.mean(axis=0), axis=1, keepdims=True)
        residual = steps * means.var(axis=0) * len(means)
        return fit_sample_noise(
            means.mean(axis=0),
            residual,
            degrees_of_freedom=len(means) - 1,
            origin=f"agreement of the means of {len(means)} fringes",
        )
    frame = fringes[0][1][0].astype(np.float64)
    second = (frame[:, 2:] - 2 * frame[:, 1:-1] + frame[:, :-2]) ** 2 / 6
    return fit_sample_noise(
        frame[:, 1:-1].ravel(),
        second.ravel(),
        degrees_of_freedom=1,
        origin="differences of neighbouring pixels (includes texture)",
    )


def _white_residual(
    fringe: Fringe, stack: Samples
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Level, and sum of squared residuals of the fringe fit with what is smooth in space removed.

    Harmonics of the projector and steps of its grey levels leave a residual too, the same along a
    fringe and smooth across it. Second differences along the rows keep only the white part.
    """
    level, modulation, residual = _residual(fringe, stack[:, :: 2 * _NOISE_STRIDE])
    second = (residual[:, :, 2:] - 2 * residual[:, :, 1:-1] + residual[:, :, :-2]) / np.sqrt(6)
    squares = (second**2).sum(axis=0)
    total = (residual[:, :, 1:-1] ** 2).sum(axis=0)
    lit = modulation[:, 1:-1] > 2 * np.sqrt(total / (len(stack) - 3))
    return level[:, 1:-1][lit], squares[lit]


def _residual(
    fringe: Fringe, stack: Samples
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Mean A, modulation B, and the residuals of every step, of the fringe fit."""
    samples = stack.astype(np.float64)
    parameters = np.tensordot(fringe.solution, samples, axes=1)
    shifts = fringe.shifts_rad
    design = np.stack([np.ones_like(shifts), np.cos(shifts), np.sin(shifts)], axis=1)
    residual = samples - np.tensordot(design, parameters, axes=1)
    return parameters[0], np.hypot(parameters[1], parameters[2]), residual


def _read_stack(fringe: Fringe, plan: Plan, read_frame: ReadFrame) -> Samples:
    frames = [read_frame(frame_id) for frame_id in fringe.frame_ids]
    shape = (plan.crop.height, plan.crop.width)
    for frame_id, frame in zip(fringe.frame_ids, frames, strict=True):
        if frame.shape != shape:
            raise DecodingError(f"frame {frame_id} is {frame.shape}, the plan says {shape}")
    return np.stack(frames)  # type: ignore[return-value]


def _fit(fringe: Fringe, stack: Samples, noise: SampleNoise, saturation: int) -> _FittedFringe:
    shape = stack.shape[1:]
    turns, variance, modulation, ambient = (np.empty(shape, np.float32) for _ in range(4))
    saturated = np.zeros(shape, np.bool_)
    fit_fringe(
        stack,
        fringe.solution,
        fringe.origin_rad / (2 * np.pi),
        noise.read_variance,
        noise.gain,
        saturation,
        turns,
        variance,
        modulation,
        ambient,
        saturated,
    )
    rms = float("nan")
    freedom = len(fringe.shifts_rad) - 3
    if freedom > 0:
        thin = stack[:, ::_NOISE_STRIDE, ::_NOISE_STRIDE]
        _, amplitude, residual = _residual(fringe, thin)
        squares = (residual**2).sum(axis=0)
        lit = amplitude > 2 * np.sqrt(squares / freedom)
        if lit.any():
            rms = float(np.sqrt(np.mean(squares[lit]) / freedom))
    return _FittedFringe(fringe, turns, variance, modulation, ambient, saturated, rms)


def _absolute(
    fitted: list[_FittedFringe], plan: Plan, read_frame: ReadFrame, options: DecodingOptions
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.bool_]]:
    """Coordinate of the finest fringe of one axis, its variance, and where orders contradict."""
    axis = fitted[0].fringe.axis
    extent = plan.projector.width if axis is Axis.COLUMN else plan.projector.height
    first_period = fitted[0].fringe.period_px
    coarse = _gray_coordinate(axis, plan, read_frame, fitted[-1].ambient, first_period)
    if coarse is None:
        longest = first_period
        if longest < extent - 1:
            raise DecodingError(
                f"nothing tells the fringe order of the {axis}s: the longest period is "
                f"{longest:g} px, the projector has {extent}; add Gray code or a fringe of one "
                "period"
            )
        nothing = np.zeros(fitted[0].turns.shape, np.bool_)
        centre = np.full(fitted[0].turns.shape, (extent - 1) / 2)
        no_variance = np.zeros(fitted[0].turns.shape, np.float32)
        coarse = _Coarse(centre, no_variance, longest / 2, nothing)
    for fit in fitted:
        period = fit.fringe.period_px
        coordinate = np.empty(fit.turns.shape)
        wrong = coarse.contradicts.copy()
        # Where the order is certain the phase may still fall anywhere within the coarse cell.
        unwrap(
            fit.turns,
            fit.variance,
            coarse.coordinate,
            coarse.variance,
            period,
            coarse.half_width,
            options.order_sigmas,
            coordinate,
            wrong,
        )
        coarse = _Coarse(coordinate, fit.variance * np.float32(period * period), 0.0, wrong)
    return coarse.coordinate, coarse.variance, coarse.contradicts


def _gray_coordinate(
    axis: Axis,
    plan: Plan,
    read_frame: ReadFrame,
    ambient: NDArray[np.float32],
    period_px: float,
) -> _Coarse | None:
    """Centre of every pixel's Gray cell, or None where the plan has no Gray code of this axis."""
    bits: dict[int, PlannedFrame] = {}
    inverses: dict[int, PlannedFrame] = {}
    codes = set()
    for frame in plan.frames:
        pattern = frame.pattern
        if isinstance(pattern, Gray) and pattern.axis is axis:
            (inverses if pattern.inverse else bits)[pattern.bit] = frame
            codes.add(pattern.code)
    if not codes:
        return None
    if len(codes) > 1:
        raise DecodingError(f"the plan has {len(codes)} different Gray codes of the {axis}s")
    _, length, step_px, offset = codes.pop()
    missing = sorted(set(range(length)) - set(bits))
    if missing:
        raise DecodingError(f"bits {missing} of the Gray code of the {axis}s are missing")
    code = np.zeros(ambient.shape, np.int32)
    for bit in range(length):
        threshold = ambient
        if bit in inverses:
            threshold = read_frame(inverses[bit].id).astype(np.float32)
        shift_in_bit(code, read_frame(bits[bit].id), threshold)
    cell = gray_to_cell(code)
    return _Coarse(
        (cell + (0.5 - offset)) * step_px,
        np.zeros(cell.shape, np.float32),
        # Half a cell, and room for blurred edges and harmonics, but less than half a period, at
        # which nothing would contradict anything.
        min(0.5 * step_px + period_px / 8, 0.45 * period_px),
        np.zeros(cell.shape, np.bool_),
    )


def _why_nothing(rejection: NDArray[np.uint8], fitted: list[_FittedFringe], sigma: float) -> str:
    shares = ", ".join(
        f"{np.mean(rejection & reason != 0):.0%} {reason.name.lower().replace('_', ' ')}"
        for reason in Rejection
        if reason and reason.name and np.any(rejection & reason)
    )
    brightest = max(float(np.max(fit.modulation)) for fit in fitted)
    return (
        f"not one pixel could be decoded ({shares}); the strongest fringe has a modulation of "
        f"{brightest:.3g} sensor numbers over a noise of {sigma:.2g}: check that the projector "
        "shows its patterns, and the exposure"
    )
