"""Photographs of a session, merged, freed of other light, and ready to be back-projected.

Each bracket is merged into radiance per second (:mod:`acquisition.hdr`), and what the frames
without lamp hold, the room's light and the sensor's dark current, is subtracted. The merged
photographs lie in scratch files that are mapped into memory, so that any number of them takes
little of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from acquisition.hdr import RadianceImage, merge_bracket
from acquisition.lamp_drift import measure_lamp_drift
from acquisition.plan import PlannedFrame, Purpose
from acquisition.sample_noise import SampleNoise, fit_sample_noise
from acquisition.session import Session
from calibration.lamp import Lamp
from calibration.lens import invert, rotation, transform
from calibration.registration import RegisteredView
from devices.bayer import BayerPattern
from devices.interfaces import ArmPose
from fitting.errors import FittingError
from fitting.reflectance.photographs import Photograph

Singles = NDArray[np.float32]
_NOISE_SAMPLES = 200_000


class LampPoses(Protocol):
    """What knows where the lamp is at a pose of its arm, and what it sends."""

    def lamp(self, pose: ArmPose) -> Lamp:
        """The lamp in the rig's frame, that of the scan's camera."""


@dataclass(frozen=True, kw_only=True)
class PhotographOptions:
    """How recorded photographs are read.

    Attributes
    ----------
    mosaic : BayerPattern or None
        Order of the sensor's colours from the first pixel of the full frame; None if monochrome.
    flat_field : (rows, cols) float32 array or None
        What the camera makes of even light, of the frames' size.
    follow_drift : bool
        Whether the lamp's drift, by its reference pose, is divided out.
    """

    mosaic: BayerPattern | None = None
    flat_field: Singles | None = None
    follow_drift: bool = True


def read_photographs(
    session: Session,
    views: Mapping[str | None, RegisteredView],
    lamps: LampPoses,
    rt_rig_canvas: NDArray[np.float64],
    *,
    scratch: Path,
    options: PhotographOptions | None = None,
    advance: Callable[[str], None] = lambda name: None,
) -> list[Photograph]:
    """Photographs of a session under each pose of the lamp, from each registered place.

    Parameters
    ----------
    session : Session
    views : mapping of place to RegisteredView
    lamps : LampPoses
    rt_rig_canvas : (6,) array
        Pose of the canvas in the rig's frame: a height field's ``rt_cam_canvas``.
    scratch : Path
        Folder for the merged photographs; they must outlive the result's use.
    options : PhotographOptions, optional
    advance : callable, optional
        Called with the name of each photograph that was read.

    Returns
    -------
    list of Photograph
        Those of a monochrome sensor have three equal channels, whose variance is tripled, so that
        together they say no more than one.

    Raises
    ------
    FittingError
        The session holds no photograph.
    SessionError
        A frame was altered.
    """
    options = options or PhotographOptions()
    brackets = _brackets(session)
    if not brackets:
        raise FittingError(f"{session.path} holds no photographs under the lamp")
    drift = _drift(session) if options.follow_drift else {}
    canvas_of_rig = invert(rt_rig_canvas)
    places: dict[str | None, _Place] = {}
    crop = session.plan.crop
    found = []
    for number, frames in enumerate(brackets):
        place, pose = frames[0].camera_position, frames[0].arm_pose
        assert pose is not None  # a lamp is lit at a pose: the plan sees to that
        if place not in views:
            raise FittingError(f"{session.path}: photographs from {place!r} are not registered")
        if place not in places:
            places[place] = _Place.of(session, place)
        name = f"{place or 'photograph'}-{number:04d}"
        merged = places[place].merged(session, frames)
        ratio = drift[place](session.recorded[frames[0].id].wall_time) if place in drift else 1.0
        radiance, variance = _in_scratch(merged, scratch / name, colour=options.mosaic is None)
        view = views[place]
        found.append(
            Photograph(
                name=name,
                radiance=radiance,
                variance=variance,
                lens=view.lens,
                rt_cam_canvas=view.rt_cam_canvas(rt_rig_canvas),
                lamp=lamp_seen_from(canvas_of_rig, lamps.lamp(pose)),
                mosaic=_shifted(options.mosaic, crop.row, crop.column),
                first_pixel=(crop.column, crop.row),
                exposure=ratio,
                flat_field=options.flat_field,
            )
        )
        advance(name)
    return found


def lamp_seen_from(rt_a_b: NDArray[np.float64], lamp: Lamp) -> Lamp:
    """A lamp given in frame b, in frame a."""
    return Lamp(
        transform(rt_a_b, lamp.position),
        rotation(rt_a_b) @ lamp.axis,
        lamp.intensity,
        lamp.exponent,
    )


@dataclass(frozen=True)
class _Place:
    """What all photographs from one place have in common."""

    black_level: float
    noise: SampleNoise
    dark: RadianceImage | None

    @classmethod
    def of(cls, session: Session, place: str | None) -> _Place:
        frames = [f for f in session.frames if f.camera_position == place]
        dark = [f for f in frames if f.purpose is Purpose.DARK]
        black, background = 0.0, None
        shortest = min(dark, key=lambda f: session.exposure_s(f.id) or 0.0, default=None)
        if shortest is not None:
            black = float(np.median(session.read_frame(shortest.id)))
        own = cls(black, _noise(session, frames, black), None)
        if dark:
            background = own._merge(session, dark)
        return cls(black, own.noise, background)

    def merged(self, session: Session, frames: list[PlannedFrame]) -> RadianceImage:
        """Radiance of a bracket without what there is in the dark."""
        image = self._merge(session, frames)
        if self.dark is None:
            return image
        return RadianceImage(
            image.radiance - self.dark.radiance, image.variance + self.dark.variance, image.samples
        )

    def _merge(self, session: Session, frames: list[PlannedFrame]) -> RadianceImage:
        exposures = [session.exposure_s(frame.id) for frame in frames]
        known = [exposure for exposure in exposures if exposure is not None]
        if len(known) < len(exposures):
            raise FittingError(f"{session.path}: photographs without an exposure time")
        return merge_bracket(
            [session.read_frame(frame.id) for frame in frames],
            known,
            noise=self.noise,
            black_level=self.black_level,
            saturation_level=session.plan.saturation_level,
        )


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
        raise FittingError(
            f"{session.path}: the noise of the photographs cannot be told, since the reference "
            "pose was taken once at most; photograph it twice"
        )
    level, square = np.concatenate(levels), np.concatenate(squares)
    step = max(1, level.size // _NOISE_SAMPLES)
    return fit_sample_noise(
        level[::step], square[::step], degrees_of_freedom=1, origin="repeated reference pose"
    )


def _brackets(session: Session) -> list[list[PlannedFrame]]:
    """The frames of each photograph, in the order of the plan."""
    found: dict[tuple[object, ...], list[PlannedFrame]] = {}
    for frame in session.frames:
        if frame.purpose is Purpose.PHOTOGRAPH and frame.lamp_on:
            found.setdefault((frame.bracket, frame.light), []).append(frame)
    return list(found.values())


def _drift(session: Session) -> dict[str | None, Callable[[float], float]]:
    """The lamp's brightness over that at its first reference, by place and time."""
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


def _in_scratch(image: RadianceImage, path: Path, *, colour: bool) -> tuple[Singles, Singles]:
    """Radiance and variance as read-only memory maps; saturated pixels stay without value."""
    maps = []
    for name, array in (("radiance", image.radiance), ("variance", image.variance)):
        file = path.with_name(f"{path.name}-{name}.npy")
        np.save(file, array)
        maps.append(np.load(file, mmap_mode="r"))
    radiance, variance = maps
    if not colour:
        return radiance, variance
    shape = (*radiance.shape, 3)
    tripled = path.with_name(f"{path.name}-variance.npy")
    np.save(tripled, 3.0 * image.variance)
    variance = np.load(tripled, mmap_mode="r")
    return (
        np.broadcast_to(radiance[..., np.newaxis], shape),
        np.broadcast_to(variance[..., np.newaxis], shape),
    )


def _shifted(mosaic: BayerPattern | None, row: int, col: int) -> BayerPattern | None:
    """Order of the colours from the pixel at (row, col) of the full frame."""
    if mosaic is None:
        return None
    square = np.array(list(mosaic.value)).reshape(2, 2)
    turned = np.roll(square, (-(row % 2), -(col % 2)), (0, 1))
    return BayerPattern("".join(turned.ravel()))
