r"""Metering: what light each pixel gets from the room and the projector, and how much it swings.

The first frames of a scan tell: white and black at every exposure are merged into the radiance of
either, and some steps of every fringe, at one exposure, into its modulation. From these follows
what a pixel would read at any exposure, and so the variance that its coordinate would have:
:math:`\sigma_\varphi^2 = 2\sigma^2/(N B^2)` for N steps of modulation B.

Metering frames are frames of the scan like any other; decoding uses them too.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import DecodingError
from acquisition.even_steps import metering_steps
from acquisition.exposure_ratios import estimate_exposures
from acquisition.frame_files import Samples
from acquisition.frame_stream import ReadFrame
from acquisition.fringes import Fringe, find_fringes
from acquisition.harmonics import error_orders, series_along_lines
from acquisition.hdr import merge_bracket
from acquisition.patterns import BLACK, WHITE, Uniform
from acquisition.plan import Metering, Plan
from acquisition.sample_noise import QUANTISATION_VARIANCE, SampleNoise, estimate_noise

# Share of the pixels that white may saturate at the exposure at which fringes are metered.
_SATURATED = 0.5
_LINES = 64
# Modulation over noise of pixels that tell the harmonics.
_CLEAR = 10.0
# Relative error of an exposure that is taken for what it was found to be.
_TRUSTED = 0.01
# Of a black frame whose neighbours tell its noise.
_LEAST_COLUMNS = 16
# Of a chi-square variable of one degree of freedom.
_CHI_SQUARE_MEDIAN = 0.4549
# Standard errors of a harmonic that is told from none.
_SIGNIFICANT = 3.0
# Of white less black over the ceiling, for a pixel to count as lit.
_LIT = 0.02
# What is predicted to come closer to the ceiling than this many standard deviations is left out.
_HEADROOM_SIGMAS = 3.0
# Modulation over noise below which decoding trusts no phase.
_LEAST_CONTRAST = 3.0


@dataclass(frozen=True)
class FringeLight:
    """A fringe as metered: its modulation per second of exposure.

    Attributes
    ----------
    fringe : Fringe
        As planned, at the exposure at which it was metered.
    modulation : (pixels,) float32 array
        Sensor numbers per second.
    systematic_px : float
        RMS error by harmonics of the projector's response that so few steps leave in the
        coordinate; 0 where the picture does not tell.
    """

    fringe: Fringe
    modulation: NDArray[np.float32]
    systematic_px: float


@dataclass(frozen=True)
class LightMap:
    """What metering tells of every pixel.

    Attributes
    ----------
    white, black : (pixels,) float32 array
        Sensor numbers per second, above the sensor's black level, under a white and a dark panel;
        the latter is the ambient light. Infinite where every exposure saturates.
    fringes : tuple of FringeLight
        Of every axis, from coarse to fine.
    exposures_s : dict of float to float
        What planned exposures truly are.
    noise : SampleNoise
        By a sample's number, black level included.
    black_level : float
        Sensor number without light.
    saturation_level : int
    """

    white: NDArray[np.float32]
    black: NDArray[np.float32]
    fringes: tuple[FringeLight, ...]
    exposures_s: dict[float, float]
    noise: SampleNoise
    black_level: float
    saturation_level: int

    def thinned(self, every: int) -> LightMap:
        """Every so many pixels of it."""
        return replace(
            self,
            white=self.white[::every],
            black=self.black[::every],
            fringes=tuple(replace(f, modulation=f.modulation[::every]) for f in self.fringes),
        )

    def level(self, radiance: NDArray[np.float32], exposure_s: float) -> NDArray[np.float32]:
        """Sensor numbers that a radiance reads as at a planned exposure, if nothing saturates."""
        return np.float32(self.black_level) + radiance * np.float32(self.exposures_s[exposure_s])

    def variance(self, level: NDArray[np.float32]) -> NDArray[np.float32]:
        """Variance of samples that read as given."""
        variance = self.noise.variance(np.minimum(level, np.float32(self.saturation_level)))
        return np.maximum(variance, QUANTISATION_VARIANCE).astype(np.float32)

    def information_per_step(
        self, light: FringeLight, exposure_s: float
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Inverse variance that a step of a fringe adds to a pixel's coordinate.

        Parameters
        ----------
        light : FringeLight
        exposure_s : float
            As planned.

        Returns
        -------
        (pixels,) float32 array
            1/px²; 0 where the fringe would saturate, or hardly rise above the noise.
        (pixels,) bool array
            Where it would saturate.
        """
        true_s = np.float32(self.exposures_s[exposure_s])
        modulation = light.modulation * true_s
        mean = self.level((self.white + self.black) / 2, exposure_s)
        variance = self.variance(mean)
        sigma = np.sqrt(variance)
        top = mean + modulation + np.float32(_HEADROOM_SIGMAS) * sigma
        saturated = ~(top < self.saturation_level)
        faint = modulation < np.float32(_LEAST_CONTRAST) * sigma
        per_radian = light.fringe.period_px / (2 * np.pi)
        with np.errstate(invalid="ignore"):
            information = np.square(modulation / np.float32(per_radian)) / (2 * variance)
        information[saturated | faint] = 0.0
        return information.astype(np.float32), saturated


