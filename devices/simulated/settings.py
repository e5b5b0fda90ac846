"""Settings of a simulated rig, as they stand in the ``[simulation]`` table of a ``rig.toml``."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from devices.bayer import BayerPattern
from devices.settings import DriverSettings

if TYPE_CHECKING:
    from devices.rig import Rig
    from devices.simulated.rig import SimulatedRig

Millimetres = Annotated[float, Field(ge=-1e4, le=1e4)]
Place = tuple[Millimetres, Millimetres, Millimetres]
Coefficient = Annotated[float, Field(ge=-10, le=10)]
Distortion = tuple[Coefficient, Coefficient, Coefficient, Coefficient, Coefficient]
Degrees = Annotated[float, Field(ge=-720, le=720)]
Share = Annotated[float, Field(ge=0, le=10)]
PlaceName = Annotated[str, Field(min_length=1)]
SmallDegrees = Annotated[float, Field(ge=-20, le=20)]


class PaintingKind(StrEnum):
    """What is put before the simulated camera."""

    SMALL_OIL = "small_oil"
    OIL = "oil"
    TORTURE = "torture"
    BOARD = "board"
    CHESSBOARD = "chessboard"
    WHITE = "white"


class ArmErrors(BaseModel):
    """Geometry of the simulated arm, and by how much it differs from what it should be.

    Attributes
    ----------
    radius_mm : float, optional
        From the ring's centre to the lamp; by default, 1.3 times the camera's distance.
    centre_mm : (float, float, float)
        Of the ring, in the scene frame.
    ring_tilt_deg : (float, float)
        Of its axis, about X and Y.
    arc_lean_deg, azimuth_zero_deg, elevation_zero_deg, sag_deg : float
        As in :class:`~devices.simulated.arm_kinematics.ArmKinematics`.
    lamp_exponent : float
        Of the cosine by which the lamp falls off from its axis.
    lamp_colour : (float, float, float)
    aim_error_mm : (float, float, float)
        By which the lamp's axis misses the ring's centre.
    azimuth_deg, elevation_deg : (float, float)
        Limits.
    speed_deg_per_s : float
    real_time : bool
        Whether moves take their time.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    radius_mm: float | None = Field(default=None, gt=50, le=1e4)
    centre_mm: Place = (1.8, -2.4, 3.1)
    ring_tilt_deg: tuple[SmallDegrees, SmallDegrees] = (0.35, -0.22)
    arc_lean_deg: SmallDegrees = 0.3
    azimuth_zero_deg: SmallDegrees = 0.8
    elevation_zero_deg: SmallDegrees = -0.5
    sag_deg: SmallDegrees = 0.25
    lamp_exponent: float = Field(default=6.0, ge=0, le=200)
    lamp_colour: tuple[Share, Share, Share] = (1.0, 0.93, 0.82)
    aim_error_mm: Place = (4.0, -6.0, 0.0)
    azimuth_deg: tuple[Degrees, Degrees] = (0.0, 350.0)
    elevation_deg: tuple[Degrees, Degrees] = (15.0, 85.0)
    speed_deg_per_s: float = Field(default=30.0, gt=0, le=1e4)
    real_time: bool = False

    @model_validator(mode="after")
    def _limits_are_ranges(self) -> ArmErrors:
        for name in ("azimuth_deg", "elevation_deg"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name}: {low:g} to {high:g} is no range")
        return self


class SimulationSettings(DriverSettings):
    """A simulated rig: what it digitises, and with what.

    Attributes
    ----------
    painting : PaintingKind
    seed : int
        Of painting, sensor and noise.
    camera_width, camera_height : int, optional
        Frame in pixels; by default three megapixels, or 800 × 600 before the small painting.
    focal_px : float, optional
        Of the camera; by default 2.3 times the width.
    distortion, projector_distortion : (float, float, float, float, float)
        OpenCV's k1, k2, p1, p2, k3.
    vignetting : float
        Power of the cosine in camera and projector; 4 is natural.
    bits, bayer, full_well_e, read_noise_e, black_level, gain, prnu, dsnu_e
        As of :class:`~devices.simulated.sensor.Sensor`.
    projector_width, projector_height : int
        Panel in pixels.
    projector_focal_px : float, optional
        By default, so that the panel's width covers the camera's field and a quarter more.
    gamma, blur_px, projector_black
        As of :class:`~devices.simulated.optics.PanelResponse`.
    projector_mm : (float, float, float), optional
        Where the projector stands; aside of the camera by default.
    ambient : float
        Light of the room, as a share of the projector's.
    positions : dict of str to (float, float, float)
        Places of the camera, mm, by name; it looks at the origin from each. The first is where it
        stands at the beginning. By default front, left, right and above.
    arm : ArmErrors
    """

    painting: PaintingKind = PaintingKind.OIL
    seed: int = Field(default=0, ge=0, lt=2**31)
    camera_width: int | None = Field(default=None, ge=16, le=20_000)
    camera_height: int | None = Field(default=None, ge=16, le=20_000)
    focal_px: float | None = Field(default=None, gt=0, le=1e6)
    distortion: Distortion = (-0.08, 0.05, 4e-4, -3e-4, 0.0)
    vignetting: float = Field(default=4.0, ge=0, le=20)
    bits: int = Field(default=12, ge=8, le=16)
    bayer: BayerPattern | None = None
    full_well_e: float = Field(default=10_000.0, ge=100, le=1e7)
    read_noise_e: float = Field(default=8.0, ge=0, le=1e5)
    black_level: float = Field(default=32.0, ge=0)
    gain: float | None = Field(default=None, ge=1e-4, le=1e4)
    prnu: float = Field(default=0.008, ge=0, le=0.5)
    dsnu_e: float = Field(default=1.0, ge=0, le=1e5)
    projector_width: int = Field(default=1280, ge=16, le=20_000)
    projector_height: int = Field(default=800, ge=16, le=20_000)
    projector_focal_px: float | None = Field(default=None, gt=0, le=1e6)
    projector_distortion: Distortion = (-0.05, 0.03, -5e-4, 2e-4, 0.0)
    projector_mm: Place | None = None
    gamma: float = Field(default=1.0, gt=0, le=10)
    blur_px: float = Field(default=0.6, ge=0, le=50)
    projector_black: float = Field(default=0.004, ge=0, lt=1)
    ambient: float = Field(default=0.001, ge=0, le=10)
    positions: dict[PlaceName, Place] = Field(default_factory=dict)
    arm: ArmErrors = ArmErrors()

    @model_validator(mode="after")
    def _can_be_built(self) -> SimulationSettings:
        if self.black_level >= 2**self.bits / 2:
            raise ValueError(f"black_level: {self.black_level:g} leaves no room for light")
        places = {f"positions: {name!r}": place for name, place in self.positions.items()}
        if self.projector_mm is not None:
            places["projector_mm:"] = self.projector_mm
        for name, (x, y, z) in places.items():
            if not (z > 0 and math.hypot(x, y, z) > 50):
                raise ValueError(f"{name} must be before the painting (z > 0), 50 mm away at least")
        return self

    def build(self) -> SimulatedRig:
        """Make the scene and its devices."""
        from devices.simulated.rig import build_rig

        return build_rig(self)

    def open_rig(self) -> Rig:
        """The rig, as any other: its camera, projector, arm and mount are the simulated ones."""
        return self.build().open()
