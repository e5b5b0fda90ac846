"""A run of ``impasto calibrate``: the rig from poses of a board, then the light arm, then the page.

A light arm that is refused, or whose photographs are of no use, takes nothing from a rig that
passed: that is kept, and what is wrong with the lights is said at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.atomic_files import folder_in_progress
from calibration.boards import Chessboard
from calibration.errors import CalibrationError, CalibrationRefusedError
from calibration.gates import KnownDistance
from calibration.procam import ProcamOptions
from calibration.rig_geometry import RigGeometry
from devices.errors import ImpastoError
from workstation.board_poses import find_sessions, measure_poses
from workstation.calibration_extras import Extras, with_lights
from workstation.calibration_figures import FIGURES_FILE, calibration_figures
from workstation.calibration_report import write_light_report, write_report
from workstation.json_output import write_json
from workstation.light_calibration import CalibratedLights
from workstation.progress import progress
from workstation.rig_calibration import CalibratedRig, calibrate_rig


@dataclass(frozen=True, kw_only=True)
class RigAsked:
    """A rig that is to be calibrated, as the command line names it.

    Attributes
    ----------
    sessions : sequence of Path
        One pose of the board each, or folders of such.
    board : Chessboard
    options : ProcamOptions
    compensate_phases : bool
    held_out : int
        Poses to be held out, one by one, and reconstructed.
    baseline_mm : (float, float) or None
        Measured by hand, and its standard error.
    earlier : tuple of Path
        Earlier calibrations, the latest first.
    """

    sessions: Sequence[Path]
    board: Chessboard
    options: ProcamOptions
    compensate_phases: bool
    held_out: int
    baseline_mm: tuple[float, float] | None
    earlier: tuple[Path, ...]

    def distances(self, rig: RigGeometry) -> list[KnownDistance]:
        """The baseline as the rig has it, and as it was measured; empty if it was not."""
        if self.baseline_mm is None:
            return []
        return [KnownDistance(float(np.linalg.norm(rig.rt_proj_cam[3:])), *self.baseline_mm)]


@dataclass(frozen=True)
class CalibrationOutcome:
    """What a run found.

    Attributes
    ----------
    rig : CalibratedRig
    lights : CalibratedLights or None
        None if they were not asked for, the rig was refused, or they failed.
    light_error : ImpastoError or None
        Why the lights could not be calibrated at all.
    figures : dict
    """

    rig: CalibratedRig
    lights: CalibratedLights | None
    light_error: ImpastoError | None
    figures: dict[str, Any]

    def save(self, folder: Path, extras: Extras, *, replace: bool) -> None:
        """Write what passed into a new folder: the rig, and the lights if they did as well.

        Raises
        ------
        CalibrationRefusedError
            The rig was refused.
        """
        self.rig.gates.refuse()
        with folder_in_progress(folder, replace=replace) as inside:
            self.rig.calibration.save(inside)
            if self.lights is not None and self.lights.gates.passed and extras.lights is not None:
                extras.lights.write(self.lights, inside)
            write_json(inside / FIGURES_FILE, self.figures)

    def refuse(self, out: Path | None) -> None:
        """Refuse what failed; lights that did say where the rig is kept.

        Parameters
        ----------
        out : Path or None
            Where the rig was written.

        Raises
        ------
        CalibrationRefusedError
            The rig or the lights failed a gate.
        ImpastoError
            The lights could not be calibrated at all.
        """
        self.rig.gates.refuse()
        kept = "camera and projector passed"
        if out is not None:
            kept += (
                f" and are kept in {out}; when this is mended calibrate the lights alone, "
                f"with --rig {out}"
            )
        if self.light_error is not None:
            raise type(self.light_error)(f"{self.light_error} ({kept})") from self.light_error
        if self.lights is not None:
            try:
                self.lights.gates.refuse()
            except CalibrationRefusedError as refused:
                raise CalibrationRefusedError(f"light arm: {refused} ({kept})") from refused


def run_calibration(asked: RigAsked, extras: Extras, *, report: Path | None) -> CalibrationOutcome:
    """Calibrate a rig, and the lights if they are asked for and the rig passes its gates.

    Parameters
    ----------
    asked : RigAsked
    extras : Extras
    report : Path or None
        Folder of the page.

    Raises
    ------
    CalibrationError
        The rig cannot be calibrated.
    SessionError
        A session of the board is damaged.
    """
    # The shortest first: what is wrong with it shall not come after minutes of calibration.
    radiometry = extras.radiometry()
    found = find_sessions(asked.sessions)
    # One for each pose, and what follows: solving, validating, propagating; perhaps the surface.
    total = len(found) + 3 + asked.options.board_shape + (report is not None)
    with progress("calibrating", total=total + (3 if extras.lights is not None else 0)) as steps:

        def begin(stage: str) -> None:
            steps.advance()
            steps.begin(stage)

        poses = measure_poses(
            found,
            asked.board,
            compensate_phases=asked.compensate_phases,
            surface=asked.options.board_shape,
            begin=begin,
        )
        rig = calibrate_rig(
            poses,
            options=asked.options,
            distances=asked.distances,
            earlier=asked.earlier,
            held_out=asked.held_out,
            begin=begin,
        )
        figures = calibration_figures(rig)
        lights, error = None, None
        if extras.lights is not None and rig.gates.passed:
            try:
                lights = extras.lights.calibrate(rig.calibration.rig, begin=begin)
                figures |= {"light_arm": lights.figures()}
            except ImpastoError as failed:
                error = failed
                figures |= {"light_arm_error": str(failed)}
        if report is not None:
            begin("writing the report")
            write_report(
                rig,
                report,
                sections=radiometry if lights is None else with_lights(radiometry, lights),
                figures=figures,
                light_gates=None if lights is None else lights.gates,
            )
    return CalibrationOutcome(rig, lights, error, figures)


def run_light_calibration(rig: Path, extras: Extras, *, report: Path | None) -> CalibratedLights:
    """Calibrate lights alone, by a rig that is calibrated.

    Parameters
    ----------
    rig : Path
        Its folder.
    extras : Extras
    report : Path or None
        Folder of the page.

    Raises
    ------
    CalibrationError
        No lights are asked for, or they cannot be calibrated.
    """
    if extras.lights is None:
        raise CalibrationError("no photographs of spheres to calibrate lights from are named")
    radiometry = extras.radiometry()
    with progress("calibrating the lights", total=4) as steps:

        def begin(stage: str) -> None:
            steps.advance()
            steps.begin(stage)

        lights = extras.lights.calibrate(RigGeometry.load(rig), begin=begin)
        if report is not None:
            write_light_report(lights, with_lights(radiometry, lights), report)
    return lights