def flats_of(plan: Plan) -> tuple[dict[float, str], dict[float, str]]:
    """White frames of a plan by exposure, from short to long, and black ones."""
    white: dict[float, str] = {}
    black: dict[float, str] = {}
    for frame in sorted(plan.frames, key=lambda frame: frame.exposure_s or 0.0):
        if frame.exposure_s is not None and isinstance(frame.pattern, Uniform):
            flats = {WHITE: white, BLACK: black}.get(frame.pattern)
            if flats is not None:
                flats.setdefault(frame.exposure_s, frame.id)
    return white, black


def metering_exposure(plan: Plan, read_frame: ReadFrame) -> float:
    """Exposure at which fringes are metered: the longest at which white saturates few pixels.

    Parameters
    ----------
    plan : Plan
        Of a projected code from one place.
    read_frame : callable
        Takes a frame id to its samples; asked for white frames.
    """
    white, _ = flats_of(plan)
    for exposure_s in sorted(white, reverse=True):
        image = read_frame(white[exposure_s])
        if np.mean(image >= plan.saturation_level) <= _SATURATED:
            break
    return exposure_s


def measure_light(plan: Plan, read_frame: ReadFrame, *, exposure_s: float) -> LightMap:
    """Measure every pixel's light from the metering frames of a scan.

    Parameters
    ----------
    plan : Plan
        Of a projected code from one place, with a rule for metering.
    read_frame : callable
        Takes a frame id to its samples; asked for white and black frames, and for those of
        :func:`metering_steps` at the exposure.
    exposure_s : float
        Of :func:`metering_exposure`.

    Returns
    -------
    LightMap
    """
    rule = plan.metering or Metering()
    fringes = [f for f in find_fringes(plan) if f.exposure_s == exposure_s]
    fitted = [
        _fit(fringe, metering_steps(fringe, rule), read_frame, plan.saturation_level)
        for fringe in fringes
    ]
    noise = estimate_noise(
        [(fit.fringe, fit.rows) for fit in fitted], saturation=plan.saturation_level
    )
    white_ids, black_ids = flats_of(plan)
    whites = [read_frame(name) for name in white_ids.values()]
    blacks = [read_frame(name) for name in black_ids.values()]
    noise = _with_slope(noise, fitted, blacks)
    true_s, black_level = _exposures(list(white_ids), whites, blacks, noise, plan.saturation_level)
    merged = partial(
        _merged, noise=noise, black_level=black_level, saturation_level=plan.saturation_level
    )
    white = merged(whites, list(true_s.values()))
    black = merged(blacks, [true_s[e] for e in black_ids])
    with np.errstate(invalid="ignore"):
        contrast = (white - black) / 2
    lit = np.isfinite(contrast) & (contrast * true_s[exposure_s] > _LIT * plan.saturation_level)
    return LightMap(
        white,
        black,
        tuple(
            FringeLight(
                fringe,
                _modulation(fit, contrast, lit, true_s[exposure_s]),
                _systematic(fit, noise, plan.saturation_level),
            )
            for fringe, fit in zip(fringes, fitted, strict=True)
        ),
        true_s,
        noise,
        black_level,
        plan.saturation_level,
    )


