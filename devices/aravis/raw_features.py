"""Everything between the sensor and the samples switched off, and read back.

Names of features: GenICam Standard Features Naming Convention (SFNC 2.7); some makers' own names
for functions that the convention lacks are here too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from devices.aravis.library import named_errors
from devices.errors import DeviceError


@dataclass(frozen=True)
class RawFeature:
    """A feature and the value at which it leaves the samples alone.

    Attributes
    ----------
    name : str
    value : str, bool, int or float
        Its type is that of the feature.
    why : str
        What it would do to the samples.
    """

    name: str
    value: str | bool | int | float
    why: str


RAW_FEATURES = (
    RawFeature("ExposureMode", "Timed", "exposures would not be of the time asked for"),
    RawFeature("ExposureAuto", "Off", "the camera would choose its exposure"),
    RawFeature("GainAuto", "Off", "the camera would choose its gain"),
    RawFeature("BalanceWhiteAuto", "Off", "the camera would scale its colours"),
    RawFeature("BalanceRatioAuto", "Off", "the camera would scale its colours"),
    RawFeature("BlackLevelAuto", "Off", "the black level would wander"),
    RawFeature("BlackLevelClampingEnable", False, "the black level would wander"),
    RawFeature("GammaEnable", False, "samples would not be proportional to light"),
    RawFeature("GammaEnabled", False, "samples would not be proportional to light"),
    RawFeature("Gamma", 1.0, "samples would not be proportional to light"),
    RawFeature("LUTEnable", False, "samples would not be proportional to light"),
    RawFeature("ColorTransformationEnable", False, "colours would be mixed"),
    RawFeature("ColorTransformationAuto", "Off", "colours would be mixed"),
    RawFeature("SharpeningEnable", False, "neighbouring samples would be mixed"),
    RawFeature("SharpeningAuto", "Off", "neighbouring samples would be mixed"),
    RawFeature("NoiseReduction", 0.0, "neighbouring samples would be mixed"),
    RawFeature("SharpnessEnhancement", 0.0, "neighbouring samples would be mixed"),
    RawFeature("IspEnable", False, "samples would be processed"),
    RawFeature("TestPattern", "Off", "the camera would send a test picture"),
    RawFeature("TestImageSelector", "Off", "the camera would send a test picture"),
    RawFeature("ReverseX", False, "the picture and its mosaic would be mirrored"),
    RawFeature("ReverseY", False, "the picture and its mosaic would be mirrored"),
    RawFeature("BinningHorizontal", 1, "samples would be merged"),
    RawFeature("BinningVertical", 1, "samples would be merged"),
    RawFeature("DecimationHorizontal", 1, "samples would be left out"),
    RawFeature("DecimationVertical", 1, "samples would be left out"),
    RawFeature("ChunkModeActive", False, "buffers would hold more than the picture"),
)


def make_raw(device: Any) -> None:
    """Switch off whatever changes samples on their way.

    Parameters
    ----------
    device : Aravis.Device

    Raises
    ------
    DeviceError
        A function stays on; it is named.
    """
    for feature in RAW_FEATURES:
        with named_errors(f"{feature.name} cannot be read"):
            if device.is_feature_implemented(feature.name):
                _switch_off(device, feature)


def _switch_off(device: Any, feature: RawFeature) -> None:
    read, write = _accessors(device, feature.value)
    # A feature that another one disables (the gamma of a disabled gamma) does nothing.
    if not device.is_feature_available(feature.name):
        return
    if read(feature.name) == feature.value:
        return
    refusal = ""
    try:
        with named_errors("refused"):
            write(feature.name, feature.value)
    except DeviceError as error:
        refusal = f" ({error})"
    is_now = read(feature.name)
    if is_now != feature.value:
        raise DeviceError(
            f"the camera's {feature.name} stays {is_now} where {feature.value} was asked "
            f"for{refusal}: {feature.why}; set it with the maker's program, or use another camera"
        )


def _accessors(device: Any, value: str | bool | int | float) -> tuple[Any, Any]:
    if isinstance(value, bool):
        return device.get_boolean_feature_value, device.set_boolean_feature_value
    if isinstance(value, str):
        return device.get_string_feature_value, device.set_string_feature_value
    if isinstance(value, int):
        return device.get_integer_feature_value, device.set_integer_feature_value
    return _number_of(device), device.set_float_feature_value


def _number_of(device: Any) -> Any:
    """Reads a feature that some makers have as an integer, others as a float."""

    def read(name: str) -> float:
        from gi.repository import Aravis

        node = device.get_feature(name)
        if isinstance(node, Aravis.GcFloat):
            return float(device.get_float_feature_value(name))
        return float(device.get_integer_feature_value(name))

    return read


def set_level(device: Any, names: tuple[str, ...], value: float | None) -> float | None:
    """Fix a level, such as the gain.

    Parameters
    ----------
    device : Aravis.Device
    names : tuple of str
        Features that it may be called; the first that there is counts.
    value : float, optional
        In the camera's unit; by default the lowest possible.

    Returns
    -------
    float or None
        What the camera took; None if it has no such feature and none was asked for.

    Raises
    ------
    DeviceError
        There is no such feature, the value is out of its range, or another one was taken.
    """
    name = next((n for n in names if device.is_feature_available(n)), None)
    if name is None:
        if value is not None:
            raise DeviceError(f"the camera has no {' or '.join(names)} to set; remove the key")
        return None
    with named_errors(f"{name} cannot be set"):
        return _set_number(device, name, value)


def _set_number(device: Any, name: str, value: float | None) -> float:
    from gi.repository import Aravis

    if isinstance(device.get_feature(name), Aravis.GcFloat):
        read, write = device.get_float_feature_value, device.set_float_feature_value
        low, high = device.get_float_feature_bounds(name)
        step = 0.02 * (high - low)
    else:
        read, write = device.get_integer_feature_value, device.set_integer_feature_value
        low, high = device.get_integer_feature_bounds(name)
        step = max(1, device.get_integer_feature_increment(name))
    wanted = low if value is None else value
    if not low <= wanted <= high:
        raise DeviceError(f"{name} = {wanted:g} is outside the camera's {low:g} to {high:g}")
    write(name, type(low)(wanted))
    is_now = float(read(name))
    if abs(is_now - wanted) > step:
        raise DeviceError(f"the camera's {name} was set to {wanted:g} and is {is_now:g}")
    return is_now
