"""What the compiled loops of decoding are told of samples, fringes and orders, and what they fill.

Named tuples, because compiled loops take them as they are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class SampleModel(NamedTuple):
    """What a sample's level says of its quality, float32.

    ``variance = read + gain * max(level - black, 0)``. A modulation below ``least`` or below
    ``contrast`` standard deviations is low; a sample at ``saturation`` or above is saturated.
    """

    read: np.float32
    gain: np.float32
    black: np.float32
    saturation: np.float32
    least: np.float32
    contrast: np.float32


class FringeModel(NamedTuple):
    """What a fit of a fringe needs beside the weights of its steps.

    ``isotropic`` says that the phase's variance does not depend on the phase. ``moments`` and
    ``gram`` are :attr:`~acquisition.fringes.StepFit.variance_moments` and
    :attr:`~acquisition.fringes.StepFit.gram`. ``squares_limit`` bounds the sum of squared residuals
    by noise, in variances of a sample (infinite where there is no redundancy), and ``harmonics``
    what harmonics may add to its root, in modulations. ``correction`` (harmonics, 3) holds rows of
    order, cosine and sine: a Fourier series in the raw phase that is subtracted from it, turns.
    """

    origin_turns: np.float32
    isotropic: bool
    moments: NDArray[np.float32]
    gram: NDArray[np.float32]
    squares_limit: np.float32
    harmonics: np.float32
    correction: NDArray[np.float32]


class UnwrapStep(NamedTuple):
    """How a fringe is unwrapped by a coarse coordinate: the period float64, the rest float32.

    For the ``first`` fringe, where nothing is known before it, the coarse coordinate is ``centre``,
    of no variance.
    The two may differ by ``half_width`` (of the coarse coordinate's cell, and systematic) plus
    ``sigmas`` standard deviations; beyond ``mixed_sigmas`` the light is mixed. The order is too
    uncertain where ``certain_sigmas`` standard deviations exceed ``reach``, and cannot be borne out
    by neighbours where ``borne_out_sigmas`` do. Where it is certain, the coarse coordinate adds to
    the fine one by inverse variance, its own increased by ``systematic`` (infinite: it adds
    nothing). The panel has ``extent`` pixels.
    """

    period: float
    first: bool
    centre: np.float32
    half_width: np.float32
    sigmas: np.float32
    mixed_sigmas: np.float32
    certain_sigmas: np.float32
    borne_out_sigmas: np.float32
    reach: np.float32
    systematic: np.float32
    extent: np.float32


class AxisState(NamedTuple):
    """What an axis is decoded to, fringe by fringe; all of (pixels,).

    ``near`` is the coordinate so far, float32, and ``variance`` its variance; ``rejection`` the
    bits, uint16, shared by all axes. The finest fringe leaves its coordinate in full precision in
    ``coordinate``, float64, and its modulation in ``modulation``, before it both are empty; and it
    adds its mean level to ``ambient``, float32, shared too.
    """

    near: NDArray[np.float32]
    variance: NDArray[np.float32]
    ambient: NDArray[np.float32]
    rejection: NDArray[np.uint16]
    coordinate: NDArray[np.float64]
    modulation: NDArray[np.float32]
