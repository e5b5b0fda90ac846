"""A tethered camera's settings: read, set and read back, everything automatic off.

Names and values of settings are those of libgphoto2's PTP driver (``camlibs/ptp2/config.c``); each
maker has its own. What a camera does not have is not asked of it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from devices.errors import DeviceError
from devices.gphoto2.library import CameraErrors

EXPOSURE_TIME = ("shutterspeed", "shutterspeed2", "exptime")
_ISO = ("iso", "isospeed")
_APERTURE = ("aperture", "f-number")
_FORMAT = ("imageformat", "imagequality", "imageformatsd", "imageformatcf")
_TARGET = ("capturetarget",)
_BATTERY = ("batterylevel",)
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_LEAST_ISO = 100


@dataclass(frozen=True)
class Requirement:
    """A setting that must have one of some values.

    Attributes
    ----------
    names : tuple of str
        What makers call it.
    values : tuple of str
        In lower case, the best first; ``0`` is what a switch that is off reads as.
    why : str
        What is wrong with any other.
    by_hand : str
        How to set it where that cannot be done from here.
    """

    names: tuple[str, ...]
    values: tuple[str, ...]
    why: str
    by_hand: str


REQUIREMENTS = (
    Requirement(
        ("autoexposuremode", "expprogram", "exposuremode"),
        ("manual", "m"),
        "the camera would choose its exposure",
        "turn the mode dial to M",
    ),
    Requirement(
        ("isoauto", "autoiso"),
        ("off", "0"),
        "the camera would choose its sensitivity",
        "switch off automatic ISO in its menu",
    ),
    Requirement(
        ("longexpnr", "longexposurenoisereduction"),
        ("off", "0"),
        "it subtracts a dark frame and takes twice as long",
        "switch off long exposure noise reduction in its menu",
    ),
    Requirement(
        ("highisonr", "highisonoisereduction"),
        ("off", "0"),
        "samples may be smoothed",
        "switch off high ISO noise reduction in its menu",
    ),
    Requirement(
        ("rawcompression",),
        ("lossless compressed", "lossless", "uncompressed"),
        "samples would be rounded",
        "set lossless raw compression in its menu",
    ),
    Requirement(
        ("imagestabilization", "imagestabilizer", "vibrationreduction", "opticalstabilization"),
        ("off", "0"),
        "the picture would move against the sensor",
        "switch off stabilisation at lens and body",
    ),
    Requirement(
        ("bracketmode", "bracketing", "aeb"),
        ("off", "0", "disabled"),
        "exposures would vary from frame to frame",
        "switch off bracketing in its menu",
    ),
    Requirement(
        ("capturemode", "drivemode", "stillcapturemode"),
        ("single", "single shot", "single frame", "single-shot"),
        "the camera would lift its mirror, wait or go on instead of taking one picture",
        "set the drive dial to single pictures",
    ),
    Requirement(
        ("mirrorlock", "mirrorlockup"),
        ("off", "0", "disable"),
        "the first release would only lift the mirror",
        "switch off mirror lock-up in its menu",
    ),
    Requirement(
        ("exposuredelaymode",),
        ("off", "0"),
        "exposures would begin seconds late",
        "switch off the exposure delay in its menu",
    ),
    Requirement(
        ("autofocus",),
        ("off", "0"),
        "the lens would change the picture's scale from frame to frame",
        "set the lens to manual focus",
    ),
)


class Configuration:
    """The settings of an open camera.

    Parameters
    ----------
    gphoto2 : module
    camera : gphoto2.Camera
    errors : CameraErrors
    """

    def __init__(self, gphoto2: Any, camera: Any, errors: CameraErrors) -> None:
        self._gphoto2 = gphoto2
        self._camera = camera
        self._errors = errors
        with errors.named("the camera's settings cannot be read"):
            tree = camera.get_config()
            self._names = frozenset(_names_below(tree))

    def name_of(self, names: Iterable[str]) -> str | None:
        """The first of some names that the camera has."""
        return next((name for name in names if name in self._names), None)

    def read(self, name: str) -> str:
        """Value of a setting, as it is now."""
        with self._errors.named(f"the camera's {name} cannot be read"):
            return str(self._camera.get_single_config(name).get_value())

    def choices(self, name: str) -> list[str]:
        """Values that a setting can have; empty if it is no list."""
        gphoto2 = self._gphoto2
        with self._errors.named(f"the camera's {name} cannot be read"):
            widget = self._camera.get_single_config(name)
            kind = widget.get_type()
            if kind == gphoto2.GP_WIDGET_TOGGLE:
                return ["0", "1"]
            if kind not in (gphoto2.GP_WIDGET_RADIO, gphoto2.GP_WIDGET_MENU):
                return []
            return [widget.get_choice(number) for number in range(widget.count_choices())]

    def write(self, name: str, value: str) -> str:
        """Set a setting; returns what it is then."""
        gphoto2 = self._gphoto2
        with self._errors.named(f"the camera's {name} cannot be set to {value}"):
            widget = self._camera.get_single_config(name)
            if widget.get_readonly():
                return str(widget.get_value())
            toggle = widget.get_type() == gphoto2.GP_WIDGET_TOGGLE
            widget.set_value(int(value) if toggle else value)
            self._camera.set_single_config(name, widget)
        return self.read(name)

    def require(self, requirement: Requirement) -> None:
        """Give a setting one of the values that it must have.

        Raises
        ------
        DeviceError
            It keeps another one; it is named.
        """
        name = self.name_of(requirement.names)
        if name is None:
            return
        is_now = self.read(name)
        if is_now.casefold() in requirement.values:
            return
        offered = {choice.casefold(): choice for choice in self.choices(name)}
        wanted = next((offered[v] for v in requirement.values if v in offered), None)
        refusal = ""
        if wanted is not None:
            try:
                is_now = self.write(name, wanted)
            except DeviceError as error:
                refusal = f" ({error})"
        if is_now.casefold() not in requirement.values:
            raise DeviceError(
                f"the camera's {name} is {is_now!r} and cannot be changed from here{refusal}: "
                f"{requirement.why}; {requirement.by_hand}"
            )

    def fix_iso(self, iso: int | None) -> str | None:
        """Fix the sensitivity; returns it, or None if the camera does not tell.

        Parameters
        ----------
        iso : int, optional
            By default 100, or the lowest above it.
        """
        name = self.name_of(_ISO)
        if name is None:
            _refuse_without("iso", iso)
            return None
        numbers = {number: c for c in self.choices(name) if (number := _number_in(c)) is not None}
        if iso is None:
            iso = int(min((n for n in numbers if n >= _LEAST_ISO), default=_LEAST_ISO))
        return self._fix(name, float(iso), numbers)

    def fix_aperture(self, aperture: float | None) -> str | None:
        """Fix the aperture; returns it, or None if the camera does not tell.

        Parameters
        ----------
        aperture : float, optional
            f-number; by default the one that the camera has.
        """
        name = self.name_of(_APERTURE)
        if name is None:
            _refuse_without("aperture", aperture)
            return None
        if aperture is None:
            return self.read(name)
        numbers = {number: c for c in self.choices(name) if (number := _number_in(c)) is not None}
        return self._fix(name, aperture, numbers)

    def fix_format(self) -> None:
        """Have the camera deliver raw files and nothing else.

        Raises
        ------
        DeviceError
            It has no such format, or does not take it.
        """
        name = self.name_of(_FORMAT)
        if name is None:
            return  # what it delivers will be seen
        offered = self.choices(name)
        is_now = self.read(name)
        if is_raw_only(is_now):
            return
        raw = [choice for choice in offered if is_raw_only(choice)]
        if not raw:
            raise DeviceError(
                f"the camera's {name} is {is_now!r} and offers no full raw file without JPEG "
                f"({', '.join(offered) or 'nothing'}); set raw in its menu"
            )
        is_now = self.write(name, raw[0])
        if not is_raw_only(is_now):
            raise DeviceError(f"the camera's {name} stays {is_now!r}; set raw in its menu")

    def fix_target(self, *, card: bool) -> None:
        """Have pictures stay in the camera's memory until they are here, or written to its card."""
        name = self.name_of(_TARGET)
        if name is None:
            return
        wanted = "card" if card else "ram"
        for choice in self.choices(name):
            if wanted in choice.casefold():
                is_now = self.write(name, choice)
                if is_now != choice:
                    raise DeviceError(f"the camera's {name} stays {is_now!r}, not {choice!r}")
                return

    def check_battery(self, least_percent: int) -> None:
        """Refuse a battery that would not last.

        Raises
        ------
        DeviceError
            It is low.
        """
        name = self.name_of(_BATTERY)
        if name is None:
            return
        level = self.read(name)
        number = _number_in(level)
        low = "low" in level.casefold() or "empty" in level.casefold()
        if low or (number is not None and number < least_percent):
            raise DeviceError(
                f"the camera's battery is at {level}; charge it or use a mains adapter (the limit "
                "is least_battery_percent in rig.toml)"
            )

    def _fix(self, name: str, wanted: float, numbers: dict[float, str]) -> str:
        match = next((n for n in numbers if math.isclose(n, wanted, rel_tol=0.01)), None)
        if match is None:
            offered = ", ".join(numbers.values()) or "nothing"
            raise DeviceError(f"the camera's {name} cannot be {wanted:g}; it offers {offered}")
        is_now = self.read(name)
        if is_now != numbers[match]:
            is_now = self.write(name, numbers[match])
        if is_now != numbers[match]:
            raise DeviceError(
                f"the camera's {name} stays {is_now!r} where {numbers[match]!r} was set; look at "
                "its dials and its lens"
            )
        return is_now


def is_raw_only(choice: str) -> bool:
    """Whether an image format is the sensor's full raw file, without a JPEG beside it.

    Reduced raw files (``mRAW``, ``sRAW``) are interpolated, and ``cRAW`` is compressed with losses.
    """
    words = choice.casefold()
    if any(word in words for word in ("jpeg", "jpg", "fine", "norm", "basic", "heif", "+")):
        return False
    if re.search(r"\b[smc]-?raw", words) or "small" in words or "medium" in words:
        return False
    return any(word in words for word in ("raw", "nef", "dng", "orf"))


def _refuse_without(key: str, wanted: float | None) -> None:
    if wanted is not None:
        raise DeviceError(f"the camera has no {key} to set from here; remove the key {key}")


def _number_in(text: str) -> float | None:
    match = _NUMBER.search(text)
    return float(match[0]) if match else None


def _names_below(widget: Any) -> Iterable[str]:
    for number in range(widget.count_children()):
        child = widget.get_child(number)
        yield child.get_name()
        yield from _names_below(child)
