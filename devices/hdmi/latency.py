"""From the flip of a screen to the camera: how late a projector's light changes, with its error.

A picture that changes at time *t* within an exposure of length *T* that ends at time *e* is seen
for the share *f = (e − t)/T* of it, and the frame's mean level lies that share of the way from the
old level to the new one. So one frame during which black turns to white, or white to black, tells
the time of the change to *T* times the noise of a mean level, far below the length of the exposure.
Rising and falling steps are averaged with equal weight: errors of the two reference levels cancel.

The delay counts from the time that the projector's ``show`` returned to the exposure times that the
camera reports, so what the camera's clock is late is part of it, as it is when frames are held
against their subjects. A rolling shutter adds half of its read-out.
"""

from __future__ import annotations

import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from devices.errors import DeviceError
from devices.interfaces import Camera, Frame, Projection, Projector

_REFERENCE_FRAMES = 4
# Shares of the exposure beyond which a change cannot be told from none.
_LEAST_SHARE = 0.05
_DITHER = 0.2
# Steps that may miss their exposure before a measurement is given up, per step that is wanted.
_TRIES_PER_STEP = 3
# Pixels that take part change by at least this share of the largest change.
_LIT = 0.5


@dataclass(frozen=True)
class Latency:
    """How late the light changes.

    Attributes
    ----------
    delay_s : float
        Mean time from what ``show`` returned until the light has changed.
    standard_error_s : float
        Of the mean.
    spread_s : float
        Standard deviation of a single step: jitter of the projector and noise of the camera.
    steps : int
        Changes of the picture that were seen.
    """

    delay_s: float
    standard_error_s: float
    spread_s: float
    steps: int

    @property
    def safe_s(self) -> float:
        """What to add to ``latency_s`` in ``rig.toml``: late enough for all but rare steps."""
        return self.delay_s + 3 * math.hypot(self.spread_s, self.standard_error_s)

    def __str__(self) -> str:
        return (
            f"{self.delay_s * 1000:.2f} ± {self.standard_error_s * 1000:.2f} ms "
            f"(single steps ± {self.spread_s * 1000:.2f} ms, {self.steps} steps)"
        )


def measure_latency(
    camera: Camera, projector: Projector, *, exposure_s: float, steps: int = 20, seed: int = 0
) -> Latency:
    """Time from a projector's flip until a camera sees the light change.

    Parameters
    ----------
    camera : Camera
        Sees some of the projector's light, unsaturated at ``exposure_s``; linear.
    projector : Projector
        Its latency set to zero, for the whole latency; otherwise what remains is measured.
    exposure_s : float
        Longer than the delay can be, and a multiple of the projector's frame period.
    steps : int
        Changes to see, half of them to white and half to black; at least 4.
    seed : int
        Of the moments at which the picture changes.

    Raises
    ------
    DeviceError
        The camera does not see the projector, is saturated, or the changes do not fall into the
        exposures.
    """
    if steps < 4:
        raise DeviceError(f"{steps} steps tell no spread; take 4 or more")
    camera.capabilities.check_exposure(exposure_s)
    try:
        return _Measurement(camera, projector, exposure_s, seed).measure(steps)
    finally:
        projector.blank()


