"""A video device in memory behind the interface of ``cv2.VideoCapture``.

It exposes one frame after another in real time and keeps the oldest in its queue, as V4L2 does:
once that is full, new frames are dropped until one is taken. Every frame carries its number, by
which a test finds out when it was really exposed.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import cv2
import numpy as np

ABSENT = -1.0
WIDTH, HEIGHT = 40, 30


@dataclass
class Exposed:
    """What really happened."""

    began_s: float
    ended_s: float
    ready_s: float
    units: float


@dataclass
class Device:
    """The device and its capture in one; called to open it."""

    code: str = "Y16 "
    period_s: float = 0.01
    readout_s: float = 0.008
    depth: int = 4
    backend: str = "V4L2"
    # "kernel": as V4L2 stamps frames; "none": zero; "other": of a clock with another zero.
    stamps: str = "kernel"
    # Frames until a new exposure is in force.
    latency: int = 2
    units: float = 50.0
    steps: tuple[float, ...] = ()
    accepts_exposure: bool = True
    keeps_exposure: bool = False
    opens: bool = True
    failing_grabs: int = 0
    hangs_s: float = 0.0
    level: int | None = None
    row_of_bytes: bool = False
    colours: bool = False
    properties: dict[int, float] = field(default_factory=dict)
    stuck: tuple[int, ...] = ()
    frames: list[Exposed] = field(default_factory=list)
    released: bool = False

    def __call__(self, source: object, backend: int) -> Device:
        self.opened_with = source, backend
        self.queue: list[int] = []
        self.pending: list[tuple[int, float]] = []
        self.in_force = self.units
        self.began_s = time.monotonic()
        self.grabbed: int | None = None
        self.convert = True
        return self

    def isOpened(self) -> bool:  # noqa: N802
        return self.opens

    def getBackendName(self) -> str:  # noqa: N802
        return self.backend

    def release(self) -> None:
        self.released = True

    def set(self, number: int, value: float) -> bool:
        if number == cv2.CAP_PROP_EXPOSURE:
            if not self.accepts_exposure:
                return False
            if not self.keeps_exposure:
                steps = self.steps or (value,)
                self.units = min(steps, key=lambda step: abs(step - value))
                self._advance()
                self.pending.append((len(self.frames) + self.latency, self.units))
            return True
        if number == cv2.CAP_PROP_CONVERT_RGB:
            self.convert = bool(value)
            return True
        if number in (cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT):
            return False
        if number not in self.properties:
            return False
        if number not in self.stuck:
            self.properties[number] = value
        return True

    def get(self, number: int) -> float:
        if number == cv2.CAP_PROP_EXPOSURE:
            return self.units
        if number == cv2.CAP_PROP_FOURCC:
            return float(cv2.VideoWriter.fourcc(*self.code))
        if number == cv2.CAP_PROP_FRAME_WIDTH:
            return float(WIDTH)
        if number == cv2.CAP_PROP_FRAME_HEIGHT:
            return float(HEIGHT)
        if number == cv2.CAP_PROP_POS_MSEC:
            if self.stamps == "none" or self.grabbed is None:
                return 0.0
            zero = 86400.0 if self.stamps == "other" else 0.0
            return 1000 * (self.frames[self.grabbed].ended_s - zero)
        return self.properties.get(number, ABSENT)

    def grab(self) -> bool:
        if self.hangs_s:
            time.sleep(self.hangs_s)
        if self.failing_grabs > 0:
            self.failing_grabs -= 1
            return False
        self._advance()
        while not self.queue:
            time.sleep(0.001)
            self._advance()
        self.grabbed = self.queue.pop(0)
        return True

    def retrieve(self) -> tuple[bool, np.ndarray]:
        sixteen = self.code[:3] in ("Y16", "RG1")
        picture = np.full((HEIGHT, WIDTH), self.grabbed, np.uint16 if sixteen else np.uint8)
        if self.level is not None:
            picture[:] = self.level
        if self.convert or self.colours:
            return True, np.repeat(picture[..., np.newaxis], 3, axis=2)
        if self.row_of_bytes:
            return True, picture.view(np.uint8).reshape(1, -1)
        return True, picture

    def of(self, image: np.ndarray) -> Exposed:
        """What really happened to a frame."""
        return self.frames[int(image[0, 0])]

    def _advance(self) -> None:
        """Bring the frames up to now."""
        now = time.monotonic()
        while True:
            number = len(self.frames)
            began = self.frames[-1].ended_s if self.frames else self.began_s
            units = self.in_force
            for since, value in self.pending:
                if number >= since:
                    units = value
            ended = began + max(self.period_s, units * 1e-4)
            # The exposure is the last part of the period.
            frame = Exposed(ended - units * 1e-4, ended, ended + self.readout_s, units)
            if frame.ready_s > now:
                return
            self.frames.append(frame)
            if len(self.queue) < self.depth:
                self.queue.append(number)
