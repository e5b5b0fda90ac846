"""The demo's recordings: a calibration board, the light arm's targets, a scan, and photographs.

Everything goes through the rig's devices into sessions, as a real capture does; nothing of the
simulated truth does. The frames are dated by their exposures alone, so that two recordings with one
seed are the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.plan import Plan
from acquisition.recorded_frames import open_for_replay, recording_of
from acquisition.recording import record_plan
from acquisition.scan import plan_scan
from acquisition.session_writer import SessionWriter
from calibration.boards import CharucoBoard
from devices.bayer import BayerPattern
from devices.deadline import Deadline
from devices.interfaces import Camera, CameraCapabilities, Frame
from devices.replay import replay_rig
from devices.rig import Rig
from devices.simulated.arm_targets import place_arm_targets
from devices.simulated.board import BoardPattern, make_board
from devices.simulated.rig import SimulatedRig, demo_rig
from devices.simulated.scene_objects import PlacedSurface, Wall
from devices.simulated.sensor import Sensor
from fitting.reflectance.clusters import ClusterOptions
from workstation.demonstration import EXPOSURE_S

BOARD_FOLDER = "board"
LIGHTS_SESSION = "lights"
SCAN_SESSION = "scan"
PHOTOGRAPHS_SESSION = "photographs"
MOSAIC = BayerPattern.RGGB
SPHERE_MM = 16.0

# Of the board: tilts and turn (rad), and where its middle is (mm).
_POSES = (
    (0.35, 0.0, 0.1, 15, 10, 10),
    (-0.35, 0.0, -0.1, -15, -10, 0),
    (0.0, 0.4, 0.0, -12, 12, 10),
    (0.0, -0.25, 0.15, 15, -10, -15),
    (0.3, 0.3, 0.05, 0, 0, -15),
    (-0.3, 0.25, -0.1, -18, 15, 12),
    (0.25, -0.3, 0.2, 18, 12, 5),
    (-0.2, -0.35, -0.15, 10, -15, -5),
)
_PATTERN = BoardPattern(squares=(15, 11), square_mm=8.0, marker_mm=6.0, margin_mm=6.0)
# The board as calibration has it; its maker has measured it to a ten-thousandth.
BOARD = CharucoBoard(
    columns=14,
    rows=10,
    square_mm=8.0,
    square_sigma_mm=8e-4,
    marker_mm=6.0,
    dictionary="DICT_5X5_1000",
)
_BRACKET_S = (0.004, 0.016, 0.064)
# For dark paint, whose noise is seen before all other.
_LONGEST_S = 0.256
_LOWEST_LAMP = math.radians(20)
# A board is held well before the wall.
_BEHIND_BOARD_MM = -120.0
# Not whole periods of the code behind the white target, which decoding takes for wrong orders.
_BEHIND_SPHERES_MM, _WHITE_WALL = -52.0, 0.9
# Some day, from which the demo's frames are dated.
_EPOCH_S = 1_190_000_000.0
# Less than the camera sees, so that the spheres are seen whole.
_FIELD_MM = (190.0, 140.0)


class DemoSize(StrEnum):
    """How large the demo is."""

    USUAL = "usual"
    TINY = "tiny"


@dataclass(frozen=True, kw_only=True)
class DemoCapture:
    """What the demo records.

    Attributes
    ----------
    camera_width : int
    places : tuple of str
        Of the camera, for photographs.
    lamp_poses : int
    exposures_s : tuple of float
        Of each photograph of the painting.
    clusters : ClusterOptions
        How materials are looked for: a tiny canvas has few texels to look at.
    render_px : (int, int)
        Width and height of a view.
    calibrates : bool
        Whether a board and the light arm's targets are recorded; otherwise the rig is taken to be
        as the simulation declares it.
    """

    camera_width: int
    places: tuple[str, ...]
    lamp_poses: int
    clusters: ClusterOptions
    render_px: tuple[int, int]
    calibrates: bool
    exposures_s: tuple[float, ...] = _BRACKET_S

    @classmethod
    def of(cls, size: DemoSize) -> DemoCapture:
        """The demo of a size."""
        if size is DemoSize.TINY:
            return cls(
                camera_width=160,
                places=("front", "left"),
                lamp_poses=8,
                clusters=ClusterOptions(most=1, survey=200, per_material=60),
                render_px=(240, 180),
                calibrates=False,
            )
        return cls(
            camera_width=640,
            places=("front", "left", "above"),
            lamp_poses=16,
            exposures_s=(*_BRACKET_S, _LONGEST_S),
            clusters=ClusterOptions(),
            render_px=(800, 600),
            calibrates=True,
        )

    def rig(self, *, seed: int) -> SimulatedRig:
        """The simulated rig before its painting."""
        sensor = Sensor(bits=12, bayer=MOSAIC)
        return demo_rig(seed=seed, camera_width=self.camera_width, sensor=sensor)


def photograph_choices(
    places: tuple[str, ...], lamp_poses: int, exposures_s: tuple[float, ...] = _BRACKET_S
) -> PhotographChoices:
    """Photographs of the simulated rig, from each place under as many lights."""
    return PhotographChoices(
        exposures_s=exposures_s,
        code_exposures_s=(EXPOSURE_S,),
        poses=lamp_poses,
        least_elevation=_LOWEST_LAMP,
        camera_positions=places,
        steps=4,
    )


class DemoRecorder:
    """Records the demo's sessions into a folder.

    Parameters
    ----------
    simulated : SimulatedRig
    capture : DemoCapture
    folder : Path
    advance : callable, optional
        Called with the id of each frame.
    """

    def __init__(
        self,
        simulated: SimulatedRig,
        capture: DemoCapture,
        folder: Path,
        *,
        advance: Callable[[str], None] = lambda frame_id: None,
    ) -> None:
        self._scene = simulated.scene
        self._painting = simulated.scene.subject, simulated.scene.background
        self._first_place = simulated.scene.position
        self._capture = capture
        self._folder = folder
        self._advance = advance
        self._rig = Rig(
            _DatedCamera(simulated.camera),
            simulated.projector,
            simulated.arm,
            simulated.mount,
            source="simulation",
        )

    def record_board(self) -> None:
        """Scan the board at each of its poses, and put the painting back."""
        board = PlacedSurface(make_board(_PATTERN))
        self._scene.replace_subject(board, background=(Wall(_BEHIND_BOARD_MM),))
        (self._folder / BOARD_FOLDER).mkdir()
        plan = plan_scan(self._rig, exposure_s=EXPOSURE_S, steps=4)
        for number, pose in enumerate(_POSES, start=1):
            self._scene.move_subject(np.array(pose, np.float64))
            self._record(f"{BOARD_FOLDER}/pose-{number}", plan)
        self._restore()

    def record_lights(self) -> None:
        """Photograph mirror spheres and a white target, and put the painting back."""
        plate, (*spheres, _) = place_arm_targets(*_FIELD_MM, sphere_mm=SPHERE_MM)
        wall = Wall(_BEHIND_SPHERES_MM, albedo=_WHITE_WALL)
        self._scene.replace_subject(plate, background=(*spheres, wall))
        places = self._capture.places[:1]
        choices = photograph_choices(places, self._capture.lamp_poses)
        self._record(LIGHTS_SESSION, plan_photographs(self._rig, choices))
        self._restore()

    def record_scan(self, calibration: Path) -> None:
        """Scan the painting, with a calibration of the rig."""
        plan = plan_scan(self._rig, exposure_s=EXPOSURE_S)
        self._record(SCAN_SESSION, plan, calibration=calibration)

    def record_photographs(self) -> None:
        """Photograph the painting from each place under each light."""
        of = self._capture
        choices = photograph_choices(of.places, of.lamp_poses, of.exposures_s)
        self._record(PHOTOGRAPHS_SESSION, plan_photographs(self._rig, choices))
        self._restore()

    def _restore(self) -> None:
        painting, background = self._painting
        self._scene.replace_subject(painting, background=background)
        self._scene.place_camera(self._first_place)

    def _record(self, name: str, plan: Plan, *, calibration: Path | None = None) -> None:
        with SessionWriter.create(self._folder / name, plan, calibration=calibration) as writer:
            record_plan(writer, self._rig, advance=self._advance)


def sessions_of(folder: Path) -> list[Path]:
    """The demo's sessions in a folder, the board's first."""
    boards = sorted((folder / BOARD_FOLDER).glob("*"))
    others = (folder / name for name in (LIGHTS_SESSION, SCAN_SESSION, PHOTOGRAPHS_SESSION))
    return [*boards, *(path for path in others if path.is_dir())]


def replay_sessions(folder: Path, out: Path) -> None:
    """Record the demo's sessions again, with devices that answer from their frames."""
    for path in sessions_of(folder):
        source = open_for_replay(path)
        again = out / path.relative_to(folder)
        again.parent.mkdir(parents=True, exist_ok=True)
        with (
            replay_rig(recording_of(source)) as rig,
            SessionWriter.create(again, source.plan, calibration=source.calibration_folder) as to,
        ):
            record_plan(to, rig, wait=lambda seconds: None)


class _DatedCamera:
    """A camera whose frames are dated by their exposures, one after the other."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._wall_time = _EPOCH_S

    @property
    def capabilities(self) -> CameraCapabilities:
        """Those of the camera."""
        return self._camera.capabilities

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        """Take one frame."""
        frame = self._camera.capture(exposure_s, deadline=deadline)
        self._wall_time += frame.exposure_applied_s or exposure_s
        return replace(frame, wall_time=self._wall_time)

    def close(self) -> None:
        """Release the camera."""
        self._camera.close()
