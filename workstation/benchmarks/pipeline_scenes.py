"""Recorded simulated paintings for the study of the whole pipeline, and how they are judged."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.plan import Plan
from acquisition.recording import record_plan
from acquisition.scan import plan_scan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from calibration.lens import compose, transform
from calibration.registration import register_photographs
from devices.bayer import BayerPattern
from devices.rig import Rig
from devices.simulated.rig import SimulatedRig, demo_rig
from devices.simulated.sensor import Sensor
from devices.simulated.settings import PaintingKind, SimulationSettings
from devices.simulated.truth import truth_of
from fitting.digital_copy import DigitalCopy
from fitting.reflectance.held_out import compare_held_out, pooled_psnr_db
from fitting.reflectance.lamp_table import LampTable
from fitting.reflectance.recorded_photographs import PhotographOptions, read_photographs
from fitting.reflectance.terrain import Terrain
from workstation.demo_truth import DeclaredLamps
from workstation.demonstration import rt_true_camera, true_geometry
from workstation.processing import (
    Processed,
    ProcessingOptions,
    add_photographs,
    process_session,
)

_MOSAIC = BayerPattern.RGGB
_PLACES = ("front", "left")
_LOWEST = math.radians(20)
_BRACKET_S = (0.004, 0.016, 0.064)
# Lamps of the photographs that no setting sees.
_JUDGES = 7
_GRID = 500
_RIM = 0.03


@dataclass(frozen=True, kw_only=True)
class Capture:
    """What is recorded of a painting.

    Attributes
    ----------
    steps : int
        Of the scan's fringes.
    exposures_s : tuple of float
        Of the scan.
    lamp_poses : int
        From each place of the camera.
    adaptive : bool
        Whether exposures that no pixel needs are left out.
    """

    steps: int = 8
    exposures_s: tuple[float, ...] = (0.045,)
    lamp_poses: int = 10
    adaptive: bool = True


@dataclass(frozen=True)
class Point:
    """Run time and error of a setting.

    Attributes
    ----------
    curve, name : str
        What is varied, and its value.
    seconds : float
        Of the processor.
    height_mm : float
        RMS error of heights on a grid that is the same for all.
    heldout_db : float
        PSNR of photographs that the setting does not see.
    texels : int
    frames : int
        Recorded for it.
    default : bool
    """

    curve: str
    name: str
    seconds: float
    height_mm: float
    heldout_db: float
    texels: int
    frames: int
    default: bool


@dataclass
class RecordedScene:
    """A simulated painting whose recordings are made when they are first asked for.

    Attributes
    ----------
    rig : SimulatedRig
    folder : Path
    """

    rig: SimulatedRig
    folder: Path
    _judges: Path | None = field(default=None)

    @classmethod
    def of(cls, painting: str, folder: Path, *, width: int) -> RecordedScene:
        """One of the three paintings."""
        folder.mkdir()
        kind = PaintingKind(painting)
        if kind is PaintingKind.SMALL_OIL:
            rig = demo_rig(camera_width=width, sensor=Sensor(bits=12, bayer=_MOSAIC))
        else:
            settings = SimulationSettings(painting=kind, camera_width=width, bits=12, bayer=_MOSAIC)
            rig = settings.build()
        true_geometry(rig).save(folder / "rig")
        return cls(rig, folder)

    def measure(
        self,
        capture: Capture,
        options: ProcessingOptions,
        *,
        curve: str,
        name: str,
        default: bool,
    ) -> Point:
        """Process what a capture records, and judge the copy."""
        scan, photographs = self._scan(capture), self._photographs(capture)
        lamps = self._lamps(photographs)
        chosen = _in_colour(options)
        began = time.process_time()
        done = add_photographs(process_session(scan, options=chosen), photographs, lamps)
        copy = done.copy
        seconds = time.process_time() - began
        return Point(
            curve,
            name,
            seconds,
            self._height_error(copy),
            self._judged(done),
            int(copy.height_field.mask.sum()),
            sum(len(Session.open(path).frames) for path in (scan, photographs)),
            default,
        )

    def _scan(self, capture: Capture) -> Path:
        path = self.folder / f"scan-{capture.steps}-{len(capture.exposures_s)}"
        if not path.exists():
            rig = self._open()
            plan = plan_scan(rig, exposure_s=capture.exposures_s, steps=capture.steps)
            self._record(path, rig, plan)
        return path

    def _photographs(self, capture: Capture) -> Path:
        adaptive = "" if capture.adaptive else "-all"
        path = self.folder / f"photographs-{capture.lamp_poses}{adaptive}"
        if not path.exists():
            self._photograph(path, capture.lamp_poses, adaptive=capture.adaptive)
        return path

    def _photograph(self, path: Path, poses: int, *, adaptive: bool) -> None:
        rig = self._open()
        choices = PhotographChoices(
            exposures_s=_BRACKET_S,
            code_exposures_s=(0.045,),
            poses=poses,
            least_elevation=_LOWEST,
            camera_positions=_PLACES,
            steps=4,
            adaptive=adaptive,
        )
        self._record(path, rig, plan_photographs(rig, choices))

    def _open(self) -> Rig:
        self.rig.scene.place_camera(_PLACES[0])
        return self.rig.open()

    def _record(self, path: Path, rig: Rig, plan: Plan) -> None:
        with SessionWriter.create(path, plan, calibration=self.folder / "rig") as writer:
            record_plan(writer, rig)
        self.rig.scene.place_camera(_PLACES[0])

    def _lamps(self, photographs: Path) -> Path:
        path = photographs.with_suffix(".json")
        if not path.exists():
            frames = Session.open(photographs).frames
            poses = dict.fromkeys(f.arm_pose for f in frames if f.arm_pose is not None)
            LampTable.of(DeclaredLamps(self.rig), poses).save(path)
        return path

    def _height_error(self, copy: DigitalCopy) -> float:
        """RMS on a grid over the canvas, by the surface between the texels."""
        heights = copy.height_field
        half = (1 - _RIM) * np.array(self.rig.painting.canvas_mm) / 2
        x, y = np.meshgrid(*(np.linspace(-h, h, _GRID) for h in half))
        col = ((x - heights.origin_mm[0]) / heights.pitch_mm).astype(np.float32)
        row = ((heights.origin_mm[1] - y) / heights.pitch_mm).astype(np.float32)
        filled = np.where(heights.mask, heights.height, 0).astype(np.float32)
        z = cv2.remap(filled, col, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        known = cv2.remap(
            heights.mask.astype(np.float32), col, row, cv2.INTER_LINEAR
        )  # fully measured where it is one
        inside = known > 0.999
        to_truth = compose(rt_true_camera(self.rig), heights.rt_cam_canvas)
        points = transform(to_truth, np.stack([x, y, z], axis=-1)[inside].astype(np.float64))
        off = points[:, 2] - truth_of(self.rig.scene).height_at(points[:, 0], points[:, 1])
        return float(np.sqrt(np.mean(off**2)))

    def _judged(self, done: Processed) -> float:
        """PSNR of photographs that are nobody's, registered to the scan as any others."""
        if self._judges is None:
            self._judges = self.folder / "judges"
            self._photograph(self._judges, _JUDGES, adaptive=True)
        session = Session.open(self._judges)
        views = register_photographs(session, done.correspondence, done.rig)
        copy = done.copy
        with TemporaryDirectory() as scratch:
            photographs = read_photographs(
                session,
                views,
                LampTable.load(self._lamps(self._judges)),
                copy.height_field.rt_cam_canvas,
                scratch=Path(scratch),
                options=PhotographOptions(mosaic=_MOSAIC),
            )
            terrain = Terrain.of(copy.height_field)
            return pooled_psnr_db(compare_held_out(copy, terrain, photographs))


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Points that no other beats in time and in both errors, the quickest first."""
    return [
        one
        for one in sorted(points, key=lambda point: point.seconds)
        if not any(
            o.seconds <= one.seconds
            and o.height_mm <= one.height_mm
            and o.heldout_db >= one.heldout_db
            and o is not one
            for o in points
        )
    ]


def _in_colour(options: ProcessingOptions) -> ProcessingOptions:
    return replace(options, photographs=PhotographOptions(mosaic=_MOSAIC))
