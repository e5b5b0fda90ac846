"""The correspondence map: which projector point lights each camera pixel, and how well we know.

This is what decoding hands on. Everything geometric downstream (triangulation, registration of
photographs, calibration from boards) starts from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from acquisition.patterns import Axis


class Rejection(IntFlag):
    """Why a pixel has no usable projector coordinate (bits, so that reasons add up)."""

    NONE = 0
    NOT_RECORDED = 1  # outside the recorded crop, or not finite
    LOW_MODULATION = 2  # fringe contrast does not rise above the noise
    SATURATED = 4  # a sample at the sensor's ceiling
    WRONG_ORDER = 8  # phase and fringe order contradict one another
    OUT_OF_RANGE = 16  # decoded coordinate outside the projector
    NO_INTERSECTION = 32  # rays of camera and projector do not meet in front of both
    OFF_EPIPOLAR = 64  # row and column decoded contradict the rig's geometry
    OUTLIER = 128  # far from every neighbour
    MIXED_LIGHT = 256  # no single fringe explains the samples: reflections, highlights, movement


@dataclass(frozen=True)
class PhaseHarmonic:
    """A periodic error of a fringe's phase that was compensated.

    Attributes
    ----------
    order : int
        Periods of the error in one of the fringe.
    amplitude_rad : float
        What was subtracted.
    residual_rad : float
        Amplitude that the same estimate finds afterwards.
    sigma_rad : float
        Standard error of the amplitude.
    """

    order: int
    amplitude_rad: float
    residual_rad: float
    sigma_rad: float


@dataclass(frozen=True)
class AxisCoordinate:
    """Projector coordinate along one axis, per camera pixel.

    Attributes
    ----------
    coordinate : (rows, cols) float64 array
        Projector pixels; NaN where rejected.
    variance : (rows, cols) float32 array
        Variance of ``coordinate`` in square pixels; infinite where rejected.
    modulation : (rows, cols) float32 array
        Fringe amplitude B in sensor numbers.
    period_px : float
        Period of the finest fringe: what a wrong fringe order shifts the coordinate by.
    residual_rms : float
        RMS of what the fringe model leaves unexplained, in sensor numbers; NaN if there are no
        more steps than unknowns.
    harmonics : tuple of PhaseHarmonic
        Errors of the finest fringe's phase by the projector's response, if they were compensated.
    """

    coordinate: NDArray[np.float64]
    variance: NDArray[np.float32]
    modulation: NDArray[np.float32]
    period_px: float
    residual_rms: float
    harmonics: tuple[PhaseHarmonic, ...] = ()


@dataclass(frozen=True)
class CorrespondenceMap:
    """Projector coordinates seen by each camera pixel.

    Attributes
    ----------
    axes : dict
        :class:`AxisCoordinate` by :class:`~acquisition.patterns.Axis`; one axis is enough.
    ambient : (rows, cols) float32 array
        Mean level A of the finest fringes in sensor numbers.
    rejection : (rows, cols) uint16 array
        :class:`Rejection` bits, 0 where every axis present is good.
    origin : (int, int)
        Column and row, in the camera's full frame, of element ``[0, 0]`` (captures may be
        cropped).
    noise_sigma : float
        Standard deviation of one sample in sensor numbers, as used for the variances (median
        over the accepted pixels).
    """

    axes: dict[Axis, AxisCoordinate]
    ambient: NDArray[np.float32]
    rejection: NDArray[np.uint16]
    origin: tuple[int, int]
    noise_sigma: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the map."""
        rows, cols = self.rejection.shape
        return rows, cols

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(rows, cols) bool array: pixels with no rejection."""
        return self.rejection == 0

    @property
    def modulation(self) -> NDArray[np.float32]:
        """(rows, cols) float32 array: the smallest modulation over the axes."""
        return np.minimum.reduce([axis.modulation for axis in self.axes.values()])

    def pixels(self) -> NDArray[np.float64]:
        """Camera pixel coordinates (column, row in the full frame) of every element.

        Returns
        -------
        (rows, cols, 2) float64 array
        """
        rows, cols = self.shape
        col, row = np.meshgrid(
            np.arange(cols, dtype=np.float64) + self.origin[0],
            np.arange(rows, dtype=np.float64) + self.origin[1],
        )
        return np.stack([col, row], axis=-1)
