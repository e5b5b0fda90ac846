"""The plan of a recording: what is to be captured, as pure data made before the first frame.

Frames may form brackets, exposures of one light from short to long, of which the recording leaves
out those that no pixel needs. Which ones, it decides from the frames that it has recorded, by a
rule that stands in the plan; so a recording that is resumed decides as one that was never cut off.
A projected code may be metered: its first frames tell which of the others some pixel needs.
"""

from __future__ import annotations

import math
from enum import StrEnum
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from acquisition.patterns import BLACK, WHITE, Axis, Pattern, PhaseShift, Uniform
from acquisition.projector_response import ProjectorResponse
from devices.bayer import BayerPattern
from devices.interfaces import ArmPose

FrameId = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$", max_length=64)]


class Purpose(StrEnum):
    """What a frame is taken for."""

    CODE = "code"
    PHOTOGRAPH = "photograph"
    REFERENCE_POSE = "reference pose"
    FLAT_TARGET = "flat target"
    COLOUR_CHART = "colour chart"
    DARK = "dark"


def _finite_pose(pose: ArmPose) -> ArmPose:
    if not (math.isfinite(pose.azimuth) and math.isfinite(pose.elevation)):
        raise ValueError("an arm pose has finite angles")
    return pose


PlannedPose = Annotated[ArmPose, AfterValidator(_finite_pose)]


