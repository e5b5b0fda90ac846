"""The simulated sensor: a linear one, with all that is between photons and numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from devices.bayer import BayerPattern
from devices.errors import DeviceError
from devices.simulated.sensor_kernels import expose, look_up

_MONO = (0.30, 0.45, 0.25)
# What red, green and blue contribute to a pixel behind each filter of a mosaic.
_FILTERS = {"R": (0.62, 0.07, 0.01), "G": (0.06, 0.88, 0.06), "B": (0.01, 0.09, 0.68)}


@dataclass(frozen=True)
class Light:
    """What reaches the pixels of a frame.

    Attributes
    ----------
    shown : (rows, cols) float32 array
        Light of the projector's panel.
    panel : (n, 2) float32 array
        Panel column and row that light each pixel.
    response : (n,) float32 array
        Radiance of each pixel per light of the panel.
    steady : (n,) float32 array
        Radiance from all other light; 1 is white paper in full light.
    """

    shown: NDArray[np.float32]
    panel: NDArray[np.float32]
    response: NDArray[np.float32]
    steady: NDArray[np.float32]


@dataclass(frozen=True)
class FixedPattern:
    """What one sensor's pixels have of their own.

    Attributes
    ----------
    sensitivity : (n,) float32 array
        Relative, about 1.
    offset_e : (n,) float32 array
        Electrons, about 0.
    """

    sensitivity: NDArray[np.float32]
    offset_e: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A linear sensor.

    Attributes
    ----------
    full_well_e : float
        Electrons that a pixel holds.
    read_noise_e : float
        Standard deviation of the read-out.
    bits : int
        Of the converter, 8 to 16.
    black_level : float
        Sensor number of no light.
    gain : float or None
        Sensor numbers per electron; None takes what puts the full well at full scale, less the
        read-out's noise, so that what is saturated reads as full scale.
    electrons_per_s : float or None
        Electrons per second on white paper in full light; None takes 20 times the full well.
    dark_e_per_s : float
        Dark current.
    prnu : float
        Standard deviation of the pixels' sensitivity, relative.
    dsnu_e : float
        Standard deviation of the pixels' fixed offset, electrons.
    bayer : BayerPattern or None
        Mosaic of a colour sensor; None if monochrome.
    """

    full_well_e: float = 10_000.0
    read_noise_e: float = 8.0
    bits: int = 10
    black_level: float = 8.0
    gain: float | None = None
    electrons_per_s: float | None = None
    dark_e_per_s: float = 2.0
    prnu: float = 0.008
    dsnu_e: float = 1.0
    bayer: BayerPattern | None = None

    def __post_init__(self) -> None:
        if not 8 <= self.bits <= 16:
            raise DeviceError(f"a simulated sensor has 8 to 16 bits, not {self.bits}")
        if not 0 <= self.black_level < self.ceiling / 2:
            raise DeviceError(f"a black level of {self.black_level:g} leaves no room for light")

    @property
    def ceiling(self) -> int:
        """Largest sensor number."""
        return 2**self.bits - 1

    @property
    def numbers_per_electron(self) -> float:
        """The gain in force."""
        if self.gain is not None:
            return self.gain
        return (self.ceiling - self.black_level) / self._surely_full_e

    @property
    def rate_e_per_s(self) -> float:
        """Electrons per second on white paper in full light."""
        if self.electrons_per_s is not None:
            return self.electrons_per_s
        return 20 * self.full_well_e

    @property
    def saturation_level(self) -> int:
        """Sensor number from which a sample may be saturated, by its well or its converter."""
        full = self.black_level + self.numbers_per_electron * self._surely_full_e
        return min(self.ceiling, round(full))

    @property
    def _surely_full_e(self) -> float:
        """What a full well reads as at least, noise included."""
        noise = float(np.hypot(self.read_noise_e, self.dsnu_e))
        return max(self.full_well_e - 5 * noise, 0.5 * self.full_well_e)

    def weights(self, colour: tuple[float, float, float]) -> NDArray[np.float64]:
        """What each colour of a light contributes, by parity of row and column, (2, 2, 3)."""
        pattern = self.bayer.value if self.bayer is not None else "MMMM"
        rows = [_FILTERS.get(letter, _MONO) for letter in pattern]
        return np.reshape(rows, (2, 2, 3)) * np.asarray(colour)

    def fixed_pattern(self, pixels: int, *, seed: int) -> FixedPattern:
        """The pattern of the sensor of a seed."""
        random = np.random.default_rng([seed, 0x50524E55])
        sensitivity = 1 + self.prnu * random.standard_normal(pixels, np.float32)
        offset = self.dsnu_e * random.standard_normal(pixels, np.float32)
        return FixedPattern(
            np.maximum(sensitivity, 0).astype(np.float32), offset.astype(np.float32)
        )

    def mean_radiance(self, light: Light) -> NDArray[np.float64]:
        """Radiance (n,) of each pixel, without noise; 1 is white paper in full light."""
        return light.steady + light.response * look_up(light.shown, light.panel)

    def expose(
        self, light: Light, pattern: FixedPattern, *, exposure_s: float, key: int
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Sensor numbers (n,) of a frame whose noise is that of ``key``.

        Raises
        ------
        DeviceError
            Light and pattern are not of the same number of pixels.
        """
        if {len(light.panel), len(light.response), len(light.steady)} != {len(pattern.sensitivity)}:
            raise DeviceError(
                f"light on {len(light.steady)} pixels meets a sensor of {len(pattern.sensitivity)}"
            )
        kind = np.uint8 if self.bits <= 8 else np.uint16
        out: NDArray[Any] = np.empty(len(light.steady), kind)
        expose(
            light.shown,
            light.panel,
            light.response,
            light.steady,
            pattern.sensitivity,
            pattern.offset_e,
            self.rate_e_per_s * exposure_s,
            self.dark_e_per_s * exposure_s,
            self.full_well_e,
            self.read_noise_e,
            self.numbers_per_electron,
            self.black_level,
            float(self.ceiling),
            np.uint64(key),
            out,
        )
        return out