class _Measurement:
    """One measurement: reference levels, then steps whose moment follows what was seen."""

    def __init__(self, camera: Camera, projector: Projector, exposure_s: float, seed: int) -> None:
        self._camera = camera
        self._projector = projector
        self._exposure_s = exposure_s
        self._random = np.random.default_rng(seed)
        capabilities = projector.capabilities
        shape = (capabilities.height, capabilities.width)
        self._pictures = {
            white: Projection("white" if white else "black", np.full(shape, 255 * white, np.uint8))
            for white in (False, True)
        }
        # From asking the camera for a frame until the picture is changed.
        self._wait_s = exposure_s / 4

    def measure(self, steps: int) -> Latency:
        self._find_levels()
        delays: dict[bool, list[float]] = {False: [], True: []}
        wanted = (steps + 1) // 2
        self._projector.show(self._pictures[False])
        self._settle()
        for attempt in range(2 * wanted * _TRIES_PER_STEP):
            white = attempt % 2 == 0
            delay = self._step(white)
            if delay is not None:
                delays[white].append(delay)
            if min(len(found) for found in delays.values()) >= wanted:
                return _summarise(delays)
        raise DeviceError(
            f"of {2 * wanted * _TRIES_PER_STEP} changes of the picture only "
            f"{sum(map(len, delays.values()))} fell into their exposure of {self._exposure_s:g} s; "
            "take a longer one, or look whether the camera's times are those of its exposures"
        )

    def _find_levels(self) -> None:
        """Pixels that the projector lights, and their level when it is black and white."""
        frames = {}
        for white, picture in self._pictures.items():
            self._projector.show(picture)
            self._settle()
            frames[white] = [
                self._camera.capture(self._exposure_s) for _ in range(_REFERENCE_FRAMES)
            ]
        black, bright = (
            np.mean([frame.image for frame in frames[white]], axis=0) for white in (False, True)
        )
        change = bright - black
        lit = change > _LIT * np.percentile(change, 99)
        levels = {
            white: [float(frame.image[lit].mean()) if lit.any() else 0.0 for frame in of]
            for white, of in frames.items()
        }
        self._black, self._bright = (float(np.mean(levels[white])) for white in (False, True))
        noise = math.hypot(*(float(np.std(of, ddof=1)) for of in levels.values()))
        contrast = self._bright - self._black
        if not lit.any() or contrast <= 10 * noise or contrast < 1:
            raise DeviceError(
                f"the camera does not see the projector: its mean level is {self._black:.1f} when "
                f"black and {self._bright:.1f} when white, ± {noise:.1f}; aim it at the projection "
                "and shade other light"
            )
        saturation = self._camera.capabilities.saturation_level
        if (bright[lit] >= 0.98 * saturation).mean() > 0.01:
            raise DeviceError(
                f"the camera is saturated at {saturation} by the white picture in "
                f"{self._exposure_s:g} s; close its aperture, the exposure must stay"
            )
        self._lit: NDArray[np.bool_] = lit

    def _step(self, white: bool) -> float | None:
        """Change the picture during an exposure; the delay, or None if it was not during it."""
        dither = self._random.uniform(-_DITHER, _DITHER) * self._exposure_s
        with ThreadPoolExecutor(1) as other:
            capture = other.submit(self._camera.capture, self._exposure_s)
            time.sleep(max(0.0, self._wait_s + dither))
            shown_s = self._projector.show(self._pictures[white])
            frame = capture.result()
        share = self._share_seen(frame, white)
        # Towards the middle of the exposure; beyond its ends the share tells the direction only.
        self._wait_s = max(0.0, self._wait_s + dither + (share - 0.5) * self._exposure_s)
        if not _LEAST_SHARE < share < 1 - _LEAST_SHARE:
            self._settle()
            return None
        return frame.monotonic_s - share * frame.exposure_applied_s - shown_s

    def _share_seen(self, frame: Frame, white: bool) -> float:
        """Share of an exposure during which the new picture was there."""
        level = float(frame.image[self._lit].mean())
        share = (level - self._black) / (self._bright - self._black)
        return min(1.0, max(0.0, share if white else 1 - share))

    def _settle(self) -> None:
        time.sleep(self._exposure_s)


def _summarise(delays: dict[bool, list[float]]) -> Latency:
    groups = [np.asarray(of) for of in delays.values()]
    error = math.sqrt(sum(float(of.var(ddof=1)) / len(of) for of in groups)) / 2
    spread = math.sqrt(sum(float(of.var(ddof=1)) for of in groups) / 2)
    return Latency(
        delay_s=float(np.mean([of.mean() for of in groups])),
        standard_error_s=error,
        spread_s=spread,
        steps=sum(map(len, groups)),
    )
