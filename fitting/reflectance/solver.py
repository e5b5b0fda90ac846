"""Fit of Lafortune lobes to the samples of many texels at once.

Variable projection (Golub and Pereyra 1973): for a lobe's shape, ρ_d and ρ_s are linear and
non-negative and are solved for, so that one to three unknowns are left to Levenberg-Marquardt. The
loss is Huber's on standardised residuals; what the model itself is off by is part of the standard
error (:class:`~fitting.reflectance.materials.Material`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from fitting.errors import FittingError
from fitting.reflectance.batch_kernels import FitArrays, fit_batch
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.lobe import LafortuneLobes
from fitting.reflectance.materials import Material, material_table, shape_bounds
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.start_kernels import EXPONENT_OCTAVES
from fitting.reflectance.texel_kernels import SolverSettings

Floats = NDArray[np.float64]
# Weights of χ² with 0, 1, 2 and 3 degrees of freedom where three independent amplitudes that are
# zero in truth are estimated as non-negative (Kudô 1963; Shapiro 1985).
_CHI_BAR_WEIGHTS = (1 / 8, 3 / 8, 3 / 8, 1 / 8)
_WEAK = 5.0  # a highlight below this many thresholds of detection is weak


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """How texels are fitted.

    Attributes
    ----------
    search_starts : bool
        Whether descents start from the best minima of a grid over (k, r); otherwise there is one,
        from the material's lobe, which nothing but its own steps then improves on. That is for
        judging descents; it says too little of where a highlight is not to skip anything.
    starts : int
        Descents per texel: the best minima of the grid, and the material's lobe.
    start_ratios : tuple of float
        r of the grid, times the material's.
    weak_starts, weak_start_ratios : int and tuple of float
        The same for highlights that hardly stand out, whose cost has many shallow minima.
    huber_limit : float
        Standardised residual beyond which the loss grows linearly; infinite for least squares.
    skip_diffuse : bool
        Whether texels without a significant highlight are left diffuse; otherwise every texel gets
        the lobe of least cost, if only to noise.
    false_alarm_rate : float
        Share of diffuse texels in which a highlight is seen, at most.
    power : float
        Standard errors by which the material's highlight must stand out beyond the threshold of
        detection, for its absence to mean that a texel is diffuse.
    tolerance : float
        Relative fall of the cost at which a descent ends.
    max_iterations : int
        Steps of one descent.
    """

    search_starts: bool = True
    starts: int = 2
    start_ratios: tuple[float, ...] = (0.86, 1.0, 1.16)
    weak_starts: int = 8
    weak_start_ratios: tuple[float, ...] = (0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.45)
    huber_limit: float = 3.0
    skip_diffuse: bool = True
    false_alarm_rate: float = 1e-3
    power: float = 2.0
    tolerance: float = 1e-5
    max_iterations: int = 40

    def __post_init__(self) -> None:
        ratios = (*self.start_ratios, *self.weak_start_ratios)
        if min(self.starts, self.weak_starts, self.max_iterations) < 1 or not (
            self.start_ratios and self.weak_start_ratios
        ):
            raise FittingError("at least one start, one ratio and one iteration are needed")
        if not (self.huber_limit > 0.0 and self.tolerance > 0.0 and min(ratios) > 0.0):
            raise FittingError("Huber's limit, the tolerance and the start ratios must be positive")
        if not 0.0 < self.false_alarm_rate < 1.0:
            raise FittingError(f"false alarm rate is {self.false_alarm_rate}: between 0 and 1")
        if self.skip_diffuse and not self.search_starts:
            raise FittingError(
                "without a search for starts nothing shows that a texel has no highlight: "
                "skip_diffuse must be off"
            )


DEFAULT_OPTIONS = SolverOptions()


@dataclass(frozen=True)
class TexelFits:
    """Fits of ``n`` texels. Everything is finite.

    Attributes
    ----------
    lobes : LafortuneLobes
    covariance : (n, 9, 9) array
        Of ln k, ln r, ln c, ρ_d (RGB), ρ_s (RGB). Without information it is that of the prior, or
        of an even spread over the range that a parameter can have.
    cost : (n,) array
        Huber's loss of the standardised residuals, twice over, so that it is χ² without outliers.
    samples : (n,) int32 array
        Valid samples, each of three channels.
    iterations : (n,) int32 array
        Of all starts together.
    flags : (n,) int32 array
        Bits of :class:`~fitting.reflectance.flags.TexelFlag`.
    material : (n,) int32 array
        Which prior was used.
    """

    lobes: LafortuneLobes
    covariance: Floats
    cost: Floats
    samples: NDArray[np.int32]
    iterations: NDArray[np.int32]
    flags: NDArray[np.int32]
    material: NDArray[np.int32]

    @property
    def standard_errors(self) -> Floats:
        """Of all nine parameters, (n, 9)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def has_highlight(self) -> NDArray[np.bool_]:
        """Texels whose highlight was seen in their own samples, (n,)."""
        return ~self.flagged(TexelFlag.DIFFUSE | TexelFlag.UNOBSERVED | TexelFlag.NO_SAMPLES)

    def flagged(self, flag: TexelFlag) -> NDArray[np.bool_]:
        """Texels that carry any bit of ``flag``, (n,)."""
        return (self.flags & int(flag)) != 0


