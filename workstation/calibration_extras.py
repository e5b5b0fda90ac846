"""What ``impasto calibrate`` calibrates or shows beside camera and projector, if asked to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from acquisition.merged_photographs import photograph_brackets
from acquisition.session import Session
from calibration.arm_files import ARM_FILE, save_light_arm
from calibration.rig_geometry import RigGeometry
from devices.bayer import BayerPattern
from devices.interfaces import ArmPose
from workstation.light_calibration import CalibratedLights, LightOptions, calibrate_lights
from workstation.radiometry_sections import camera_curves, colour_patches, projector_curve
from workstation.report_sections import ReportSections

LAMPS_FILE = "lamps.json"


@dataclass(frozen=True)
class LightsAsked:
    """A light arm that is to be calibrated, as the command line names it.

    Attributes
    ----------
    spheres : Path
    white : Path or None
    options : LightOptions
    lamps_for : tuple of Path
        Sessions of photographs whose poses the table of lamps is to hold too.
    """

    spheres: Path
    white: Path | None
    options: LightOptions
    lamps_for: tuple[Path, ...] = ()

    def calibrate(
        self, rig: RigGeometry, *, begin: Callable[[str], None] = lambda stage: None
    ) -> CalibratedLights:
        """As :func:`calibrate_lights` does."""
        return calibrate_lights(rig, self.spheres, self.white, options=self.options, begin=begin)

    def write(self, lights: CalibratedLights, folder: Path) -> None:
        """Write the arm, and the table of lamps that ``impasto process`` reads, into a folder."""
        save_light_arm(lights.arm, folder / ARM_FILE)
        poses = [pose for path in self.lamps_for for pose in poses_of(Session.open(path))]
        lights.table(poses).save(folder / LAMPS_FILE)


def poses_of(session: Session) -> list[ArmPose]:
    """Poses of the lamp that a session has photographs of."""
    poses = [frames[0].arm_pose for frames in photograph_brackets(session)]
    return [pose for pose in dict.fromkeys(poses) if pose is not None]


def with_lights(sections: ReportSections, lights: CalibratedLights) -> ReportSections:
    """Parts of the report, with a light arm that was calibrated beside them."""
    return replace(
        sections,
        lights=lights.section(),
        responses=(*sections.responses, *camera_curves(lights.white, lights.target.block)),
        flat_field=lights.flat_field,
    )


@dataclass(frozen=True)
class Extras:
    """Sessions beside those of the board.

    Attributes
    ----------
    lights : LightsAsked or None
    greys : tuple of Path
        Of the projector.
    chart : Path or None
        Photographs with a colour chart.
    mosaic : BayerPattern or None
        Order of the camera's colours; by default what the sessions say.
    """

    lights: LightsAsked | None
    greys: tuple[Path, ...]
    chart: Path | None
    mosaic: BayerPattern | None

    def radiometry(self) -> ReportSections:
        """Measure greys and chart, as parts of the report.

        Raises
        ------
        ImpastoError
            A session does not show them.
        """
        return ReportSections(
            responses=(projector_curve(self.greys),) if self.greys else (),
            colours=() if self.chart is None else colour_patches(self.chart, mosaic=self.mosaic),
        )
