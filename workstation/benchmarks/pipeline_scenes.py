"""Recorded simulated paintings for the study of the whole pipeline, and how they are judged."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from acquisition.duration import estimate_duration
from acquisition.photograph_plan import plan_photographs
from acquisition.plan import Metering, Plan
from acquisition.recording import record_plan
from acquisition.scan import plan_scan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from calibration.lens import compose, transform
from calibration.registration import register_photographs
from devices.rig import Rig
from devices.simulated.rig import SimulatedRig, demo_rig
from devices.simulated.scene_objects import PlacedSurface
from devices.simulated.sensor import Sensor
from devices.simulated.settings import PaintingKind, SimulationSettings
from devices.simulated.surface import Surface
from devices.simulated.truth import truth_of
from fitting.digital_copy import DigitalCopy
from fitting.reflectance.held_out import compare_held_out, pooled_psnr_db
from fitting.reflectance.lamp_table import LampTable
from fitting.reflectance.recorded_photographs import read_photographs
from fitting.reflectance.terrain import Terrain
from workstation.benchmarks.copies_of_known_shape import dime_heights
from workstation.demo_recording import MOSAIC, photograph_choices
from workstation.demo_truth import declared_lamps
from workstation.demonstration import EXPOSURE_S, rt_true_camera, true_geometry
from workstation.processing import (
    REFLECTANCE,
    Processed,
    ProcessingOptions,
    add_photographs,
    process_session,
)
from workstation.quality_curve import CurvePoint
from workstation.reflectance_processing import surroundings_of
from workstation.stage_cache import StageCache, StageRun

DIME = "dime"
PAINTINGS = (*map(str, (PaintingKind.SMALL_OIL, PaintingKind.OIL, PaintingKind.TORTURE)), DIME)
_DESCRIPTIONS = {
    PAINTINGS[0]: "the simulated oil sketch",
    PAINTINGS[1]: "the simulated oil painting",
    PAINTINGS[2]: "the simulated torture piece",
    DIME: "a coin's measured relief, enlarged",
}
_PLACES = ("front", "left")
# Lamps of the photographs that no setting sees.
_JUDGES = 7
_GRID = 500
_RIM = 0.03
# The coin of 19 mm is given the size of a painting.
_DIME_ENLARGED = 16.0
_DIME_ALBEDO, _DIME_ROUGHNESS = 0.5, 0.4


@dataclass(frozen=True, kw_only=True)
class Capture:
    """What is recorded of a painting.

    Attributes
    ----------
    steps : int
        Of the scan's fringes.
    exposures_s : tuple of float
        Of the scan.
    metering : Metering or None
        By which frames of the scan that no pixel needs are left out; None leaves none out.
    lamp_poses : int
        From each place of the camera.
    adaptive : bool
        Whether exposures of photographs that no pixel needs are left out.
    """

    steps: int = 8
    exposures_s: tuple[float, ...] = (EXPOSURE_S,)
    metering: Metering | None = None
    lamp_poses: int = 10
    adaptive: bool = True


@dataclass
class RecordedScene:
    """A simulated painting whose recordings are made when they are first asked for.

    Attributes
    ----------
    name : str
        Of :data:`PAINTINGS`.
    rig : SimulatedRig
    folder : Path
    """

    name: str
    rig: SimulatedRig
    folder: Path
    _judges: Path | None = field(default=None)

    @classmethod
    def of(cls, painting: str, folder: Path, *, width: int) -> RecordedScene:
        """One of the paintings; the coin takes the folder of real captures."""
        folder.mkdir()
        if painting == PaintingKind.SMALL_OIL:
            rig = demo_rig(camera_width=width, sensor=Sensor(bits=12, bayer=MOSAIC))
        else:
            kind = PaintingKind.WHITE if painting == DIME else PaintingKind(painting)
            settings = SimulationSettings(painting=kind, camera_width=width, bits=12, bayer=MOSAIC)
            rig = settings.build()
        if painting == DIME:
            rig.scene.replace_subject(PlacedSurface(_dime()))
        true_geometry(rig).save(folder / "rig")
        return cls(painting, rig, folder)

    @staticmethod
    def has_dime() -> bool:
        """Whether the coin's heights are there."""
        return bool(os.environ.get("IMPASTO_REAL_DATA"))

    @property
    def description(self) -> str:
        """What is digitised, with how many pixels."""
        lens = self.rig.camera_lens
        return f"{_DESCRIPTIONS[self.name]}, {lens.width} × {lens.height} pixels"

    def process(
        self,
        capture: Capture,
        options: ProcessingOptions,
        *,
        stages: StageCache | None = None,
    ) -> Processed:
        """Process what a capture records."""
        scan, photographs = self._scan(capture), self._photographs(capture)
        lamps = self._lamps(photographs)
        done = process_session(scan, options=options, stages=stages)
        return add_photographs(done, photographs, lamps)

    def measure(
        self,
        capture: Capture,
        options: ProcessingOptions,
        *,
        curve: str,
        name: str,
        default: bool,
    ) -> CurvePoint:
        """Process what a capture records, and judge the copy."""
        sessions = self._scan(capture), self._photographs(capture)
        began: dict[str, float] = {}
        took: dict[str, float] = {}

        def begin(stage: str) -> None:
            began.setdefault(stage, time.process_time())

        def ended(run: StageRun) -> None:
            took[run.name] = time.process_time() - began[run.name]

        started = time.process_time()
        done = self.process(capture, options, stages=StageCache(None, begin, done=ended))
        copy = done.copy
        return CurvePoint(
            curve,
            name,
            seconds=time.process_time() - started,
            fit_seconds=took[REFLECTANCE],
            recording_s=sum(self._recording_s(path) for path in sessions),
            height_mm=self._height_error(copy),
            heldout_db=self.judged(done, copy),
            texels=int(copy.height_field.mask.sum()),
            frames=sum(len(Session.open(path).frames) for path in sessions),
            default=default,
        )

    def judged(self, done: Processed, copy: DigitalCopy) -> float:
        """PSNR of photographs that are nobody's, registered to the scan as any others."""
        if self._judges is None:
            self._judges = self.folder / "judges"
            self._photograph(self._judges, _JUDGES, adaptive=True)
        session = Session.open(self._judges)
        views = register_photographs(session, done.correspondence, done.rig)
        with TemporaryDirectory() as scratch:
            photographs = read_photographs(
                session,
                views,
                LampTable.load(self._lamps(self._judges)),
                copy.height_field.rt_cam_canvas,
                scratch=Path(scratch),
            )
            around = surroundings_of(copy, done.surface)
            terrain = Terrain.of(copy.height_field, surroundings=around)
            return pooled_psnr_db(compare_held_out(copy, terrain, photographs))

    def _recording_s(self, path: Path) -> float:
        """What a rig with such devices takes for the frames of a session."""
        session = Session.open(path)
        expected = estimate_duration(
            session.plan.model_copy(update={"frames": session.frames}),
            frame_period_s=self.rig.projector.capabilities.frame_period_s,
            arm=self.rig.arm.capabilities,
        )
        return expected.frames_s + expected.light_s

    def _scan(self, capture: Capture) -> Path:
        metered = "" if capture.metering is None else "-metered"
        path = self.folder / f"scan-{capture.steps}-{len(capture.exposures_s)}{metered}"
        if not path.exists():
            rig = self._open()
            plan = plan_scan(
                rig,
                exposure_s=capture.exposures_s,
                steps=capture.steps,
                metering=capture.metering,
            )
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
        choices = replace(photograph_choices(_PLACES, poses), adaptive=adaptive)
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
            declared_lamps(self.rig, photographs).save(path)
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


def _dime() -> Surface:
    """The coin's relief, as large as a painting, somewhat glossy."""
    height, pitch_mm = dime_heights(Path(os.environ["IMPASTO_REAL_DATA"]))
    rows, cols = height.shape
    pitch_mm *= _DIME_ENLARGED
    return Surface.uniform(
        height * np.float32(_DIME_ENLARGED),
        pitch_mm=pitch_mm,
        canvas_mm=((cols - 1) * pitch_mm, (rows - 1) * pitch_mm),
        albedo=_DIME_ALBEDO,
        roughness=_DIME_ROUGHNESS,
    )
