"""A projector on a screen of this computer: pictures pixel by pixel, at times that are known."""

from __future__ import annotations

import atexit
import mmap
import os
import time

import numpy as np

from devices.deadline import Deadline
from devices.errors import DeviceError
from devices.hdmi.screens import Screen
from devices.hdmi.settings import HdmiSettings
from devices.hdmi.window_link import WindowLink
from devices.interfaces import Projection, ProjectorCapabilities

_END_S = 2.0


class HdmiProjector:
    """A :class:`~devices.interfaces.Projector` that fills a screen.

    Parameters
    ----------
    settings : HdmiSettings

    Raises
    ------
    DeviceError
        There is no such screen, pictures on it would be scaled or torn, or the window does not
        open.
    """

    def __init__(self, settings: HdmiSettings) -> None:
        self._settings = settings
        self._number = 0
        size = settings.width * settings.height
        memory = os.memfd_create("impasto-picture")
        try:
            os.ftruncate(memory, size)
            self._picture = mmap.mmap(memory, size)
            self._link = WindowLink(
                {
                    "screen": settings.screen,
                    "width": settings.width,
                    "height": settings.height,
                    "memory": memory,
                    "stall_s": settings.stall_s,
                },
                display=settings.display,
                memory=memory,
                alive_every_s=settings.stall_s / 5,
            )
        finally:
            os.close(memory)
        self._closed = False
        atexit.register(self.close)
        try:
            self._await_window(Deadline.after(settings.timeout_s))
        except BaseException:
            self.close()
            raise

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What the projector is."""
        settings = self._settings
        return ProjectorCapabilities(
            settings.model, settings.width, settings.height, self._frame_period_s
        )

    @property
    def screen(self) -> Screen:
        """The screen that it fills."""
        return self._screen

    @property
    def vsync(self) -> bool:
        """Whether flips wait for the screen's refresh."""
        return self._vsync

    def show(self, projection: Projection, *, deadline: Deadline | None = None) -> float:
        """Show a picture, and return once its light is on the scene.

        Returns
        -------
        float
            Monotonic time of the confirmed flip, and the latency.

        Raises
        ------
        DeviceError
            Not a picture for this panel; the window is gone, moved or did not flip in time, and
            the screen is black then.
        """
        deadline = deadline or Deadline.after(self._settings.timeout_s)
        if self._closed:
            raise DeviceError("the projector is closed")
        try:
            self.capabilities.check_projection(projection)
            self._picture[:] = np.ascontiguousarray(projection.image).tobytes()
            # A flip that does not wait for the refresh may reach the screen with the next one.
            wait_s = self._settings.latency_s + (0.0 if self._vsync else self._frame_period_s)
            since = self._do("show", deadline) + wait_s
            time.sleep(max(0.0, min(since, deadline.at_s) - time.monotonic()))
            if time.monotonic() < since:
                deadline.require(f"{self._settings.model} could not show the picture")
        except BaseException:
            self.blank()
            raise
        return since

    def blank(self) -> None:
        """Make the screen black; if its process does not do that, end the process.

        Harmless at any time.
        """
        if self._closed or not self._link.running:
            return
        try:
            self._do("blank", Deadline.after(_END_S))
        except DeviceError:
            self._link.kill()

    def close(self) -> None:
        """Make the screen black and close the window; harmless when closed already."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        self._link.end(within_s=_END_S)
        self._picture.close()

    def _await_window(self, deadline: Deadline) -> None:
        ready = self._link.receive(deadline)
        self._screen = Screen(**ready["ready"])
        self._frame_period_s: float = ready["frame_period_s"]
        self._vsync: bool = ready["vsync"]
        if self._settings.require_vsync and not self._vsync:
            raise DeviceError(
                f"flips on screen {self._screen.name} do not wait for its refresh, so pictures "
                "could be torn; switch on vertical synchronisation in the graphics driver, or set "
                "require_vsync = false in rig.toml"
            )

    def _do(self, command: str, deadline: Deadline) -> float:
        """Have the window do something; returns the moment of its flip.

        Answers carry the command's number: one to an earlier command, which an interrupt left
        unread, is dropped.
        """
        self._number += 1
        self._link.send(f"{command} {self._number}")
        while True:
            answer = self._link.receive(deadline)
            if answer.get("done") == self._number:
                return float(answer["monotonic_s"])
