"""The table of a tethered camera in ``rig.toml``, and the search for such cameras."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from devices.discovery import Found
from devices.interfaces import Camera
from devices.settings import DriverSettings

_SEARCH_S = 15.0


class Gphoto2Settings(DriverSettings):
    """Settings of a tethered camera.

    Attributes
    ----------
    camera : str or None
        Port (``usb:001,007``) or model as ``impasto devices`` lists them; may be left out where
        there is just one.
    iso : int or None
        Sensitivity, fixed; by default 100, or the lowest above it.
    aperture : float or None
        f-number, fixed; by default the one that is set.
    saturation_level : int or None
        Sensor number of a saturated sample, where it is below the one that LibRaw knows.
    keep_files : bool
        Whether the raw files are kept on the camera's card.
    least_battery_percent : int
        A lower battery is refused when the camera is opened.
    timeout_s : float
        How long opening may take, and a frame beyond its exposure.
    """

    driver: Literal["gphoto2"] = "gphoto2"
    camera: str | None = None
    iso: Annotated[int, Field(gt=0)] | None = None
    aperture: Annotated[float, Field(gt=0)] | None = None
    saturation_level: Annotated[int, Field(gt=0, le=65535)] | None = None
    keep_files: bool = False
    least_battery_percent: Annotated[int, Field(ge=0, le=100)] = 10
    timeout_s: Annotated[float, Field(gt=0, le=600)] = 30.0

    def open(self, *, library: Any = None) -> Camera:
        """Open the camera, with everything automatic switched off, and take one picture.

        Parameters
        ----------
        library : module, optional
            In place of :mod:`gphoto2`.

        Raises
        ------
        DeviceError
            There is no such camera, another program has it, or it cannot be made to deliver raw
            files; or a package is missing.
        """
        from devices.gphoto2.camera import TetheredCamera

        return TetheredCamera(self, library=library)


def find(*, library: Any = None) -> list[Found]:
    """Cameras on this computer's USB that libgphoto2 knows, and those that it may not open.

    Raises
    ------
    MissingPackageError
        The ``gphoto2`` package is not installed.
    """
    from devices.blocking_calls import BlockingCalls
    from devices.deadline import Deadline
    from devices.errors import DeviceError, MissingPackageError
    from devices.gphoto2.cameras import find_cameras
    from devices.gphoto2.library import load_gphoto2

    calls = BlockingCalls("the search for cameras")
    try:
        gphoto2 = library or load_gphoto2()
        return calls.call(
            lambda: find_cameras(gphoto2),
            deadline=Deadline.after(_SEARCH_S),
            late="the search for tethered cameras did not end",
        )
    except MissingPackageError:
        raise
    except DeviceError as error:
        return [Found("gphoto2", "usb", "", str(error))]
    finally:
        calls.end(lambda: None, within_s=0)