@dataclass(frozen=True)
class _Fit:
    """Steps of a fringe, fitted: (pixels,) modulation and saturation, and some lines of each."""

    fringe: Fringe
    modulation: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    rows: Samples
    columns: Samples


def _fit(
    fringe: Fringe, steps: tuple[str, ...], read_frame: ReadFrame, saturation_level: int
) -> _Fit:
    places = [fringe.frame_ids.index(name) for name in steps]
    part = replace(fringe, shifts_rad=fringe.shifts_rad[places], frame_ids=steps)
    cosine = sine = np.float32(0)
    saturated = np.zeros((), np.bool_)
    rows, columns = [], []
    for number, name in enumerate(steps):
        image = read_frame(name)
        weights = part.solution[:, number].astype(np.float32)
        cosine = cosine + weights[1] * image
        sine = sine + weights[2] * image
        saturated = saturated | (image >= saturation_level)
        rows.append(image[_spread(image.shape[0])])
        columns.append(image.T[_spread(image.shape[1])])
    modulation = np.hypot(cosine, sine).ravel()
    return _Fit(part, modulation, saturated.ravel(), np.stack(rows), np.stack(columns))


def _with_slope(noise: SampleNoise, fitted: list[_Fit], blacks: list[Samples]) -> SampleNoise:
    """Noise by a straight line from that of a black frame to that of the fringes.

    Fringes on one grey cannot tell how noise grows with the light, and those on dark ones hardly
    what there is without it.
    """
    if blacks[0].shape[1] < _LEAST_COLUMNS:
        return noise
    dark_level, dark_variance = _white_noise(blacks[0])
    if noise.gain > 0:
        # What is more than the fringes say is texture.
        dark_variance = min(dark_variance, float(noise.variance(np.array(dark_level))))
    lit_level = float(np.median(np.mean([fit.rows.mean(axis=0) for fit in fitted], axis=0)))
    rise = float(noise.variance(np.array(lit_level))) - dark_variance
    if lit_level - dark_level < _CLEAR * dark_variance**0.5:
        # Fringes that hardly rise above the noise make it out to be too small.
        return replace(noise, read_variance=max(noise.read_variance, _white_noise(blacks[-1])[1]))
    if rise <= 0:
        return noise
    gain = rise / (lit_level - dark_level)
    return replace(noise, read_variance=dark_variance, gain=gain, black_level=dark_level)


def _white_noise(black: Samples) -> tuple[float, float]:
    """Level of a black frame, and variance by its second differences.

    Those of every second pixel, so that the colours of a mosaic are no texture.
    """
    lines = black[_spread(len(black))].astype(np.float64)
    second = lines[:, 4:] - 2 * lines[:, 2:-2] + lines[:, :-4]
    # Medians of whole numbers are whole numbers.
    second += np.random.default_rng(0).uniform(-0.5, 0.5, second.shape)
    variance = float(np.median(second**2)) / 6 / _CHI_SQUARE_MEDIAN
    return float(np.median(lines)), max(variance, QUANTISATION_VARIANCE)


def _spread(count: int) -> NDArray[np.intp]:
    """Some lines of a picture of so many."""
    return np.unique(np.linspace(0, count - 1, min(_LINES, count)).astype(np.intp))


