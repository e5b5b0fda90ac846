"""The camera of a simulated scene."""

from __future__ import annotations

import time

from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceTimeoutError
from devices.interfaces import CameraCapabilities, Frame
from devices.simulated.scene import SimulatedScene


class SimulatedCamera:
    """A camera that takes frames of a simulated scene.

    Nobody waits for a simulated exposure: a frame says when it would have ended.
    """

    def __init__(self, scene: SimulatedScene) -> None:
        self._scene = scene
        self._sequence = 0
        self._closed = False
        self._ended = 0.0

    @property
    def capabilities(self) -> CameraCapabilities:
        """Size and range of the simulated sensor."""
        lens = self._scene.cameras[self._scene.position]
        return CameraCapabilities(
            model="simulated camera",
            width=lens.width,
            height=lens.height,
            saturation_level=self._scene.sensor.saturation_level,
            exposure_range_s=(1e-6, 60.0),
            bayer=self._scene.sensor.bayer,
        )

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        """Take one frame of the scene as it is now.

        Raises
        ------
        DeviceError
            The camera is closed, the exposure is out of range, or the deadline has passed.
        """
        if self._closed:
            raise DeviceError("the simulated camera is closed")
        self.capabilities.check_exposure(exposure_s)
        began = max(time.monotonic(), self._ended)
        self._sequence += 1
        image = self._scene.expose(exposure_s)
        now = time.monotonic()
        if deadline is not None and deadline.passed:
            raise DeviceTimeoutError("the simulated camera did not deliver in time")
        self._ended = began + exposure_s
        wall_time = time.time() + self._ended - now
        return Frame(image, self._sequence, exposure_s, exposure_s, self._ended, wall_time)

    def close(self) -> None:
        """Release the camera."""
        self._closed = True


class SimulatedMount:
    """The places that a simulated camera can stand at; it is there at once."""

    def __init__(self, scene: SimulatedScene) -> None:
        self._scene = scene

    @property
    def positions(self) -> tuple[str, ...]:
        """Names of the places."""
        return tuple(self._scene.cameras)

    @property
    def position(self) -> str:
        """Where the camera stands."""
        return self._scene.position

    def place(self, position: str) -> None:
        """Have the camera stand at one of :attr:`positions`.

        Raises
        ------
        DeviceError
            There is no such place.
        """
        self._scene.place_camera(position)
