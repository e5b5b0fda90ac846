"""The simulated rig: a scene and the devices that light it and look at it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from devices.interfaces import ArmLimits, ArmPose
from devices.rig import Rig
from devices.simulated.arm_kinematics import ArmKinematics, Lamp
from devices.simulated.board import BoardPattern, make_board
from devices.simulated.camera import SimulatedCamera, SimulatedMount
from devices.simulated.canvas_ground import WALL_MM
from devices.simulated.light_arm import ArmMechanism, SimulatedLightArm
from devices.simulated.oil_painting import paint_oil, paint_small_oil
from devices.simulated.optics import PanelResponse, SimulatedLens
from devices.simulated.projector import SimulatedProjector
from devices.simulated.scene import SimulatedScene
from devices.simulated.scene_objects import PlacedSurface, Wall
from devices.simulated.sensor import Sensor
from devices.simulated.settings import ArmErrors, PaintingKind, SimulationSettings
from devices.simulated.surface import Surface
from devices.simulated.torture_piece import make_torture_piece

# The field that the camera is to see, in units of its distance, at the default focal length.
_FIELD = 1 / 2.3


@dataclass(frozen=True)
class SimulatedRig:
    """A scene with its devices.

    Attributes
    ----------
    scene : SimulatedScene
    camera : SimulatedCamera
    projector : SimulatedProjector
    arm : SimulatedLightArm
    mount : SimulatedMount
    """

    scene: SimulatedScene
    camera: SimulatedCamera
    projector: SimulatedProjector
    arm: SimulatedLightArm
    mount: SimulatedMount

    @classmethod
    def of(
        cls,
        scene: SimulatedScene,
        *,
        limits: ArmLimits | None = None,
        speed: float = math.radians(30),
        real_time: bool = False,
    ) -> SimulatedRig:
        """Give a scene its devices."""
        limits = limits or ArmLimits((0.0, math.radians(350)), (math.radians(15), math.radians(85)))
        # Nobody knows where an arm stands that has just been switched on.
        random = np.random.default_rng([scene.seed, 0x41524D])
        anywhere = [
            low + random.uniform(0.2, 0.8) * (high - low)
            for low, high in (limits.azimuth, limits.elevation)
        ]
        mechanism = ArmMechanism(ArmPose(*anywhere))
        scene.carry_lamp(mechanism)
        return cls(
            scene,
            SimulatedCamera(scene),
            SimulatedProjector(scene),
            SimulatedLightArm(mechanism, limits=limits, speed=speed, real_time=real_time),
            SimulatedMount(scene),
        )

    @classmethod
    def before(
        cls,
        surface: Surface,
        camera: SimulatedLens,
        projector: SimulatedLens,
        *,
        sensor: Sensor | None = None,
        panel: PanelResponse | None = None,
        ambient: float = 0.0,
        seed: int = 0,
    ) -> SimulatedRig:
        """A rig with one place for the camera, before a surface that hangs where it should."""
        scene = SimulatedScene(
            PlacedSurface(surface),
            (Wall(surface.back_mm),),
            {"front": camera},
            projector,
            sensor=sensor,
            panel=panel,
            ambient=ambient,
            seed=seed,
        )
        return cls.of(scene)

    @property
    def painting(self) -> Surface:
        """What stands before the camera."""
        return self.scene.subject.surface

    @property
    def camera_lens(self) -> SimulatedLens:
        """The camera's lens where it stands."""
        return self.scene.cameras[self.scene.position]

    @property
    def projector_lens(self) -> SimulatedLens:
        """The projector's lens."""
        return self.scene.projector

    def electrons(self, exposure_s: float) -> NDArray[np.float64]:
        """Electrons (rows, cols) that a frame would hold on average in a perfect sensor."""
        return self.scene.electrons(exposure_s)

    def open(self) -> Rig:
        """The rig, as any other."""
        return Rig(self.camera, self.projector, self.arm, self.mount, source="simulation")


def build_rig(settings: SimulationSettings) -> SimulatedRig:
    """Make a simulated rig.

    Parameters
    ----------
    settings : SimulationSettings
    """
    surface = _surface(settings.painting, settings.seed)
    small = settings.painting is PaintingKind.SMALL_OIL
    width = settings.camera_width or (800 if small else 2048)
    height = settings.camera_height or width * 3 // 4
    # The camera stands where its default lens sees the whole surface.
    extent = [(size - 1) * surface.pitch_mm for size in surface.height.shape]
    distance = round(max(extent[1], extent[0] * 4 / 3) / _FIELD, -1)
    positions = settings.positions or _around(distance)
    first = next(iter(positions.values()))
    front = SimulatedLens.looking_at(
        width=width,
        height=height,
        focal_px=settings.focal_px or width / _FIELD,
        position=first,
        target=(0.0, 0.0, 0.0),
        distortion=settings.distortion,
        vignetting=settings.vignetting,
    )
    sensor = Sensor(
        full_well_e=settings.full_well_e,
        read_noise_e=settings.read_noise_e,
        bits=settings.bits,
        black_level=settings.black_level,
        gain=settings.gain,
        prnu=settings.prnu,
        dsnu_e=settings.dsnu_e,
        bayer=settings.bayer,
    )
    scene = SimulatedScene(
        PlacedSurface(surface),
        (Wall(_wall_mm(settings.painting)),),
        {name: front.moved(place, (0.0, 0.0, 0.0)) for name, place in positions.items()},
        _projector(settings, distance),
        panel=PanelResponse(
            gamma=settings.gamma, blur_px=settings.blur_px, black=settings.projector_black
        ),
        sensor=sensor,
        arm=_arm(settings.arm, distance),
        lamp=Lamp(
            exponent=settings.arm.lamp_exponent,
            colour=settings.arm.lamp_colour,
            aim_error=settings.arm.aim_error_mm,
        ),
        ambient=settings.ambient,
        seed=settings.seed,
    )
    low_high = (settings.arm.azimuth_deg, settings.arm.elevation_deg)
    limits = [(math.radians(low), math.radians(high)) for low, high in low_high]
    return SimulatedRig.of(
        scene,
        limits=ArmLimits(*limits),
        speed=math.radians(settings.arm.speed_deg_per_s),
        real_time=settings.arm.real_time,
    )


