"""What ``impasto calibrate`` refuses at once, before minutes of measuring and solving."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from acquisition.session import Session
from calibration.errors import CalibrationError
from calibration.lens import check_lens_model
from calibration.rig_geometry import CAMERA_FILE, PROJECTOR_FILE, RigGeometry
from workstation.destinations import Kind, check_destinations, check_replaced


@dataclass(frozen=True, kw_only=True)
class CalibrationPaths:
    """Files and folders that the command was given.

    Attributes
    ----------
    sessions, earlier, lamps_for, greys : tuple of Path
    rig, spheres, white, chart : Path or None
        Read, with those above.
    out, report, opencv, json : Path or None
        Written.
    """

    sessions: tuple[Path, ...] = ()
    earlier: tuple[Path, ...] = ()
    lamps_for: tuple[Path, ...] = ()
    greys: tuple[Path, ...] = ()
    rig: Path | None = None
    spheres: Path | None = None
    white: Path | None = None
    chart: Path | None = None
    out: Path | None = None
    report: Path | None = None
    opencv: Path | None = None
    json: Path | None = None

    def check(self, *, force: bool) -> None:
        """Refuse outputs over or in inputs, and inputs that are not there.

        Raises
        ------
        DestinationError
            An output would change an input, another output, or something that is no calibration.
        CalibrationError
            A folder holds no calibration of a rig.
        SessionError
            A session is missing or damaged.
        typer.BadParameter
            Something is named that is of no use.
        """
        if (self.greys or self.chart) and self.report is None:
            raise typer.BadParameter("--greys and --chart are shown in the report: name --report")
        if self.opencv is not None and self.opencv.suffix not in (".yml", ".yaml", ".xml"):
            raise typer.BadParameter("takes a file in .yml, .yaml or .xml", param_hint="--opencv")
        check_destinations(
            *(*self.sessions, *self.earlier, *self.lamps_for, *self.greys),
            *(self.rig, self.spheres, self.white, self.chart),
            makes={"--out": self.out},
            fills={"--report": self.report},
            writes={"--opencv": self.opencv, "--json": self.json},
        )
        if self.out is not None:
            check_replaced(self.out, Kind.CALIBRATION, force=force)
        rigs = {"--rig": [self.rig] if self.rig else [], "--earlier": self.earlier}
        for option, folders in rigs.items():
            _check_rigs(option, folders)
        for path in (*self.lamps_for, *self.greys, self.spheres, self.white, self.chart):
            if path is not None:
                Session.open(path)


def check_models(models: Iterable[str]) -> None:
    """Refuse lens models that there are none of, even beside good ones.

    Raises
    ------
    CalibrationError
    """
    for model in models:
        check_lens_model(model)


def check_lights_alone(given: Mapping[str, Any]) -> None:
    """Refuse options of camera and projector, by name, where lights alone are calibrated.

    Raises
    ------
    typer.BadParameter
    """
    useless = [name for name, value in given.items() if value]
    if useless:
        raise typer.BadParameter(
            f"calibrates lights alone and leaves the rig as it is: leave {', '.join(useless)} out",
            param_hint="--rig",
        )


def _check_rigs(option: str, folders: Iterable[Path]) -> None:
    for folder in folders:
        for name in (CAMERA_FILE, PROJECTOR_FILE):
            if not (folder / name).is_file():
                raise CalibrationError(
                    f"{option} {folder} holds no calibration of camera and projector, {name} is "
                    "missing: name the folder that impasto calibrate made of poses of a board"
                )
        RigGeometry.load(folder)
