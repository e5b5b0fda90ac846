"""The projector of a simulated scene."""

from __future__ import annotations

import time

from devices.deadline import Deadline
from devices.errors import DeviceError
from devices.interfaces import Projection, ProjectorCapabilities
from devices.simulated.scene import SimulatedScene


class SimulatedProjector:
    """A projector that lights a simulated scene, without latency."""

    def __init__(self, scene: SimulatedScene) -> None:
        self._scene = scene
        self._closed = False

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """Size of the simulated panel."""
        lens = self._scene.projector
        return ProjectorCapabilities("simulated projector", lens.width, lens.height, 1 / 60)

    def show(self, projection: Projection, *, deadline: Deadline | None = None) -> float:
        """Show a picture of the panel's size.

        Raises
        ------
        DeviceError
            The projector is closed, the picture does not fit, or the deadline has passed.
        """
        if self._closed:
            raise DeviceError("the simulated projector is closed")
        self.capabilities.check_projection(projection)
        if deadline is not None:
            deadline.require("the simulated projector did not show its picture")
        self._scene.show(projection.image)
        return time.monotonic()

    def blank(self) -> None:
        """Put the light out: what is left is that of a black picture."""
        self._scene.blank()

    def close(self) -> None:
        """Blank the panel."""
        self.blank()
        self._closed = True
