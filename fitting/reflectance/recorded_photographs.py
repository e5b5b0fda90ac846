"""Photographs of a session, merged, freed of other light, and ready to be back-projected.

Each bracket is merged into radiance per second (:mod:`acquisition.merged_photographs`). The merged
photographs lie in a scratch file that is mapped into memory, so that any number of them takes
little of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from acquisition.merged_photographs import (
    PhotographMerger,
    lamp_drift_by_place,
    photograph_brackets,
)
from acquisition.session import Session
from acquisition.session_mosaic import mosaic_of
from calibration.flat_field import FlatField
from calibration.lamp import Lamp
from calibration.lens import invert
from calibration.registration import RegisteredView
from devices.bayer import BayerPattern
from devices.interfaces import ArmPose
from fitting.errors import FittingError
from fitting.reflectance.photographs import Photograph
from fitting.reflectance.scratch_pictures import ScratchPictures

Singles = NDArray[np.float32]


class LampPoses(Protocol):
    """What knows where the lamp is at a pose of its arm, and what it sends."""

    def lamp(self, pose: ArmPose) -> Lamp:
        """The lamp in the rig's frame, that of the scan's camera."""


@runtime_checkable
class MeasuredThroughLens(Protocol):
    """Lamps whose intensities were measured by a camera, its vignetting divided out."""

    @property
    def flat_field(self) -> FlatField | None:
        """The vignetting."""


@dataclass(frozen=True, kw_only=True)
class PhotographOptions:
    """How recorded photographs are read.

    Attributes
    ----------
    mosaic : BayerPattern or None
        Order of the sensor's colours from the first pixel of the full frame; by default what the
        session says, and monochrome where it does not.
    flat_field : (rows, cols) float32 array or None
        What the camera makes of even light, of the frames' size; by default what is known with the
        lamps.
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
        Folder for the merged photographs, in a file without a name that goes when they do.
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
        A frame was altered, or the session says another mosaic.
    """
    options = options or PhotographOptions()
    brackets = photograph_brackets(session)
    if not brackets:
        raise FittingError(f"{session.path} holds no photographs under the lamp")
    drift = lamp_drift_by_place(session) if options.follow_drift else {}
    canvas_of_rig = invert(rt_rig_canvas)
    places: dict[str | None, PhotographMerger] = {}
    crop = session.plan.crop
    flat_field = options.flat_field
    if flat_field is None and isinstance(lamps, MeasuredThroughLens) and lamps.flat_field:
        flat_field = lamps.flat_field.gain_picture(
            origin=(crop.column, crop.row), shape=(crop.height, crop.width)
        )
    mosaic = mosaic_of(session, options.mosaic)
    grey = mosaic is None
    found: list[tuple[str, RegisteredView, Lamp, float]] = []
    with TemporaryFile(prefix="photographs-", dir=scratch) as file:
        pictures = ScratchPictures(file)
        for number, frames in enumerate(brackets):
            place, pose = frames[0].camera_position, frames[0].arm_pose
            assert pose is not None  # a lamp is lit at a pose: the plan sees to that
            if place not in views:
                raise FittingError(f"{session.path}: photographs from {place!r} are not registered")
            if place not in places:
                places[place] = PhotographMerger.of(session, place)
            name = f"{place or 'photograph'}-{number:04d}"
            merged = places[place].merge(frames)
            pictures.append(merged.radiance)
            pictures.append(3.0 * merged.variance if grey else merged.variance)
            taken = session.recorded[frames[0].id].wall_time
            drifted = drift[place](taken) if place in drift else 1.0
            lamp = lamps.lamp(pose).transformed(canvas_of_rig)
            found.append((name, views[place], lamp, drifted))
            advance(name)
        planes = pictures.mapped()
    return [
        Photograph(
            name=name,
            radiance=_in_colour(planes[2 * number], grey=grey),
            variance=_in_colour(planes[2 * number + 1], grey=grey),
            lens=view.lens,
            rt_cam_canvas=view.rt_cam_canvas(rt_rig_canvas),
            lamp=lamp,
            mosaic=_shifted(mosaic, crop.row, crop.column),
            first_pixel=(crop.column, crop.row),
            exposure=drifted,
            flat_field=flat_field,
        )
        for number, (name, view, lamp, drifted) in enumerate(found)
    ]


def _in_colour(plane: Singles, *, grey: bool) -> Singles:
    """A plane, as three channels that are one if it is grey."""
    return np.broadcast_to(plane[..., np.newaxis], (*plane.shape, 3)) if grey else plane


def _shifted(mosaic: BayerPattern | None, row: int, col: int) -> BayerPattern | None:
    """Order of the colours from the pixel at (row, col) of the full frame."""
    if mosaic is None:
        return None
    square = np.array(list(mosaic.value)).reshape(2, 2)
    turned = np.roll(square, (-(row % 2), -(col % 2)), (0, 1))
    return BayerPattern("".join(turned.ravel()))
