"""What a ``capture.toml`` says about a fringe scan made by other software.

It tells which file is which pattern, so nobody has to rename files; see ``docs/file-formats.md``
and the examples in ``fixtures/captures``.
"""

from __future__ import annotations

import tomllib
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from acquisition.errors import CaptureError
from acquisition.patterns import Axis
from acquisition.plan import Imager

# Of one fringe or code; no capture comes near it.
_MOST_FILES = 10_000


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class NumberedFiles(_Part):
    """Files that differ by a number: ``pattern`` holds a run of ``#``, one per digit.

    ``step`` may be negative, for files in the opposite order.
    """

    pattern: str = Field(pattern=r"^[^#]*#+[^#]*$")
    first: int = Field(ge=0)
    last: int = Field(ge=0)
    step: int = 1

    @model_validator(mode="after")
    def _runs_from_first_to_last(self) -> NumberedFiles:
        if self.step == 0 or (self.last - self.first) % self.step:
            raise ValueError(f"steps of {self.step} do not lead from {self.first} to {self.last}")
        if (self.last - self.first) * self.step < 0:
            raise ValueError(f"steps of {self.step} lead away from {self.last}")
        if abs((self.last - self.first) // self.step) >= _MOST_FILES:
            raise ValueError(f"more than {_MOST_FILES} files from {self.first} to {self.last}")
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """The files' names, in order."""
        before, after = self.pattern.split("#", 1)[0], self.pattern.rsplit("#", 1)[1]
        digits = self.pattern.count("#")
        end = self.last + (1 if self.step > 0 else -1)
        return tuple(f"{before}{n:0{digits}d}{after}" for n in range(self.first, end, self.step))


def _names(files: Any) -> Any:
    return NumberedFiles.model_validate(files).names if isinstance(files, dict) else files


FileNames = Annotated[tuple[str, ...], BeforeValidator(_names)]


class Channel(StrEnum):
    """What to take from pictures in colour."""

    RED = "red"
    GREEN = "green"
    BLUE = "blue"
    MEAN = "mean"


class Direction(StrEnum):
    """Which way the stored pose goes."""

    CAMERA_TO_PROJECTOR = "camera to projector"
    PROJECTOR_TO_CAMERA = "projector to camera"


class CalibrationDescription(_Part):
    """Where a foreign calibration lies, and the names of its matrices.

    ``file`` is relative to the capture's folder. ``pose`` says which frame's points rotation and
    translation take to which.
    """

    file: str
    camera_matrix: str
    camera_distortion: str
    projector_matrix: str
    projector_distortion: str
    rotation: str
    translation: str
    pose: Direction = Direction.CAMERA_TO_PROJECTOR


class CropDescription(_Part):
    """Where cropped files lie in the full frame.

    Either ``column`` and ``row`` of their first pixel, or ``file``: a JSON file with
    ``[x0, y0, x1, y1]``, or with one such list per folder of captures.
    """

    column: int = Field(default=0, ge=0)
    row: int = Field(default=0, ge=0)
    file: str | None = None

    @model_validator(mode="after")
    def _said_once(self) -> CropDescription:
        if self.file is not None and {"column", "row"} & self.model_fields_set:
            raise ValueError("give either column and row, or file")
        return self


class PhaseShiftGroup(_Part):
    """Files of one phase-shifted fringe, in the order of ``shifts_rad``.

    Without ``shifts_rad`` the steps are spread evenly over a period, rising or (``falling``)
    falling. One of ``periods`` (over the whole panel) and ``period_px`` is given.
    """

    axis: Axis
    files: FileNames = Field(min_length=3)
    periods: float | None = Field(default=None, gt=0)
    period_px: float | None = Field(default=None, gt=0)
    shifts_rad: tuple[float, ...] | None = None
    falling: bool = False
    origin_rad: float = 0.0
    gamma: float = Field(default=1.0, gt=0)

    @model_validator(mode="after")
    def _consistent(self) -> PhaseShiftGroup:
        if (self.periods is None) == (self.period_px is None):
            raise ValueError("give either periods or period_px")
        if self.shifts_rad is not None and len(self.shifts_rad) != len(self.files):
            raise ValueError(f"{len(self.files)} files but {len(self.shifts_rad)} shifts_rad")
        if self.shifts_rad is not None and self.falling:
            raise ValueError("falling is for even steps; shifts_rad say it all")
        return self


class GrayGroup(_Part):
    """Files of one Gray code, most significant bit first, and of its inverse if there is one."""

    axis: Axis
    files: FileNames = Field(min_length=1)
    step_px: float = Field(gt=0)
    offset: float = 0.0
    threshold: Literal["phase-shift mean", "inverse"] = "phase-shift mean"
    inverse_files: FileNames = ()

    @model_validator(mode="after")
    def _consistent(self) -> GrayGroup:
        if (self.threshold == "inverse") != bool(self.inverse_files):
            raise ValueError('inverse_files go with threshold = "inverse"')
        if self.inverse_files and len(self.inverse_files) != len(self.files):
            raise ValueError(f"{len(self.files)} files, {len(self.inverse_files)} inverse_files")
        return self


class CaptureDescription(_Part):
    """Everything a ``capture.toml`` says.

    ``channel`` is what to take from pictures in colour; without it those whose channels differ
    are refused. ``camera.mosaic`` is of sensor numbers as they came, which have no channels.
    """

    name: str
    camera: Imager
    projector: Imager
    saturation_level: int = Field(gt=0, le=65535)
    channel: Channel | None = None
    crop: CropDescription = CropDescription()
    phase_shift: tuple[PhaseShiftGroup, ...] = ()
    gray: tuple[GrayGroup, ...] = ()
    white: str | None = None
    black: str | None = None
    calibration: CalibrationDescription | None = None

    @model_validator(mode="after")
    def _files_named_once(self) -> CaptureDescription:
        names = [name for group in self.phase_shift for name in group.files]
        names += [name for code in self.gray for name in code.files + code.inverse_files]
        names += [name for name in (self.white, self.black) if name is not None]
        if not names:
            raise ValueError("no files are named")
        if self.projector.mosaic is not None:
            raise ValueError("a projector's panel has no mosaic")
        if self.channel is not None and self.camera.mosaic is not None:
            raise ValueError("camera.mosaic is of sensor numbers, channel of pictures in colour")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"{', '.join(twice)}: one file cannot be two patterns")
        return self


def read_description(path: Path) -> CaptureDescription:
    """Read a ``capture.toml``.

    Raises
    ------
    CaptureError
        The file is missing or not TOML, or a key is missing, unknown or wrong; it is named.
    """
    try:
        content = tomllib.loads(Path(path).read_text())
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}") from None
    except RecursionError:
        raise CaptureError(f"{path}: not TOML (brackets in brackets)") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: not TOML ({error})") from None
    try:
        return CaptureDescription.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "the file"
        raise CaptureError(f"{path}: {key}: {first['msg']}") from None
