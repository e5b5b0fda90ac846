"""What the solver has to say about a texel, one bit each."""

from __future__ import annotations

from enum import IntFlag


class TexelFlag(IntFlag):
    """Remarks on a texel's reflectance.

    Attributes
    ----------
    DIFFUSE
        The material's highlight would have been seen and was not, or no highlight was seen and
        nothing is known of one: ρ_s is zero, the lobe is the prior's.
    UNOBSERVED
        No sample could have shown the highlight: lobe and ρ_s are the cluster's.
    LOBE_FROM_PRIOR
        There is a highlight, but the samples hardly narrow the prior of ln k.
    AT_BOUND
        A lobe parameter stopped at the limit of its range.
    NOT_CONVERGED
        The descent met its limit of iterations; the values are the best found.
    NO_SAMPLES
        No valid sample; ρ_d is zero, the rest is the prior's.
    DARK
        Nothing but darkness was measured: ρ_d and ρ_s are zero.
    SAMPLES_DROPPED
        Some samples were not finite, or had no positive variance, and were left out.
    NOT_FINITE
        The descent broke down, or ran to a lobe whose highlight, seen head-on, would be a thousand
        times as bright as any sample; the values are those of the diffuse fit.
    """

    DIFFUSE = 1
    UNOBSERVED = 2
    LOBE_FROM_PRIOR = 4
    AT_BOUND = 8
    NOT_CONVERGED = 16
    NO_SAMPLES = 32
    DARK = 64
    SAMPLES_DROPPED = 128
    NOT_FINITE = 256