def demo_rig(
    *, seed: int = 0, camera_width: int = 800, sensor: Sensor | None = None
) -> SimulatedRig:
    """The small rig of the demo: an oil sketch of 120 × 90 mm in a frame, 450 mm away.

    Parameters
    ----------
    seed : int
        Of painting and noise.
    camera_width : int
        Width of a frame; the height is three quarters of it.
    sensor : Sensor, optional
    """
    camera = SimulatedLens.looking_at(
        width=camera_width,
        height=camera_width * 3 // 4,
        focal_px=2.3 * camera_width,
        position=(-25.0, 12.0, 450.0),
        target=(0.0, 0.0, 0.0),
        distortion=(-0.08, 0.05, 4e-4, -3e-4, 0.0),
    )
    projector = SimulatedLens.looking_at(
        width=912,
        height=570,
        focal_px=1750.0,
        position=(170.0, 25.0, 430.0),
        target=(0.0, 0.0, 0.0),
        distortion=(-0.05, 0.03, -5e-4, 2e-4, 0.0),
        centre_shift=(6.0, 40.0),
    )
    places = {name: camera.moved(place, (0.0, 0.0, 0.0)) for name, place in _around(450.0).items()}
    scene = SimulatedScene(
        PlacedSurface(paint_small_oil(seed=seed)),
        (Wall(WALL_MM),),
        places | {"front": camera},
        projector,
        sensor=sensor,
        arm=_arm(ArmErrors(), 450.0),
        seed=seed,
    )
    return SimulatedRig.of(scene)


def _around(distance: float) -> dict[str, tuple[float, float, float]]:
    """Places about as far away as ``distance``, mm."""
    directions = {
        "front": (-0.055, 0.027, 1.0),
        "left": (-0.62, 0.05, 0.80),
        "right": (0.62, -0.04, 0.80),
        "above": (0.04, 0.58, 0.83),
    }
    return {n: (x * distance, y * distance, z * distance) for n, (x, y, z) in directions.items()}


def _surface(kind: PaintingKind, seed: int) -> Surface:
    if kind is PaintingKind.SMALL_OIL:
        return paint_small_oil(seed=seed)
    if kind is PaintingKind.OIL:
        return paint_oil(seed=seed)
    if kind is PaintingKind.TORTURE:
        return make_torture_piece(seed=seed)
    if kind is PaintingKind.BOARD:
        return make_board()
    if kind is PaintingKind.CHESSBOARD:
        return make_board(BoardPattern(marker_mm=None))
    flat = np.zeros((1001, 1201), np.float32)
    return Surface.uniform(flat, pitch_mm=0.25, canvas_mm=(300.0, 250.0), albedo=0.9, back_mm=-4.0)


def _wall_mm(kind: PaintingKind) -> float:
    """A painting hangs on the wall; a board is held well before it, to be turned freely."""
    paintings = (PaintingKind.SMALL_OIL, PaintingKind.OIL, PaintingKind.TORTURE)
    return WALL_MM if kind in paintings else -300.0


def _projector(settings: SimulationSettings, distance: float) -> SimulatedLens:
    """By default a lens-shifted projector that lights the camera's field and a quarter more."""
    x, y, z = (0.38 * distance, 0.055 * distance, 0.95 * distance)
    width = settings.projector_width
    reach = math.hypot(x, y, z)
    return SimulatedLens.looking_at(
        width=width,
        height=settings.projector_height,
        focal_px=settings.projector_focal_px or width * reach / (1.25 * distance * _FIELD),
        position=settings.projector_mm or (x, y, z),
        target=(0.0, 0.0, 0.0),
        distortion=settings.projector_distortion,
        centre_shift=(0.007 * width, 0.07 * settings.projector_height),
        vignetting=settings.vignetting,
    )


def _arm(errors: ArmErrors, distance: float) -> ArmKinematics:
    return ArmKinematics(
        centre=errors.centre_mm,
        radius=errors.radius_mm or 1.3 * distance,
        ring_tilt=(math.radians(errors.ring_tilt_deg[0]), math.radians(errors.ring_tilt_deg[1])),
        arc_lean=math.radians(errors.arc_lean_deg),
        azimuth_zero=math.radians(errors.azimuth_zero_deg),
        elevation_zero=math.radians(errors.elevation_zero_deg),
        sag=math.radians(errors.sag_deg),
    )
