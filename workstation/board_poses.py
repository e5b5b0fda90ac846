"""Poses of a board, measured in sessions of one pose each.

Sessions are recorded by ``impasto scan`` or imported from another program's capture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.decoding import decode
from acquisition.errors import DecodingError, SessionError
from acquisition.plan import Imager, Purpose
from acquisition.session import PLAN_FILE, Session
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.errors import CalibrationError
from calibration.measured_views import MeasuredView, measure_view
from calibration.surface_samples import SurfaceSamples, sample_surface
from workstation.interruption import interruption_held

LEAST_POSES = 3


@dataclass(frozen=True)
class UnreadPose:
    """A session in which no board could be measured."""

    name: str
    why: str


@dataclass(frozen=True)
class BoardPoses:
    """Measured poses of the board.

    Attributes
    ----------
    views : tuple of BoardView
    sessions : dict of str to Path
        Session of each pose by its name, so that one can be decoded again: the correspondence maps
        of forty poses would fill the memory. Without them no plane is held out.
    board : Chessboard
    compensate_phases : bool
    unread : tuple of UnreadPose
    camera, projector : Imager
    digests : dict of str to str
        Digest of each session by the pose's name.
    surfaces : dict of str to SurfaceSamples
        What was decoded of the board's white parts, by the pose's name; empty if it was not asked
        for.
    """

    views: tuple[BoardView, ...]
    sessions: dict[str, Path]
    board: Chessboard
    compensate_phases: bool
    unread: tuple[UnreadPose, ...]
    camera: Imager
    projector: Imager
    digests: dict[str, str]
    surfaces: dict[str, SurfaceSamples] = field(default_factory=dict)


def find_sessions(folders: Sequence[Path]) -> tuple[Path, ...]:
    """Sessions among folders: those that are sessions themselves, and those directly inside others.

    Raises
    ------
    SessionError
        A folder neither is a session nor holds one.
    """
    found: list[Path] = []
    for folder in folders:
        if (folder / PLAN_FILE).is_file():
            found.append(folder)
            continue
        inside = sorted(plan.parent for plan in folder.glob(f"*/{PLAN_FILE}"))
        if not inside:
            raise SessionError(f"{folder} is no session, nor does it hold any")
        found += inside
    return tuple(dict.fromkeys(found))


def measure_poses(
    sessions: Sequence[Path],
    board: Chessboard,
    *,
    compensate_phases: bool = True,
    surface: bool = False,
    begin: Callable[[str], None] = lambda stage: None,
) -> BoardPoses:
    """Measure the board in every session.

    Parameters
    ----------
    sessions : sequence of Path
        One pose of the board each.
    board : Chessboard or CharucoBoard
    compensate_phases : bool
        As in :func:`~calibration.measured_views.measure_view`.
    surface : bool
        Whether the board's white parts are sampled too, for its shape.
    begin : callable, optional
        Called with the name of each pose as it is begun.

    Raises
    ------
    CalibrationError
        Sessions of different rigs, the same recording twice, or the board found in too few.
    SessionError
        A session is damaged.
    """
    views: list[BoardView] = []
    unread: list[UnreadPose] = []
    digests: dict[str, str] = {}
    surfaces: dict[str, SurfaceSamples] = {}
    first: Session | None = None
    opened = {name: Session.open(path) for name, path in _names(sessions).items()}
    _check_different(opened)
    for name, session in opened.items():
        begin(name)
        first = first or session
        _check_same_rig(first, session)
        try:
            measured = measure_pose(name, session, board, compensate_phases=compensate_phases)
            if surface:
                corners = measured.view.pixels[0]
                surfaces[name] = sample_surface(measured.correspondence, corners, name=name)
            views.append(measured.view)
            digests[name] = session.digest
        except (CalibrationError, DecodingError) as error:
            unread.append(UnreadPose(name, str(error).removeprefix(f"{name}: ")))
    if first is None or len(views) < LEAST_POSES:
        reasons = "; ".join(f"{pose.name}: {pose.why}" for pose in unread)
        raise CalibrationError(
            f"the board was measured in {len(views)} of {len(sessions)} sessions; a calibration "
            f"takes three at least, better ten{'. ' + reasons if reasons else ''}"
        )
    return BoardPoses(
        tuple(views),
        _names(sessions),
        board,
        compensate_phases,
        tuple(unread),
        first.plan.camera,
        first.plan.projector,
        digests,
        surfaces,
    )


def measure_pose(
    name: str, session: Session, board: Chessboard, *, compensate_phases: bool = True
) -> MeasuredView:
    """Measure the board in one session.

    Raises
    ------
    CalibrationError
        The board is not found, or not decoded.
    """
    with interruption_held():
        correspondence = decode(session.plan_of(Purpose.CODE), session.read_frame)
    return measure_view(
        name,
        _evenly_lit(correspondence),
        correspondence,
        board,
        compensate_phases=compensate_phases,
    )


def _names(sessions: Sequence[Path]) -> dict[str, Path]:
    """Sessions by the shortest names that tell them apart."""
    paths = [path.resolve() for path in sessions]
    if len({path.name for path in paths}) == len(paths):
        return {path.name: path for path in paths}
    return {str(path): path for path in paths}


def _check_same_rig(first: Session, other: Session) -> None:
    for name in ("camera", "projector"):
        here, there = getattr(first.plan, name), getattr(other.plan, name)
        # Sessions of earlier versions do not say what mosaic the camera has.
        if (here.width, here.height) != (there.width, there.height):
            raise CalibrationError(
                f"{other.path}: its {name} has {there.width}×{there.height} pixels, that of "
                f"{first.path} {here.width}×{here.height}; poses of one rig are calibrated together"
            )


def _check_different(sessions: dict[str, Session]) -> None:
    """One pose under several names would count as several, and predict errors too small."""
    seen: dict[tuple[str, ...], str] = {}
    for name, session in sessions.items():
        # Of the frames: an import of them again has a journal of its own.
        frames = tuple(sorted(entry.sha256 for entry in session.recorded.values()))
        other = seen.setdefault(frames, name)
        if other != name:
            raise CalibrationError(
                f"{other} and {name} are the same recording; name each pose once: the copies would "
                "count as measurements of their own"
            )


def _evenly_lit(correspondence: CorrespondenceMap) -> NDArray[np.float32]:
    """The board in even light: the steps of a fringe add up to it."""
    light = correspondence.ambient
    return np.nan_to_num(light, nan=float(np.nanmedian(light)))
