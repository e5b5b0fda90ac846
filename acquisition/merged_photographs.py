"""Photographs of a session as radiance: brackets merged, freed of other light, the lamp followed.

Each bracket is merged by :mod:`acquisition.hdr` with the noise that the repeated reference pose
tells, and what the frames without lamp hold, the room's light and the sensor's dark current, is
subtracted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import SessionError
from acquisition.hdr import RadianceImage, merge_bracket
from acquisition.lamp_drift import measure_lamp_drift
from acquisition.plan import PlannedFrame, Purpose
from acquisition.sample_noise import SampleNoise, fit_sample_noise
from acquisition.session import Session

_NOISE_SAMPLES = 200_000


@dataclass(frozen=True)
class PhotographMerger:
    """What all photographs from one place of the camera have in common.

    Attributes
    ----------
    session : Session
    black_level : float
        Sensor number without light.
    noise : SampleNoise
    dark : RadianceImage or None
        What there is without the lamp.
    """

    session: Session
    black_level: float
    noise: SampleNoise
    dark: RadianceImage | None

    @classmethod
    def of(cls, session: Session, place: str | None) -> PhotographMerger:
        """By the frames without light and of the reference pose.

        Raises
        ------
        SessionError
            The reference pose was not repeated, or a frame was altered.
        """
        frames = [f for f in session.frames if f.camera_position == place]
        dark = [f for f in frames if f.purpose is Purpose.DARK]
        shortest = min(dark, key=lambda f: session.exposure_s(f.id) or 0.0, default=None)
        black = 0.0 if shortest is None else float(np.median(session.read_frame(shortest.id)))
        own = cls(session, black, _noise(session, frames, black), None)
        return cls(session, black, own.noise, own._merge(dark) if dark else None)

    def merge(self, frames: list[PlannedFrame]) -> RadianceImage:
        """Radiance of a bracket without what there is in the dark.

        Raises
        ------
        SessionError
            A frame was altered, or has no exposure time.
        """
        image = self._merge(frames)
        if self.dark is None:
            return image
        return RadianceImage(
            image.radiance - self.dark.radiance, image.variance + self.dark.variance, image.samples
        )

    def _merge(self, frames: list[PlannedFrame]) -> RadianceImage:
        exposures = [self.session.exposure_s(frame.id) for frame in frames]
        known = [exposure for exposure in exposures if exposure is not None]
        if len(known) < len(exposures):
            raise SessionError(f"{self.session.path}: photographs without an exposure time")
        return merge_bracket(
            [self.session.read_frame(frame.id) for frame in frames],
            known,
            noise=self.noise,
            black_level=self.black_level,
            saturation_level=self.session.plan.saturation_level,
        )


def photograph_brackets(
    session: Session, *, purpose: Purpose = Purpose.PHOTOGRAPH
) -> list[list[PlannedFrame]]:
    """The frames of each photograph under the lamp, in the order of the plan."""
    found: dict[tuple[object, ...], list[PlannedFrame]] = {}
    for frame in session.frames:
        if frame.purpose is purpose and frame.lamp_on:
            found.setdefault((frame.bracket, frame.light), []).append(frame)
    return list(found.values())


def lamp_drift_by_place(session: Session) -> dict[str | None, Callable[[float], float]]:
    """The lamp's brightness over that at its first reference, by place and wall time."""
    moments: dict[str | None, list[tuple[float, float]]] = {}
    for frame in session.frames:
        if frame.purpose is Purpose.REFERENCE_POSE and frame.camera_position not in moments:
            moments[frame.camera_position] = [(session.recorded[frame.id].wall_time, 1.0)]
    for sample in measure_lamp_drift(session):
        moments.setdefault(sample.camera_position, []).append((sample.wall_time, sample.ratio))

    def follow(known: list[tuple[float, float]]) -> Callable[[float], float]:
        times, ratios = np.array(sorted(known)).T
        return lambda time: float(np.interp(time, times, ratios))

    return {place: follow(known) for place, known in moments.items()}


def _noise(session: Session, frames: list[PlannedFrame], black: float) -> SampleNoise:
    """Photon transfer by the reference pose, which is taken again and again."""
    first: dict[float | None, NDArray[np.float32]] = {}
    levels, squares = [], []
    for frame in frames:
        if frame.purpose is not Purpose.REFERENCE_POSE:
            continue
        image = session.read_frame(frame.id)
        usable = image < session.plan.saturation_level
        signal = np.where(usable, image.astype(np.float32) - np.float32(black), np.nan)
        if frame.exposure_s not in first:
            first[frame.exposure_s] = signal
            continue
        other = first[frame.exposure_s]
        both = np.isfinite(signal) & np.isfinite(other)
        if not both.any():
            continue
        # The lamp may have drifted: what is compared are the pictures, not their brightness.
        ratio = float(np.sum(signal[both]) / max(float(np.sum(other[both])), 1e-9))
        level = 0.5 * (signal[both] + other[both])
        levels.append(level)
        squares.append((signal[both] - ratio * other[both]) ** 2 / (1.0 + ratio**2))
    if not levels:
        raise SessionError(
            f"{session.path}: the noise of the photographs cannot be told, since the reference "
            "pose was taken once at most; photograph it twice"
        )
    level, square = np.concatenate(levels), np.concatenate(squares)
    step = max(1, level.size // _NOISE_SAMPLES)
    return fit_sample_noise(
        level[::step], square[::step], degrees_of_freedom=1, origin="repeated reference pose"
    )
