"""The demo's recordings become a calibrated rig, a table of lamps, and a digital copy.

These are the steps of ``impasto calibrate`` and ``impasto process``, on sessions that may have been
recorded by the simulated rig or replayed.
"""

from __future__ import annotations

from pathlib import Path

from acquisition.session import Session
from calibration.procam import ProcamOptions
from devices.simulated.arm_targets import white_reflectance
from fitting.reflectance.maps import MapOptions
from workstation.board_poses import find_sessions, measure_poses
from workstation.demo_recording import (
    BOARD,
    BOARD_FOLDER,
    LIGHTS_SESSION,
    PHOTOGRAPHS_SESSION,
    SCAN_SESSION,
    SPHERE_MM,
    DemoCapture,
)
from workstation.light_calibration import CalibratedLights, LightOptions, calibrate_lights
from workstation.processing import (
    Processed,
    ProcessingOptions,
    add_photographs,
    process_session,
)
from workstation.reflectance_processing import ReflectanceOptions
from workstation.rig_calibration import CalibratedRig, calibrate_rig
from workstation.stage_cache import StageCache

RIG_FOLDER = "rig"
LAMPS_FILE = "lamps.json"
_MODEL = "LENSMODEL_OPENCV5"


def calibrate_from_board(sessions: Path, out: Path) -> CalibratedRig:
    """Calibrate camera and projector from the board's poses, and write the calibration."""
    poses = measure_poses(find_sessions([sessions / BOARD_FOLDER]), BOARD)
    done = calibrate_rig(poses, options=ProcamOptions(models=(_MODEL,)))
    done.calibration.save(out / RIG_FOLDER)
    return done


def calibrate_arm(sessions: Path, done: CalibratedRig, out: Path) -> CalibratedLights:
    """Calibrate the light arm, and write the table of its lamps."""
    options = LightOptions(
        sphere_mm=SPHERE_MM,
        albedo=white_reflectance(),
    )
    rig = done.calibration.rig_with_covariance()
    lights = calibrate_lights(rig, sessions / LIGHTS_SESSION, options=options)
    photographs = Session.open(sessions / PHOTOGRAPHS_SESSION)
    poses = [frame.arm_pose for frame in photographs.frames if frame.arm_pose is not None]
    lights.table(poses).save(out / LAMPS_FILE)
    return lights


def process_demo(
    sessions: Path, calibrated: Path, capture: DemoCapture, stages: StageCache
) -> Processed:
    """Make the copy of the recorded painting.

    Parameters
    ----------
    sessions : Path
        Folder of the demo's sessions.
    calibrated : Path
        Where :func:`calibrate_from_board` and :func:`calibrate_arm` wrote.
    capture : DemoCapture
    stages : StageCache
    """
    options = ProcessingOptions(
        reflectance=ReflectanceOptions(maps=MapOptions(clusters=capture.clusters)),
    )
    done = process_session(sessions / SCAN_SESSION, options=options, stages=stages)
    return add_photographs(done, sessions / PHOTOGRAPHS_SESSION, calibrated / LAMPS_FILE)
