"""The plan of a scan: what is to be captured, as pure data made before the first frame."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from acquisition.patterns import Pattern

FrameId = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$", max_length=64)]


class _PlanPart(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Imager(_PlanPart):
    """Size of a sensor or panel in pixels."""

    width: int = Field(gt=0)
    height: int = Field(gt=0)


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
    pattern : Pattern
        What the projector shows.
    exposure_s : float or None
        Exposure time asked for; None where a foreign capture does not say.
    """

    id: FrameId
    pattern: Pattern
    exposure_s: float | None = Field(default=None, gt=0)


class Plan(_PlanPart):
    """Everything that a scan will capture.

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
    """

    format: Literal["impasto-plan-1"] = "impasto-plan-1"
    camera: Imager
    projector: Imager
    crop: Crop
    saturation_level: int = Field(gt=0, le=65535)
    frames: tuple[PlannedFrame, ...] = Field(min_length=1)
    source: str

    @model_validator(mode="after")
    def _consistent(self) -> Plan:
        ids = [frame.id for frame in self.frames]
        doubled = sorted({i for i in ids if ids.count(i) > 1}) if len(set(ids)) < len(ids) else []
        if doubled:
            raise ValueError(f"frame ids occur more than once: {', '.join(doubled)}")
        if (
            self.crop.column + self.crop.width > self.camera.width
            or self.crop.row + self.crop.height > self.camera.height
        ):
            raise ValueError("the crop reaches outside the sensor")
        return self
