"""Buffers of a GenICam camera: handed to its stream, emptied, and checked when they come back."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from devices.aravis.library import named_errors
from devices.aravis.pixel_formats import PixelFormat
from devices.errors import DeviceError

_BUFFERS = 4
_LONGEST_WAIT_S = 0.05
# Frame numbers of GigE Vision 1 have 16 bits, and leave out zero.
_SHORT_NUMBERS = 65535


class IncompleteFrameError(DeviceError):
    """Parts of a frame were lost on the way."""


@dataclass(frozen=True)
class Arrived:
    """A frame as it came in.

    Attributes
    ----------
    image : (rows, cols) array
    number : int
        The camera's own.
    stamp_s : float
        Of the camera's clock; zero if it gives none.
    arrived_s : float
        Monotonic time at which it was complete.
    """

    image: NDArray
    number: int
    stamp_s: float
    arrived_s: float


class FrameStream:
    """The stream of a camera whose region and format are set.

    Parameters
    ----------
    aravis : module
    camera : Aravis.Camera
    pixel_format : PixelFormat
    size : (int, int)
        Width and height.

    Raises
    ------
    DeviceError
        The stream cannot be opened.
    """

    def __init__(
        self, aravis: Any, camera: Any, pixel_format: PixelFormat, size: tuple[int, int]
    ) -> None:
        self._status = aravis.BufferStatus
        self._image_payload = aravis.BufferPayloadType.IMAGE
        self._format = pixel_format
        self._size = size
        with named_errors("the camera's stream cannot be opened"):
            self._stream = camera.create_stream(None, None)
            payload = camera.get_payload()
        if self._stream is None:
            raise DeviceError("the camera's stream cannot be opened; restart the camera")
        for _ in range(_BUFFERS):
            self._stream.push_buffer(aravis.Buffer.new_allocate(payload))

    def empty(self) -> int:
        """Drop what has arrived; returns how many frames that were."""
        dropped = 0
        while (buffer := self._stream.try_pop_buffer()) is not None:
            self._stream.push_buffer(buffer)
            dropped += 1
        return dropped

    def wait(self, seconds: float) -> Arrived | None:
        """Wait a little for a frame.

        Parameters
        ----------
        seconds : float
            Never waits for more than a twentieth of a second, so that interrupts get through.

        Returns
        -------
        Arrived or None
            None if there was none.

        Raises
        ------
        IncompleteFrameError
            A frame came with gaps.
        DeviceError
            A frame came in another format or size.
        """
        microseconds = int(1e6 * max(0.0, min(seconds, _LONGEST_WAIT_S)))
        buffer = self._stream.timeout_pop_buffer(microseconds)
        if buffer is None:
            return None
        arrived_s = time.monotonic()
        try:
            return Arrived(
                image=self._checked(buffer),
                number=buffer.get_frame_id(),
                stamp_s=buffer.get_timestamp() / 1e9,
                arrived_s=arrived_s,
            )
        finally:
            self._stream.push_buffer(buffer)

    def _checked(self, buffer: Any) -> NDArray:
        status = buffer.get_status()
        if status != self._status.SUCCESS:
            missing = self._stream.get_statistics().n_missing_packets
            raise IncompleteFrameError(
                f"frame {buffer.get_frame_id()} arrived with gaps ({_words(status)}, {missing} "
                "packets lost so far); use a network card of the camera's speed with jumbo frames, "
                "raise net.core.rmem_max, or raise attempts in rig.toml"
            )
        if buffer.get_payload_type() != self._image_payload:
            raise DeviceError(
                f"the camera sent a buffer of kind {_words(buffer.get_payload_type())}, which is "
                "no picture; switch off chunks, compression and multiple parts in it"
            )
        width, height = self._size
        is_now = buffer.get_image_width(), buffer.get_image_height()
        code = buffer.get_image_pixel_format()
        if is_now != self._size or code != self._format.code:
            raise DeviceError(
                f"the camera sent {is_now[0]}×{is_now[1]} pixels of format {code:#010x} where it "
                f"was set to {width}×{height} of {self._format.name} ({self._format.code:#010x})"
            )
        padding, _ = buffer.get_image_padding()
        return self._format.decode(
            buffer.get_data(), width=width, height=height, row_padding=padding
        )


def frames_between(last: int, number: int) -> int:
    """How far the camera's count went from one frame to another, across its wrap.

    Parameters
    ----------
    last, number : int
        Frame numbers, of 16 bits without zero or of 64 bits.

    Returns
    -------
    int
        1 for the next frame; 0 for the same; negative if the count went back.
    """
    step = number - last
    if step < -_SHORT_NUMBERS // 2 and last <= _SHORT_NUMBERS:
        step += _SHORT_NUMBERS if number > 0 else _SHORT_NUMBERS + 1
    return step


def _words(value: Any) -> str:
    """An enumeration's value for people: ``missing packets``."""
    return str(value.value_nick).replace("-", " ")
