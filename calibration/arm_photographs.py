"""Photographs by which a light arm is calibrated, read from a recorded session one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from acquisition.merged_photographs import (
    PhotographMerger,
    lamp_drift_by_place,
    photograph_brackets,
)
from acquisition.plan import PlannedFrame
from acquisition.session import Session
from acquisition.session_mosaic import mosaic_of
from calibration.errors import CalibrationError
from calibration.mosaics import mosaic_channels
from devices.bayer import BayerPattern
from devices.interfaces import ArmPose

Singles = NDArray[np.float32]
_EVEN = 8
# Of a usual picture's bright parts: beyond, it is a highlight.
_BRIGHT = 99.0


@dataclass(frozen=True)
class ArmPhotographs:
    """Photographs from the place at which the rig was calibrated, one for each pose of the lamp.

    Attributes
    ----------
    session : Session
    place : str or None
        Of the camera.
    mosaic : BayerPattern or None
        Order of the sensor's colours from the first pixel of the full frame; None if monochrome.
    brackets : tuple of lists of PlannedFrame
    merger : PhotographMerger
    drift : callable
        The lamp's brightness by wall time, over that at the beginning.
    """

    session: Session
    place: str | None
    mosaic: BayerPattern | None
    brackets: tuple[list[PlannedFrame], ...]
    merger: PhotographMerger = field(repr=False)
    drift: Callable[[float], float] = field(repr=False)

    @classmethod
    def of(
        cls, session: Session, *, place: str | None = None, mosaic: BayerPattern | None = None
    ) -> ArmPhotographs:
        """Photographs of a session.

        Parameters
        ----------
        session : Session
        place : str, optional
            Of the camera: that of the rig's calibration; by default the session's first.
        mosaic : BayerPattern, optional
            By default what the session says.

        Raises
        ------
        CalibrationError
            There are no photographs from that place.
        SessionError
            A frame was altered, the noise cannot be told, or the session says another mosaic.
        """
        where = place or next(iter(session.plan.camera_positions), None)
        brackets = [b for b in photograph_brackets(session) if b[0].camera_position == where]
        if not brackets:
            raise CalibrationError(
                f"{session.path} holds no photographs under the lamp"
                + (f" from {where!r}" if where else "")
                + ": record it with impasto photograph"
            )
        merger = PhotographMerger.of(session, where)
        drift = lamp_drift_by_place(session).get(where, lambda time: 1.0)
        return cls(session, where, mosaic_of(session, mosaic), tuple(brackets), merger, drift)

    @property
    def poses(self) -> tuple[ArmPose, ...]:
        """Of the lamp, in the order of the photographs."""
        return tuple(frames[0].arm_pose for frames in self.brackets if frames[0].arm_pose)

    @property
    def origin(self) -> tuple[int, int]:
        """Column and row of the pictures' first pixel in the full frame."""
        return self.session.plan.crop.column, self.session.plan.crop.row

    @property
    def saturation(self) -> float:
        """Radiance from which all exposures are saturated, sensor numbers per second."""
        exposures = [self.session.exposure_s(frames[0].id) for frames in self.brackets]
        shortest = min(exposure for exposure in exposures if exposure)
        return (self.session.plan.saturation_level - self.merger.black_level) / shortest

    @property
    def channels(self) -> NDArray[np.int64]:
        """Channel of each pixel by parity of row and column, (2, 2); -1 if monochrome."""
        column, row = self.origin
        return mosaic_channels(self.mosaic, row=row, column=column)

    def radiance(self, number: int) -> tuple[Singles, Singles]:
        """A photograph and its variance, (rows, cols) each, sensor numbers per second.

        Saturated pixels are NaN. The lamp's drift is divided out.
        """
        frames = self.brackets[number]
        merged = self.merger.merge(frames)
        ratio = np.float32(self.drift(self.session.recorded[frames[0].id].wall_time))
        return merged.radiance / ratio, merged.variance / ratio**2

    def grey(self, picture: Singles) -> Singles:
        """A picture in which a mosaic's colours weigh alike everywhere, saturated where they are.

        NaN becomes what saturates.
        """
        import cv2

        filled = np.where(np.isfinite(picture), picture, np.float32(self.saturation))
        if self.mosaic is None:
            return np.asarray(filled, np.float32)
        weights = np.array([0.25, 0.5, 0.25], np.float32)
        return np.asarray(cv2.sepFilter2D(filled, cv2.CV_32F, weights, weights))

    def even_light(self) -> Singles:
        """Mean of some photographs without their highlights: shadows fall to all sides."""
        chosen = np.unique(np.linspace(0, len(self.brackets) - 1, _EVEN).round().astype(int))
        total: Singles | None = None
        for number in chosen:
            picture = self.grey(self.radiance(int(number))[0])
            bright = np.percentile(picture, _BRIGHT)
            clipped = np.minimum(picture, bright) / max(float(bright), 1e-12)
            total = clipped if total is None else total + clipped
        assert total is not None  # there is one photograph at least
        return np.asarray(total / len(chosen), np.float32)