def _systematic(fit: _Fit, noise: SampleNoise, saturation_level: int) -> float:
    """RMS error of the coordinate by harmonics, px."""
    turns: list[NDArray[np.floating]] = []
    good: list[NDArray[np.bool_]] = []
    for lines in (fit.rows, fit.columns):
        mean, cosine, sine = np.tensordot(fit.fringe.solution, lines.astype(np.float64), axes=1)
        turns.append(np.mod(np.arctan2(sine, cosine) / (2 * np.pi), 1.0))
        clear = np.hypot(cosine, sine) > _CLEAR * np.sqrt(noise.variance(mean))
        good.append(clear & (lines < saturation_level).all(axis=0))
    # The first is the largest by far.
    series = series_along_lines(turns, good, error_orders(fit.fringe)[:1])
    if series is None or series.amplitudes_rad[0] < _SIGNIFICANT * 2 * np.pi * series.sigma[0]:
        return 0.0
    return float(series.amplitudes_rad[0] / np.sqrt(2) * fit.fringe.period_px / (2 * np.pi))


def _exposures(
    planned_s: list[float],
    whites: list[Samples],
    blacks: list[Samples],
    noise: SampleNoise,
    saturation_level: int,
) -> tuple[dict[float, float], float]:
    """What planned exposures truly are, and the sensor's black level."""
    black_level = _black_level(planned_s, blacks, saturation_level)
    true_s = np.asarray(planned_s)
    # Two pictures with little in common, or of one grey, tell no ratio.
    with contextlib.suppress(DecodingError):
        found = estimate_exposures(
            whites,
            planned_s,
            noise=_above(noise, black_level),
            black_level=black_level,
            saturation_level=saturation_level,
        )
        true_s = np.where(found.relative_error < _TRUSTED, found.exposures_s, true_s)
    return dict(zip(planned_s, map(float, true_s), strict=True)), black_level


def _black_level(planned_s: list[float], blacks: list[Samples], saturation_level: int) -> float:
    """Sensor number without light: what the black frames would read at no exposure.

    Of a single exposure nothing is predicted for another one, and any level does.
    """
    short, long = blacks[0], blacks[-1]
    dark = long < saturation_level
    if not dark.any():
        return 0.0
    level = float(short[dark].mean())
    if len(blacks) > 1:
        rise = float(long[dark].mean()) - level
        level -= rise * planned_s[0] / (planned_s[-1] - planned_s[0])
    return max(level, 0.0)


def _above(noise: SampleNoise, black_level: float) -> SampleNoise:
    """Noise by the level above black."""
    read = noise.read_variance + noise.gain * (black_level - noise.black_level)
    return replace(noise, read_variance=max(read, QUANTISATION_VARIANCE), black_level=0.0)


def _merged(
    frames: list[Samples],
    exposures_s: list[float],
    *,
    noise: SampleNoise,
    black_level: float,
    saturation_level: int,
) -> NDArray[np.float32]:
    merged = merge_bracket(
        frames,
        exposures_s,
        noise=_above(noise, black_level),
        black_level=black_level,
        saturation_level=saturation_level,
    ).radiance.ravel()
    return np.where(np.isnan(merged), np.float32(np.inf), np.maximum(merged, 0))


def _modulation(
    fit: _Fit, contrast: NDArray[np.float32], lit: NDArray[np.bool_], true_s: float
) -> NDArray[np.float32]:
    """Modulation per second: as measured, or where that saturates, by white less black."""
    measured = fit.modulation / np.float32(true_s)
    good = lit & ~fit.saturated
    share = float(np.median(measured[good] / contrast[good])) if good.any() else 1.0
    with np.errstate(invalid="ignore"):
        inferred = np.where(np.isfinite(contrast), np.float32(share) * contrast, 0)
    return np.where(fit.saturated, inferred, measured).astype(np.float32)
