"""Good files of every kind that Impasto reads, small, and how each is read."""

from __future__ import annotations

import hashlib
import json
import pickle
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from acquisition.capture_description import Channel, read_description
from acquisition.errors import SessionError
from acquisition.foreign_capture import find_capture, read_picture, record_capture
from acquisition.journal import AnyEvent, FrameRecorded, append_event, read_journal
from acquisition.light_poses import spread_poses
from acquisition.session import JOURNAL_FILE, MANIFEST_FILE, Session, manifest_text
from calibration.arm_files import ARM_FILE, load_light_arm, save_light_arm
from calibration.arm_geometry import ArmParameters
from calibration.light_arm import LightArm
from calibration.opencv_files import read_rig_geometry
from calibration.rig_geometry import RigGeometry
from devices.interfaces import ArmPose
from devices.rig_file import read_rig_file
from devices.simulated.rig import demo_rig
from fitting.copy_files import read_copy, write_copy
from fitting.digital_copy import DigitalCopy, ReflectanceMaps
from fitting.reflectance.lamp_table import LampTable
from fitting.reflectance.light_only import read_light_only
from workstation.benchmarks.foreign_captures import (
    CALIBRATION_FILE,
    CAPTURE_FILE,
    DOME_FILE,
    write_capture,
    write_dome,
    write_pictures,
)
from workstation.benchmarks.fuzzing import Target, fingerprint
from workstation.demo_truth import DeclaredLamps
from workstation.demonstration import record_simulated_scan
from workstation.processing import process_session
from workstation.result_files import read_result, write_result
from workstation.stage_cache import StageCache

_CAMERA_WIDTH = 96
_RIG_FILE = "rig.toml"
_LAMPS_FILE, _LAMPS = "lamps.json", 4
_RESULT_FILE = "result.npz"
_DIGEST_FILE = "result.sha256"
_STAGES = "stages"
_RIG = """
[camera]
driver = "simulated"

[projector]
driver = "dlpc350"
source = "video"

[projector.screen]
driver = "hdmi"
screen = "HDMI-1"
width = 912
height = 1140
latency_s = 0.05

[arm]
driver = "grbl"
port = "/dev/ttyUSB0"
azimuth_deg = [0, 350]
elevation_deg = [15, 85]
lamp = "spindle"
lamp_settle_s = 0.5

[mount]
driver = "manual"
positions = ["front", "left", "right"]

[simulation]
painting = "oil"
seed = 3
camera_width = 96
"""
TARGETS = (
    "session as recorded",
    "session resealed",
    "rig.toml",
    "capture.toml",
    "pictures of many formats",
    "camera models",
    "OpenCV calibration",
    "copy",
    "table of lamps",
    "light arm",
    "pictures under lights",
    "stored result",
    "results of stages",
)


def make_targets(place: Path) -> tuple[Target, ...]:
    """Write good files of every kind below a folder.

    Parameters
    ----------
    place : Path
        An empty folder.

    Returns
    -------
    tuple of Target
    """
    session = place / "session"
    rig = demo_rig(camera_width=_CAMERA_WIDTH)
    record_simulated_scan(rig, session)
    copy = process_session(session).copy
    write_copy(replace(copy, reflectance=_reflectance(copy)), place / "copy")
    write_capture(place / "capture", width=24, height=18)
    write_pictures(place / "pictures")
    (place / "rig").mkdir()
    (place / "rig" / _RIG_FILE).write_text(_RIG)
    (place / "lamps").mkdir()
    poses = spread_poses(rig.arm.capabilities.limits, _LAMPS)
    LampTable.of(DeclaredLamps(rig), poses).save(place / "lamps" / _LAMPS_FILE)
    (place / "arm").mkdir()
    save_light_arm(_small_arm(poses), place / "arm" / ARM_FILE)
    write_dome(place / "dome", lights=6, width=16, height=12)
    (place / "stored").mkdir()
    digest = write_result(copy.height_field, place / "stored" / _RESULT_FILE)
    (place / "stored" / _DIGEST_FILE).write_text(digest)
    shutil.copytree(session, place / "stages" / "session")
    _read_stages(place / "stages")
    return (
        Target("session as recorded", session, _read_session, sealed=True),
        Target("session resealed", session, _process_session, mend=reseal),
        Target("rig.toml", place / "rig", _read_rig),
        Target("capture.toml", place / "capture", _import_capture),
        Target("pictures of many formats", place / "pictures", _read_pictures),
        Target(
            "camera models",
            session,
            _read_models,
            files=("calibration/*",),
        ),
        Target("OpenCV calibration", place / "capture", _read_opencv, files=(CALIBRATION_FILE,)),
        Target("copy", place / "copy", _read_copy),
        Target("table of lamps", place / "lamps", _read_lamps),
        Target("light arm", place / "arm", _read_arm),
        Target("pictures under lights", place / "dome", _read_dome),
        Target("stored result", place / "stored", _read_stored),
        Target(
            "results of stages",
            place / "stages",
            _read_stages,
            files=(f"{_STAGES}/**/*",),
            sealed=True,
        ),
    )