class _PlanPart(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Imager(_PlanPart):
    """Size of a sensor or panel in pixels.

    Attributes
    ----------
    width, height : int
    mosaic : BayerPattern or None
        Order of a sensor's colours from its first pixel; None if it is monochrome, or where nobody
        said.
    """

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    mosaic: BayerPattern | None = None

    @model_serializer(mode="wrap")
    def _without_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out a mosaic that there is not: plans read and write as they always did."""
        return _less_defaults(self, handler(self), ("mosaic",))


class Crop(_PlanPart):
    """The part of the sensor that frames hold: first column and row, and size."""

    column: int = Field(ge=0)
    row: int = Field(ge=0)
    width: int = Field(gt=0)
    height: int = Field(gt=0)


class PlannedFrame(_PlanPart):
    """One frame to be taken.

    Attributes
    ----------
    id : str
        Name of the frame, unique in the plan; its file is named after it.
    pattern : Pattern or None
        What the projector shows; None where it is dark.
    exposure_s : float or None
        Exposure time asked for; None where a foreign capture does not say.
    purpose : Purpose
        What it is taken for.
    arm_pose : ArmPose or None
        Where the light arm stands; None where that does not matter.
    lamp_on : bool
        Whether the arm's lamp is lit.
    camera_position : str or None
        Where the camera stands; None where it stays where it is.
    bracket : str or None
        Name of the bracket that the frame belongs to. The first frame of a bracket is always taken,
        the others where :class:`Bracketing` finds that they are needed.
    """

    id: FrameId
    pattern: Pattern | None
    exposure_s: float | None = Field(default=None, gt=0)
    purpose: Purpose = Purpose.CODE
    arm_pose: PlannedPose | None = None
    lamp_on: bool = False
    camera_position: str | None = None
    bracket: FrameId | None = None

    @property
    def light(self) -> tuple[Any, ...]:
        """What frames of one bracket have in common."""
        return (self.purpose, self.pattern, self.arm_pose, self.lamp_on, self.camera_position)

    @property
    def is_metered(self) -> bool:
        """Whether metering may find that the frame is not needed, where the plan is metered."""
        return self.purpose is Purpose.CODE and not isinstance(self.pattern, Uniform)

    @model_validator(mode="after")
    def _consistent(self) -> PlannedFrame:
        if self.lamp_on and self.arm_pose is None:
            raise ValueError(f"frame {self.id}: a lamp is lit at a pose of its arm; name one")
        if self.pattern is None and self.purpose is Purpose.CODE:
            raise ValueError(f"frame {self.id}: a code has a pattern")
        if self.bracket is not None and self.exposure_s is None:
            raise ValueError(f"frame {self.id}: in a bracket each frame has an exposure")
        return self

    @model_serializer(mode="wrap")
    def _without_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what photographs alone have: scans read and write as they always did."""
        written: dict[str, Any] = handler(self)
        return _less_defaults(
            self, written, ("purpose", "arm_pose", "lamp_on", "camera_position", "bracket")
        )


class Bracketing(_PlanPart):
    """When a frame of a bracket is needed.

    A pixel needs an exposure if no shorter one gave it enough signal, the exposure will not
    saturate it, and the next one would, or there is none. Each pixel is so served by the longest
    exposure that it can take, and no choice of fewer exposures serves them all.

    Attributes
    ----------
    least_signal : float
        Signal above black that is enough, as a share of what saturates.
    headroom : float
        Signals predicted to exceed this share of what saturates count as saturated.
    least_share : float
        Share of the pixels that must need an exposure for it to be taken.
    """

    least_signal: float = Field(default=0.25, gt=0, lt=1)
    headroom: float = Field(default=0.85, gt=0, le=1)
    least_share: float = Field(default=5e-4, ge=0, lt=1)


class Metering(_PlanPart):
    """Which frames of a projected code are needed, by what its first ones show.

    White and black at every exposure come first, then some steps of every fringe at the exposure
    that suits most pixels. They tell what variance each pixel's coordinate would have from any
    other frames, and so which of them no pixel needs.

    Attributes
    ----------
    column_sigma_px, row_sigma_px : float
        Standard deviation that each coordinate is to have, in pixels of the panel.
    slack : float
        A pixel that misses it whatever is taken may lose this share of what precision it can have.
    least_share : float
        Share of the pixels that must need a frame for it to be taken.
    least_steps : int
        Fewest steps of a fringe: harmonics of the projector's response up to one less are kept out
        of the phase.
    wrong_order_probability : float
        Of a step from a coarse fringe to a finer one, for which the coarse one must be precise.
    """

    column_sigma_px: float = Field(default=0.05, gt=0)
    row_sigma_px: float = Field(default=0.05, gt=0)
    slack: float = Field(default=0.03, ge=0, lt=1)
    least_share: float = Field(default=5e-4, ge=0, lt=1)
    least_steps: int = Field(default=4, ge=3)
    wrong_order_probability: float = Field(default=1e-5, gt=0, lt=1)

    def sigma_px(self, axis: Axis) -> float:
        """The target of a coordinate."""
        return self.column_sigma_px if axis is Axis.COLUMN else self.row_sigma_px


class Plan(_PlanPart):
    """Everything that a recording will capture.

    Attributes
    ----------
    camera, projector : Imager
        Full sensor and panel sizes.
    crop : Crop
        What part of the sensor the frames hold (the whole, unless they were cropped).
    saturation_level : int
        Sensor number at and above which a sample is saturated.
    frames : tuple of PlannedFrame
        In the order of capture.
    source : str
        Where the frames come from: ``"rig"``, ``"simulation"``, or a foreign capture's name.
    bracketing : Bracketing or None
        When frames of brackets are needed; None if all of them are taken.
    metering : Metering or None
        When frames of a projected code are needed; None if all of them are taken.
    response : ProjectorResponse or None
        By which fringes are compensated; None where they are shown as they are.
    lamp_warm_up_s : float
        For how long the lamp burns before the first frame that it lights.
    """

    format: Literal["impasto-plan-1"] = "impasto-plan-1"
    camera: Imager
    projector: Imager
    crop: Crop
    saturation_level: int = Field(gt=0, le=65535)
    frames: tuple[PlannedFrame, ...] = Field(min_length=1)
    source: str
    bracketing: Bracketing | None = None
    metering: Metering | None = None
    response: ProjectorResponse | None = None
    lamp_warm_up_s: float = Field(default=0.0, ge=0, le=3600)

    @property
    def camera_positions(self) -> tuple[str, ...]:
        """Places of the camera that frames name, in the order of the first."""
        named = (f.camera_position for f in self.frames if f.camera_position is not None)
        return tuple(dict.fromkeys(named))

    @property
    def optional_frames(self) -> frozenset[str]:
        """Ids of the frames that the recording may find not to be needed."""
        optional: set[str] = set()
        if self.bracketing is not None:
            followers = (f for before, f in pairwise(self.frames) if f.bracket == before.bracket)
            optional |= {frame.id for frame in followers if frame.bracket is not None}
        if self.metering is not None:
            optional |= {frame.id for frame in self.frames if frame.is_metered}
        return frozenset(optional)

    def only(self, *, purpose: Purpose, camera_position: str | None = None) -> Plan | None:
        """The part of the plan that serves a purpose, from one place of the camera.

        Parameters
        ----------
        purpose : Purpose
        camera_position : str, optional
            By default, wherever the camera stands.

        Returns
        -------
        Plan or None
            None if there is no such frame.
        """
        frames = tuple(
            frame
            for frame in self.frames
            if frame.purpose is purpose
            and (camera_position is None or frame.camera_position == camera_position)
        )
        return self.model_copy(update={"frames": frames}) if frames else None

    @model_serializer(mode="wrap")
    def _without_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        written: dict[str, Any] = handler(self)
        return _less_defaults(
            self, written, ("bracketing", "metering", "response", "lamp_warm_up_s")
        )

    @model_validator(mode="after")
    def _can_be_metered(self) -> Plan:
        if self.metering is None:
            return self
        flats: dict[str | None, set[tuple[float | None, Pattern | None]]] = {}
        exposures: dict[tuple[str | None, Pattern | None], set[float | None]] = {}
        for frame in self.frames:
            before = flats.setdefault(frame.camera_position, set())
            if not frame.is_metered:
                before.add((frame.exposure_s, frame.pattern))
            elif not all((frame.exposure_s, flat) in before for flat in (WHITE, BLACK)):
                raise ValueError(
                    f"frame {frame.id}: metering takes white and black at its exposure before it"
                )
            else:
                taken = exposures.setdefault((frame.camera_position, frame.pattern), set())
                taken.add(frame.exposure_s)
        if not any(isinstance(pattern, PhaseShift) for _, pattern in exposures):
            raise ValueError("metering chooses steps of fringes, and there are none")
        for (place, pattern), taken in exposures.items():
            if taken != {exposure for exposure, _ in flats[place]}:
                raise ValueError(
                    f"metering chooses among the same exposures of every pattern; {pattern} has "
                    "others"
                )
        return self

    @model_validator(mode="after")
    def _brackets_in_order(self) -> Plan:
        last: dict[str, int] = {}
        for number, frame in enumerate(self.frames):
            if frame.bracket is None:
                continue
            if frame.bracket in last and last[frame.bracket] != number - 1:
                raise ValueError(f"frame {frame.id}: its bracket was interrupted by another frame")
            last[frame.bracket] = number
        for before, frame in pairwise(self.frames):
            if frame.bracket is None or frame.bracket != before.bracket:
                continue
            if frame.light != before.light:
                raise ValueError(f"frame {frame.id}: its bracket began under another light")
            if (frame.exposure_s or 0.0) <= (before.exposure_s or 0.0):
                raise ValueError(f"frame {frame.id}: exposures of a bracket rise")
        return self

    @model_validator(mode="after")
    def _consistent(self) -> Plan:
        ids = [frame.id for frame in self.frames]
        doubled = sorted({i for i in ids if ids.count(i) > 1}) if len(set(ids)) < len(ids) else []
        if self.projector.mosaic is not None:
            raise ValueError("a projector's panel has no mosaic")
        if doubled:
            raise ValueError(f"frame ids occur more than once: {', '.join(doubled)}")
        if (
            self.crop.column + self.crop.width > self.camera.width
            or self.crop.row + self.crop.height > self.camera.height
        ):
            raise ValueError("the crop reaches outside the sensor")
        return self


def _less_defaults(
    part: _PlanPart, written: dict[str, Any], names: tuple[str, ...]
) -> dict[str, Any]:
    """What a part of a plan was written as, without those of some fields that have defaults."""
    fields = type(part).model_fields
    default = {name for name in names if getattr(part, name) == fields[name].default}
    return {name: value for name, value in written.items() if name not in default}
