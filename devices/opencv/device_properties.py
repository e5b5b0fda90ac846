"""Properties of a VideoCapture: set, and read back, because ``set`` promises what it likes."""

from __future__ import annotations

import math
from typing import Any

import cv2

from devices.errors import DeviceError
from devices.opencv.settings import Backend, ExposureUnit

# What backends answer about a property that the device does not have; 0 is an answer of V4L2.
_ABSENT = -1.0
_SECONDS = {
    ExposureUnit.HUNDRED_MICROSECONDS: 1e-4,
    ExposureUnit.MICROSECONDS: 1e-6,
    ExposureUnit.MILLISECONDS: 1e-3,
    ExposureUnit.SECONDS: 1.0,
}
_UNITS = {
    Backend.V4L2: ExposureUnit.HUNDRED_MICROSECONDS,
    Backend.DIRECT_SHOW: ExposureUnit.POWERS_OF_TWO,
    Backend.MEDIA_FOUNDATION: ExposureUnit.POWERS_OF_TWO,
}
# A device may round to steps of its own, by this share at most.
_ROUNDING = 0.25


class DeviceProperties:
    """What can be set on an open capture.

    Parameters
    ----------
    capture : cv2.VideoCapture
    backend : str
        As the capture names it.
    """

    def __init__(self, capture: Any, backend: str) -> None:
        self._capture = capture
        self._backend = backend.casefold()

    def has(self, name: str) -> bool:
        """Whether the device has a property, as far as the backend tells."""
        value = self._capture.get(_number_of(name))
        # Other backends than V4L2 answer 0 about what they do not know.
        return value != _ABSENT and (self._backend == Backend.V4L2 or value != 0)

    def fix(self, name: str, value: float, *, why: str = "") -> None:
        """Set a property that must then have the value.

        Raises
        ------
        DeviceError
            There is no such property, or it keeps another value.
        """
        number = _number_of(name)
        accepted = self._capture.set(number, value)
        is_now = self._capture.get(number)
        if not math.isclose(is_now, value, rel_tol=1e-3, abs_tol=1e-9):
            refused = "" if accepted else ", which the device refuses"
            raise DeviceError(
                f"{name} is {is_now:g} after it was set to {value:g}{refused}"
                f"{f': {why}' if why else ''}; set it with v4l2-ctl or the maker's program"
            )

    def switch_off(self, name: str, value: float, *, why: str) -> None:
        """Give an automatic function the value that switches it off, if the device has it."""
        if self._capture.get(_number_of(name)) != value and self.has(name):
            self.fix(name, value, why=why)

    def expose(self, exposure_s: float, unit: ExposureUnit) -> float:
        """Set the exposure; returns the one that the device tells then.

        Raises
        ------
        DeviceError
            It refuses, or keeps another one.
        """
        wanted = to_unit(exposure_s, unit)
        accepted = self._capture.set(cv2.CAP_PROP_EXPOSURE, wanted)
        is_now = self._capture.get(cv2.CAP_PROP_EXPOSURE)
        applied = from_unit(is_now, unit)
        if not (accepted and applied > 0 and abs(is_now - wanted) <= _slack(wanted, unit)):
            told = "accepts" if accepted else "refuses"
            raise DeviceError(
                f"the device {told} an exposure of {exposure_s:g} s and says that it has "
                f"{applied:g} s ({is_now:g} in units of {unit}); set exposure_unit, or "
                "fixed_exposure_s if it cannot be set"
            )
        return applied


def unit_of(backend: str) -> ExposureUnit | None:
    """The unit of a backend's exposures; None if it is not known."""
    name = backend.casefold()
    return _UNITS.get(Backend(name)) if name in list(Backend) else None


def to_unit(exposure_s: float, unit: ExposureUnit) -> float:
    """Number that a device is set to for an exposure in seconds."""
    if unit is ExposureUnit.POWERS_OF_TWO:
        return float(round(math.log2(exposure_s)))
    scaled = exposure_s / _SECONDS[unit]
    return max(1.0, round(scaled)) if unit is not ExposureUnit.SECONDS else scaled


def from_unit(number: float, unit: ExposureUnit) -> float:
    """Exposure in seconds of a device's number."""
    if unit is ExposureUnit.POWERS_OF_TWO:
        return 2.0**number
    return number * _SECONDS[unit]


def _slack(number: float, unit: ExposureUnit) -> float:
    """How far from the number that was set a device may round it."""
    if unit is ExposureUnit.POWERS_OF_TWO:
        return 0.0
    rounding = _ROUNDING * number
    return rounding if unit is ExposureUnit.SECONDS else max(1.0, rounding)


def _number_of(name: str) -> int:
    number = getattr(cv2, f"CAP_PROP_{name}", None)
    if not isinstance(number, int):
        raise DeviceError(f"OpenCV knows no property {name}; names are those of CAP_PROP_…")
    return number