def reseal(folder: Path) -> None:
    """Write journal and manifest of a damaged session anew, so that its checksums fit."""
    journal = folder / JOURNAL_FILE
    try:
        events = read_journal(journal)
    except SessionError:
        events = _bare_events(journal)
    journal.unlink(missing_ok=True)
    written: list[AnyEvent] = []
    for event in events:
        if isinstance(event, FrameRecorded) and (folder / event.file).is_file():
            content = (folder / event.file).read_bytes()
            event = event.model_copy(update={"sha256": hashlib.sha256(content).hexdigest()})
        append_event(journal, event)
        written.append(event)
    recorded = [event for event in written if isinstance(event, FrameRecorded)]
    (folder / MANIFEST_FILE).write_text(manifest_text(folder, recorded))


def _bare_events(journal: Path) -> list[AnyEvent]:
    """Events of a journal whose seals do not fit, those left out that are none."""
    if not journal.is_file():
        return []
    bare = re.sub(rb',"seal":"[0-9a-f]{8}"\}', b"}", journal.read_bytes())
    events: list[AnyEvent] = []
    line_file = journal.with_suffix(".line")
    for line in bare.splitlines():
        line_file.write_bytes(line + b"\n")
        try:
            events += read_journal(line_file)
        except SessionError:
            continue
    line_file.unlink(missing_ok=True)
    return events


def _read_session(folder: Path) -> bytes:
    session = Session.open(folder)
    frames = [session.read_frame(frame.id).tobytes() for frame in session.frames]
    events = [event.model_dump_json().encode() for event in session.recorded.values()]
    models = [_read_models(folder)] if session.calibration_folder else []
    return fingerprint(session.plan.model_dump_json().encode(), *events, *frames, *models)


def _process_session(folder: Path) -> bytes:
    return _of_copy(process_session(folder).copy)


def _read_models(folder: Path) -> bytes:
    rig = RigGeometry.load(folder / "calibration")
    covariance = b"" if rig.covariance is None else rig.covariance.tobytes()
    sizes = [rig.camera.width, rig.camera.height, rig.projector.width, rig.projector.height]
    models = f"{rig.camera.model} {rig.projector.model} {sizes}".encode()
    return fingerprint(rig.parameters.tobytes(), covariance, models)


def _read_rig(folder: Path) -> bytes:
    rig = read_rig_file(folder / _RIG_FILE)
    settings = {str(kind): device.model_dump() for kind, device in rig.devices.items()}
    return fingerprint(repr(settings).encode(), repr(rig.simulation).encode())


def _import_capture(folder: Path) -> bytes:
    description = read_description(folder / CAPTURE_FILE)
    capture = find_capture(folder, description)
    out = folder.parent / "imported"
    shutil.rmtree(out, ignore_errors=True)
    try:
        record_capture(capture, out)
        session = Session.open(out)
        frames = [session.read_frame(frame.id).tobytes() for frame in session.frames]
        return fingerprint(session.plan.model_dump_json().encode(), *frames)
    finally:
        shutil.rmtree(out, ignore_errors=True)


def _read_pictures(folder: Path) -> bytes:
    pictures = (read_picture(file, channel=Channel.MEAN) for file in sorted(folder.iterdir()))
    return fingerprint(*(np.ascontiguousarray(picture).tobytes() for picture in pictures))


