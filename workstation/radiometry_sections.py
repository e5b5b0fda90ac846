"""Parts of the report from recorded sessions: responses of camera and projector, and colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import DecodingError
from acquisition.merged_photographs import PhotographMerger, photograph_brackets
from acquisition.patterns import Uniform
from acquisition.plan import Purpose
from acquisition.response_measurement import measure_response
from acquisition.session import Session
from acquisition.session_mosaic import mosaic_of
from calibration.arm_photographs import ArmPhotographs
from calibration.colour_chart import (
    PATCHES_LAB,
    find_chart,
    fit_colour_matrix,
    linear_rgb_of_lab,
)
from calibration.errors import CalibrationError
from calibration.mosaics import mosaic_channels
from calibration.photon_transfer import FlatPair, measure_photon_transfer
from calibration.projector_response import ResponseReport, report_response
from calibration.srgb import encode_srgb
from devices.bayer import BayerPattern
from fitting.reflectance.photographs import halved
from workstation.report_sections import ColourPatch, ResponseCurve

# The patches of a ColorChecker Classic, row by row.
PATCH_NAMES = (
    *("dark skin", "light skin", "blue sky", "foliage", "blue flower", "bluish green"),
    *("orange", "purplish blue", "moderate red", "purple", "yellow green", "orange yellow"),
    *("blue", "green", "red", "yellow", "magenta", "cyan"),
    *("white", "neutral 8", "neutral 6.5", "neutral 5", "neutral 3.5", "black"),
)
_GREEN = 1


def projector_curve(paths: Sequence[Path]) -> ResponseCurve:
    """The projector's response by sessions of greys (``impasto scan --greys``).

    Parameters
    ----------
    paths : sequence of Path
        One session, or several of the same greys, which tell standard errors too.

    Raises
    ------
    DecodingError, CalibrationError
        The greys tell no response.
    SessionError
        A session is damaged, or holds no greys.
    """
    sessions = [Session.open(path) for path in paths]
    if len(sessions) == 1:
        plan = sessions[0].plan_of(Purpose.CODE)
        response = measure_response(plan, sessions[0].read_frame)
        levels, light = np.linspace(0, 1, len(response.light)), np.array(response.light)
        return _projector_curve("Projector", levels, light, None)
    report = _repeated_greys(sessions)
    name = f"Projector; nearest power {report.gamma.value:.3f} ± {report.gamma.sigma:.3f}"
    return _projector_curve(name, report.levels, report.light, report.sigma)


def camera_curves(
    photographs: ArmPhotographs, block: NDArray[np.int32]
) -> tuple[ResponseCurve, ...]:
    """Linearity and noise of the camera, by the reference pose's photographs of a white target.

    Parameters
    ----------
    photographs : ArmPhotographs
    block : (rows, cols) int32 array
        -1 where the target is not.

    Returns
    -------
    tuple of ResponseCurve
        Deviation from a line, and variance by level; empty where the session's exposures are too
        few to tell.

    Raises
    ------
    SessionError
        A frame was altered.
    """
    session = photographs.session
    rows, cols = np.indices(block.shape, sparse=True)
    channel = photographs.channels[rows % 2, cols % 2]
    known = (block >= 0) & ((channel == _GREEN) | (channel < 0))
    repeats: dict[float, list[NDArray[np.generic]]] = {}
    darks: list[NDArray[np.generic]] = []
    for frame in session.frames:
        wanted = frame.purpose in (Purpose.REFERENCE_POSE, Purpose.DARK)
        if frame.camera_position != photographs.place or not wanted:
            continue
        samples = session.read_frame(frame.id)[known][np.newaxis]
        if frame.purpose is Purpose.DARK:
            darks.append(samples)
        else:
            repeats.setdefault(session.exposure_s(frame.id) or 0.0, []).append(samples)
    pairs = [FlatPair(e, f[0], f[1]) for e, f in repeats.items() if e > 0 and len(f) > 1]
    try:
        transfer = measure_photon_transfer(pairs, darks)
    except CalibrationError:
        return ()
    level = "level above black, sensor numbers"
    return (
        ResponseCurve(
            name="Camera: deviation from a line through black",
            input_name=level,
            output_name="relative",
            x=transfer.levels,
            y=transfer.nonlinearity,
            sigma_y=transfer.nonlinearity_sigma,
        ),
        ResponseCurve(
            name=f"Camera: noise; {1 / transfer.gain.value:.2f} electrons a number",
            input_name=level,
            output_name="variance of a sample",
            x=transfer.levels,
            y=transfer.variances,
        ),
    )


def colour_patches(path: Path, *, mosaic: BayerPattern | None = None) -> tuple[ColourPatch, ...]:
    """A ColorChecker's patches before and after correction (``impasto photograph --colour-chart``).

    Parameters
    ----------
    path : Path
        Session.
    mosaic : BayerPattern, optional
        By default what the session says.

    Raises
    ------
    CalibrationError
        No chart was photographed or found, or the camera is monochrome.
    SessionError
        The session is damaged, or says another mosaic.
    """
    session = Session.open(path)
    mosaic = mosaic_of(session, mosaic)
    if mosaic is None:
        raise CalibrationError(
            "a colour chart tells a colour camera's matrix: name the order of its colours with "
            "--mosaic"
        )
    brackets = photograph_brackets(session, purpose=Purpose.COLOUR_CHART)
    if not brackets:
        raise CalibrationError(
            f"{path} holds no photograph of a colour chart: record it with impasto photograph "
            "--colour-chart"
        )
    frames = brackets[0]
    radiance = PhotographMerger.of(session, frames[0].camera_position).merge(frames).radiance
    ceiling = float(np.nanmax(radiance))
    crop = session.plan.crop
    channels = mosaic_channels(mosaic, row=crop.row, column=crop.column)
    picture = halved(np.nan_to_num(radiance, nan=2 * ceiling), channels)
    rgb = find_chart(picture, saturation=1.05 * ceiling).rgb
    matrix = fit_colour_matrix(rgb)
    reference = encode_srgb(linear_rgb_of_lab(PATCHES_LAB))
    measured = encode_srgb(matrix.apply(rgb))
    return tuple(
        ColourPatch(
            name=name,
            reference_srgb=reference[n],
            measured_srgb=measured[n],
            delta_e_before=float(matrix.delta_e_before[n]),
            delta_e_after=float(matrix.delta_e_after[n]),
        )
        for n, name in enumerate(PATCH_NAMES)
    )


def _repeated_greys(sessions: Sequence[Session]) -> ResponseReport:
    """By the longest exposure that has pixels which are lit well and not saturated."""
    exposures = {f.exposure_s or 0.0 for session in sessions for f in session.frames}
    why: Exception = DecodingError("the sessions hold no greys")
    for exposure in sorted(exposures, reverse=True):
        greys: dict[float, list[NDArray[np.generic]]] = {}
        for session in sessions:
            for frame in session.frames:
                if isinstance(frame.pattern, Uniform) and (frame.exposure_s or 0.0) == exposure:
                    shown = greys.setdefault(frame.pattern.level, [])
                    shown.append(session.read_frame(frame.id))
        try:
            return report_response(greys, saturation_level=sessions[0].plan.saturation_level)
        except CalibrationError as error:
            why = error
    raise why


def _projector_curve(
    name: str,
    levels: NDArray[np.float64],
    light: NDArray[np.float64],
    sigma: NDArray[np.float64] | None,
) -> ResponseCurve:
    return ResponseCurve(
        name=name,
        input_name="grey shown, 1 is white",
        output_name="light, 1 is that of white",
        x=levels,
        y=light,
        sigma_y=sigma,
    )