def highlight_threshold(false_alarm_rate: float, lobes_tried: int) -> float:
    """Fall of χ² below the diffuse fit's that noise alone reaches at the given rate, at most.

    For one given lobe the fall follows a mixture of χ² distributions; the rate is shared out
    between the lobes tried (Bonferroni), which errs on the side of fewer alarms.
    """
    wanted = false_alarm_rate / lobes_tried
    low, high = 0.0, 1000.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        tail = sum(w * special.chdtrc(df, middle) for df, w in enumerate(_CHI_BAR_WEIGHTS) if df)
        low, high = (middle, high) if tail > wanted else (low, middle)
    return high


def solver_settings(options: SolverOptions) -> SolverSettings:
    """What the compiled kernels are told."""
    ratios = options.start_ratios if options.search_starts else ()
    weak_ratios = options.weak_start_ratios if options.search_starts else ()
    lobes_tried = EXPONENT_OCTAVES * len(ratios) + 1
    threshold = highlight_threshold(options.false_alarm_rate, lobes_tried)
    needed = threshold if options.skip_diffuse else -np.inf
    return SolverSettings(
        shape_bounds(),
        int(options.starts),
        np.log(np.array(ratios, dtype=np.float64)),
        int(options.weak_starts),
        np.log(np.array(weak_ratios, dtype=np.float64)),
        float(options.huber_limit),
        needed,
        _WEAK * threshold,
        float((np.sqrt(threshold) + options.power) ** 2),
        float(options.tolerance),
        int(options.max_iterations),
    )


def fit_texels(
    samples: RadianceSamples,
    materials: list[Material] | None = None,
    material: ArrayLike | None = None,
    *,
    options: SolverOptions = DEFAULT_OPTIONS,
) -> TexelFits:
    """Fit a lobe to every texel.

    Parameters
    ----------
    samples : RadianceSamples
    materials : list of Material, optional
        Priors; by default one that says nothing.
    material : (n,) array of int, optional
        Which of ``materials`` each texel is made of; by default the first.
    options : SolverOptions

    Returns
    -------
    TexelFits

    Raises
    ------
    FittingError
        Materials are not finite, or a texel names one that is not there. Bad samples are no error:
        they are left out and flagged.
    """
    known = [Material()] if materials is None else materials
    table = material_table(known)
    n = samples.texels
    which = np.zeros(n, np.int32) if material is None else np.asarray(material).astype(np.int32)
    if which.shape != (n,) or (n > 0 and (which.min() < 0 or which.max() >= len(known))):
        raise FittingError(
            f"materials of {n} texels must be {n} numbers from 0 to {len(known) - 1}"
        )
    fits = FitArrays(
        np.zeros((n, 3)),
        np.zeros((n, 2, 3)),
        np.zeros((n, 9, 9)),
        np.zeros(n),
        np.zeros(n, np.int32),
        np.zeros(n, np.int32),
        np.zeros(n, np.int32),
    )
    fit_batch(samples.arrays, which, table, solver_settings(options), fits)
    lobes = LafortuneLobes(fits.shape, fits.rho[:, 0].copy(), fits.rho[:, 1].copy())
    return TexelFits(
        lobes, fits.covariance, fits.cost, fits.samples, fits.iterations, fits.flags, which
    )