def _read_opencv(folder: Path) -> bytes:
    description = read_description(folder / CAPTURE_FILE)
    assert description.calibration is not None
    rig = read_rig_geometry(
        folder / description.calibration.file,
        description.calibration,
        camera=description.camera,
        projector=description.projector,
    )
    return fingerprint(rig.parameters.tobytes())


def _read_copy(folder: Path) -> bytes:
    return _of_copy(read_copy(folder))


def _of_copy(copy: DigitalCopy) -> bytes:
    """Fingerprint of a copy; what is measured in it must be finite."""
    heights = copy.height_field
    arrays = [np.where(heights.mask, heights.height, 0), copy.normal_xy[heights.mask]]
    if copy.reflectance is not None:
        maps = copy.reflectance
        arrays += [m[heights.mask] for m in (maps.diffuse, maps.specular, maps.lobe)]
    if not all(np.isfinite(array).all() for array in arrays):
        raise AssertionError("a copy was read that is not finite where it was measured")
    arrays.append(heights.mask)
    return fingerprint(
        *(np.ascontiguousarray(array).tobytes() for array in arrays),
        repr((heights.pitch_mm, heights.origin_mm, copy.relief.delta0_mm)).encode(),
        json.dumps(copy.relief.boxes.corner.tolist()).encode(),
    )


def _read_lamps(folder: Path) -> bytes:
    table = LampTable.load(folder / _LAMPS_FILE)
    lamps = [np.concatenate([one.position, one.axis, one.intensity]) for one in table.lamps]
    poses = repr([(pose.azimuth, pose.elevation) for pose in table.poses])
    exponents = repr([one.exponent for one in table.lamps])
    return fingerprint(np.array(lamps).tobytes(), poses.encode(), exponents.encode())


def _read_arm(folder: Path) -> bytes:
    arm = load_light_arm(folder / ARM_FILE)
    lamp = arm.lamp(arm.poses[0])
    numbers = np.concatenate([lamp.position, lamp.axis, lamp.intensity, arm.covariance.ravel()])
    rest = repr((arm.poses, arm.residual_deg.tolist(), arm.suspect, arm.inflation))
    return fingerprint(numbers.tobytes(), rest.encode(), repr(arm.shading_excess).encode())


def _small_arm(poses: Sequence[ArmPose]) -> LightArm:
    """An arm as if it had been calibrated."""
    parameters = ArmParameters(
        rt_rig_ring=np.array([0.1, 3.0, 0.05, 5.0, -8.0, 900.0]),
        radius_mm=1100.0,
        elevation_zero=0.01,
        lean=-0.005,
        sag=0.002,
        aim=np.array([3.0, -2.0, 1.0]),
        intensity=np.array([3e6, 2.9e6, 2.5e6]),
        exponent=6.0,
    )
    covariance = 1e-6 * np.eye(len(parameters.as_array()))
    residuals = np.linspace(0.01, 0.03, len(poses))
    return LightArm(parameters, covariance, tuple(poses), residuals, (1,), 1.0, 1.2)


def _read_dome(folder: Path) -> bytes:
    copy, photographs = read_light_only(folder / DOME_FILE)
    pictures = [np.ascontiguousarray(one.radiance).tobytes() for one in photographs]
    return fingerprint(repr(copy.height_field.shape).encode(), *pictures)


def _read_stored(folder: Path) -> bytes:
    noted = folder / _DIGEST_FILE
    digest = noted.read_text(errors="replace") if noted.is_file() else ""
    return fingerprint(pickle.dumps(read_result(folder / _RESULT_FILE, digest)))


def _read_stages(folder: Path) -> bytes:
    """Process with the results of stages that there are, and store those that are missing."""
    (folder / _STAGES).mkdir(exist_ok=True)
    return _of_copy(process_session(folder / "session", stages=StageCache(folder / _STAGES)).copy)


def _reflectance(copy: DigitalCopy) -> ReflectanceMaps:
    shape = copy.height_field.shape
    lobe = np.broadcast_to(np.array([-1.0, -1.0, 1.1, 20.0], np.float32), (*shape, 4))
    diffuse = np.full((*shape, 3), 0.2, np.float32)
    return ReflectanceMaps(diffuse, np.full((*shape, 3), 0.1, np.float32), lobe.copy())
