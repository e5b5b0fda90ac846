"""Options of ``impasto calibrate``: what they name, and what is refused before minutes of work."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from acquisition.session import Session
from calibration.boards import CharucoBoard, Chessboard
from calibration.errors import CalibrationError
from calibration.lens import check_lens_model
from calibration.rig_geometry import CAMERA_FILE, PROJECTOR_FILE, RigGeometry
from devices.bayer import BayerPattern
from workstation.calibration_extras import LightsAsked
from workstation.destinations import Kind, check_destinations, check_replaced
from workstation.light_calibration import LightOptions


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


def model_name(name: str) -> str:
    """Name, in mrcal, of a lens model that is named without its beginning."""
    return name if name.startswith("LENSMODEL_") else f"LENSMODEL_{name.upper()}"


def board_of(
    corners: tuple[int, int],
    square_mm: float,
    square_sigma_mm: float,
    marker_mm: float | None,
    dictionary: str,
    *,
    legacy: bool,
) -> Chessboard:
    """The board: a chessboard, or a ChArUco board if its markers have a size."""
    columns, rows = corners
    if marker_mm is None:
        return Chessboard(
            columns=columns, rows=rows, square_mm=square_mm, square_sigma_mm=square_sigma_mm
        )
    return CharucoBoard(
        columns=columns,
        rows=rows,
        square_mm=square_mm,
        square_sigma_mm=square_sigma_mm,
        marker_mm=marker_mm,
        dictionary=dictionary,
        legacy=legacy,
    )


def lights_of(
    *,
    spheres: Path | None,
    white: Path | None,
    radius_mm: float | None,
    circles: Iterable[str],
    white_pixel: tuple[float, float] | None,
    albedo: float,
    mosaic: BayerPattern | None,
    position: str | None,
    lamps_for: tuple[Path, ...],
) -> LightsAsked | None:
    """The light arm that is to be calibrated; None if no photographs of spheres are named.

    Raises
    ------
    typer.BadParameter
        Options that go with others.
    """
    if spheres is None:
        if white is not None or radius_mm is not None or tuple(circles) or lamps_for:
            raise typer.BadParameter(
                "--white, --sphere-radius, --sphere and --lamps-for go with --spheres"
            )
        return None
    if radius_mm is None:
        raise typer.BadParameter("name the spheres' radius", param_hint="--sphere-radius")
    options = LightOptions(
        sphere_mm=radius_mm,
        spheres_px=tuple(_circle(text) for text in circles),
        target_px=white_pixel,
        albedo=albedo,
        mosaic=mosaic,
        place=position,
    )
    return LightsAsked(spheres, white, options, lamps_for)


def _circle(text: str) -> tuple[float, float, float]:
    try:
        column, row, radius = map(float, text.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"takes column, row and radius in pixels, 400,300,60 say, not {text!r}",
            param_hint="--sphere",
        ) from None
    return column, row, radius


def _check_rigs(option: str, folders: Iterable[Path]) -> None:
    for folder in folders:
        for name in (CAMERA_FILE, PROJECTOR_FILE):
            if not (folder / name).is_file():
                raise CalibrationError(
                    f"{option} {folder} holds no calibration of camera and projector, {name} is "
                    "missing: name the folder that impasto calibrate made of poses of a board"
                )
        RigGeometry.load(folder)
