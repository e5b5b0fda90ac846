"""Frames as decoding takes them: one at a time, flat, checked against the plan and one another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from acquisition.errors import DecodingError
from acquisition.frame_files import Samples
from acquisition.plan import Plan

ReadFrame = Callable[[str], Samples]


@dataclass
class FrameStream:
    """Reads the frames of a plan.

    Attributes
    ----------
    plan : Plan
    read_frame : callable
        Takes a frame id to its (rows, cols) array of sensor numbers.
    """

    plan: Plan
    read_frame: ReadFrame
    _type: np.dtype[Any] | None = field(default=None, init=False)
    _ahead: dict[str, Samples] = field(default_factory=dict, init=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        return self.plan.crop.height, self.plan.crop.width

    def take(self, frame_id: str) -> Samples:
        """Samples of a frame, flat.

        Returns
        -------
        (rows * cols,) uint8 or uint16 array

        Raises
        ------
        DecodingError
            The frame is no picture of sensor numbers of the plan's size, or of another type than
            the frames before it.
        """
        if frame_id in self._ahead:
            return self._ahead.pop(frame_id)
        frame = np.asarray(self.read_frame(frame_id))
        if frame.shape != self.shape:
            raise DecodingError(f"frame {frame_id} is {frame.shape}, the plan says {self.shape}")
        if frame.dtype not in (np.uint8, np.uint16):
            raise DecodingError(
                f"frame {frame_id} holds {frame.dtype}; sensor numbers are uint8 or uint16"
            )
        if self._type is None:
            self._type = frame.dtype
        if frame.dtype != self._type:
            raise DecodingError(
                f"frame {frame_id} holds {frame.dtype}, those before it {self._type}: frames of "
                "different depths cannot be compared; record or convert them alike"
            )
        # One kind of array, so that the kernels are compiled for no more than two.
        if not frame.flags.c_contiguous or not frame.flags.writeable:
            frame = np.array(frame, order="C")
        return frame.reshape(-1)  # type: ignore[return-value]

    def sample_type(self, frame_id: str) -> np.dtype[Any]:
        """Type of the samples of all frames, from the one that will be taken next."""
        return self._type if self._type is not None else self.look_ahead(frame_id).dtype

    def look_ahead(self, frame_id: str) -> Samples:
        """As :meth:`take`, and the frame will be taken once more."""
        frame = self.take(frame_id)
        self._ahead[frame_id] = frame
        return frame
