"""Every command that writes and ends by itself, on small inputs, for interrupting.

``impasto view`` is not among them: it ends when its window is closed, and writes its figures then.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from acquisition.errors import SessionError
from acquisition.session import CONTACT_SHEET_FILE, JOURNAL_FILE, MANIFEST_FILE, Session
from calibration.arm_files import ARM_FILE, load_light_arm
from calibration.rig_geometry import RigGeometry
from devices.simulated.arm_targets import white_reflectance
from fitting.copy_files import read_copy
from fitting.reflectance.clusters import ClusterOptions
from fitting.reflectance.lamp_table import LampTable
from workstation.benchmarks import watched_lamp
from workstation.benchmarks.foreign_captures import DOME_FILE, write_capture, write_dome
from workstation.benchmarks.interruptions import IMPASTO, Command
from workstation.benchmarks.watched_lamp import LIT
from workstation.copy_writing import write_processed
from workstation.demo_processing import LAMPS_FILE, RIG_FOLDER, process_demo
from workstation.demo_recording import (
    BOARD,
    BOARD_FOLDER,
    LIGHTS_SESSION,
    PHOTOGRAPHS_SESSION,
    SCAN_SESSION,
    SPHERE_MM,
    DemoCapture,
    DemoRecorder,
)
from workstation.demo_truth import declared_lamps
from workstation.demonstration import true_geometry
from workstation.stage_cache import StageCache

_SMALL = DemoCapture(
    camera_width=96,
    places=("front", "left"),
    lamp_poses=6,
    clusters=ClusterOptions(most=1, survey=200, per_material=60),
    render_px=(160, 120),
    calibrates=False,
)
# Corners of a board and highlights of spheres are not found in smaller pictures.
_CALIBRATING_WIDTH = 480
_RIG = """
[camera]
driver = "simulated"

[projector]
driver = "simulated"

[arm]
driver = "simulated"

[mount]
driver = "simulated"

[simulation]
painting = "white"
camera_width = 80
projector_width = 456
projector_height = 285
"""
_FEW_FRAMES = ("--exposure", "45", "--steps", "4")
_FEW_PHOTOGRAPHS = ("--exposure", "2", "--exposure", "40", "--poses", "3", "--steps", "3")
# Results of stages, which the next run takes up.
_STAGES = frozenset({"out-stages"})
_FIGURES = "figures.json"
# What the lamp is in the end.
_LAMP = "lamp"
_DOME_LIGHTS = 12
# The frames of a session that is resumed, of all.
_RECORDED_SHARE = 0.3


@dataclass(frozen=True)
class Inputs:
    """What the commands are given, made when it is first asked for.

    Attributes
    ----------
    folder : Path
        Exists.
    """

    folder: Path

    @cached_property
    def rig(self) -> Path:
        """A ``rig.toml`` of simulated devices."""
        path = self.folder / "rig.toml"
        path.write_text(_RIG)
        return path

    @cached_property
    def painting(self) -> Path:
        """Folder of a scan, photographs, their lamps and a copy."""
        place = self.folder / "painting"
        place.mkdir()
        rig = _SMALL.rig(seed=0)
        true_geometry(rig).save(place / RIG_FOLDER)
        recorder = DemoRecorder(rig, _SMALL, place)
        recorder.record_scan(place / RIG_FOLDER)
        recorder.record_photographs()
        declared_lamps(rig, place / PHOTOGRAPHS_SESSION).save(place / LAMPS_FILE)
        done = process_demo(place, place, _SMALL, StageCache(None))
        write_processed(done, place / "copy")
        return place

    @cached_property
    def targets(self) -> Path:
        """Folder of scans of a board, and of photographs of spheres and a white target."""
        place = self.folder / "targets"
        place.mkdir()
        capture = DemoCapture(
            camera_width=_CALIBRATING_WIDTH,
            places=("front",),
            lamp_poses=8,
            clusters=_SMALL.clusters,
            render_px=_SMALL.render_px,
            calibrates=True,
        )
        rig = capture.rig(seed=0)
        true_geometry(rig).save(place / RIG_FOLDER)
        recorder = DemoRecorder(rig, capture, place)
        recorder.record_board()
        recorder.record_lights()
        return place

    @cached_property
    def capture(self) -> Path:
        """A capture of other software."""
        place = self.folder / "capture"
        write_capture(place, width=24, height=18)
        return place

    @cached_property
    def dome(self) -> Path:
        """Pictures of a flat board under known lights."""
        place = self.folder / "dome"
        write_dome(place, lights=_DOME_LIGHTS, width=32, height=24)
        return place / DOME_FILE

    @cached_property
    def cut_off(self) -> Path:
        """A session of which the last frames are missing."""
        place = self.folder / "cut-off"
        scan = [*IMPASTO, "scan", str(self.rig), "--out", str(place), *_FEW_FRAMES]
        subprocess.run(scan, check=True, capture_output=True)
        for name in (MANIFEST_FILE, CONTACT_SHEET_FILE):
            (place / name).unlink()
        lines = (place / JOURNAL_FILE).read_bytes().splitlines(keepends=True)
        kept = lines[: 1 + round(_RECORDED_SHARE * len(lines))]
        (place / JOURNAL_FILE).write_bytes(b"".join(kept))
        return place


def commands(inputs: Inputs) -> dict[str, Callable[[], Command]]:
    """What makes each command, by its name, from the rig to the copy."""
    return {
        "demo": _demo,
        "devices": lambda: _devices(inputs),
        "calibrate": lambda: _calibrate(inputs),
        "calibrate --rig": lambda: _calibrate_lights(inputs),
        "scan": lambda: _scan(inputs),
        "photograph": lambda: _photograph(inputs),
        "resume": lambda: _resume(inputs),
        "replay": lambda: _replay(inputs),
        "import": lambda: _import(inputs),
        "process": lambda: _process(inputs),
        "process --photographs": lambda: _process_photographs(inputs),
        "process --lp": lambda: _process_dome(inputs),
        "render": lambda: _render("render", inputs, "out.exr", "--mode", "exact"),
        "render --view all": lambda: _render(
            "render --view all", inputs, "out", "--mode", "bump", "--view", "all"
        ),
        "gallery": lambda: _gallery(inputs),
        "report": lambda: _report(inputs),
        "bench": _bench,
    }


def _demo() -> Command:
    def check(folder: Path) -> None:
        json.loads((folder / "out" / "report.json").read_text())
        read_copy(folder / "out" / "copy")
        _check_pictures(folder)

    return Command("demo", _words("demo", "--size", "tiny"), check)


def _devices(inputs: Inputs) -> Command:
    rig = str(inputs.rig)

    def words(folder: Path) -> list[str]:
        return ["devices", rig, "--json", str(folder / _FIGURES)]

    return Command("devices", words, _check_pictures)


def _calibrate(inputs: Inputs) -> Command:
    corners = ("--corners", str(BOARD.columns), str(BOARD.rows))
    board = ("--square", str(BOARD.square_mm), "--marker", str(BOARD.marker_mm))
    given = ("--dictionary", BOARD.dictionary, "--model", "opencv4", "--held-out", "1")
    poses = str(inputs.targets / BOARD_FOLDER)
    words = _words("calibrate", poses, *corners, *board, *given)

    def all_words(folder: Path) -> list[str]:
        more = ["--report", str(folder / "report"), "--opencv", str(folder / "rig.yml")]
        return [*words(folder), *more]

    def check(folder: Path) -> None:
        RigGeometry.load(folder / "out")
        _check_report(folder)

    return Command("calibrate", all_words, check)


def _calibrate_lights(inputs: Inputs) -> Command:
    place = inputs.targets
    spheres = ("--spheres", str(place / LIGHTS_SESSION), "--sphere-radius", str(SPHERE_MM))
    white = ("--white-albedo", f"{white_reflectance():.6f}")
    words = _words("calibrate", "--rig", str(place / RIG_FOLDER), *spheres, *white)

    def all_words(folder: Path) -> list[str]:
        return [*words(folder), "--report", str(folder / "report")]

    def check(folder: Path) -> None:
        LampTable.load(folder / "out" / LAMPS_FILE)
        load_light_arm(folder / "out" / ARM_FILE)
        _check_report(folder)

    return Command("calibrate --rig", all_words, check)


def _scan(inputs: Inputs) -> Command:
    words = _words("scan", str(inputs.rig), *_FEW_FRAMES)
    return Command("scan", words, _check_session, resumable="out")


def _photograph(inputs: Inputs) -> Command:
    words = _words("photograph", str(inputs.rig), *_FEW_PHOTOGRAPHS)

    def watched(folder: Path) -> list[str]:
        return [str(folder / _LAMP), *words(folder)]

    def afterwards(folder: Path) -> str | None:
        lamp = folder / _LAMP
        return "the lamp was left on" if lamp.is_file() and lamp.read_text() == LIT else None

    return Command(
        "photograph",
        watched,
        _check_session,
        resumable="out",
        # There is a reference pose that comes again, and a simulated sensor has the noise of the
        # first, second and third frame of it, which a rig that was switched on anew counts anew.
        same=False,
        kept=frozenset({_LAMP}),
        program=(sys.executable, "-m", watched_lamp.__name__),
        afterwards=afterwards,
    )


def _resume(inputs: Inputs) -> Command:
    session = inputs.cut_off

    def words(folder: Path) -> list[str]:
        return ["resume", str(folder / "out"), "--json", str(folder / _FIGURES)]

    def prepare(folder: Path) -> None:
        shutil.copytree(session, folder / "out")

    return Command("resume", words, _check_session, prepare, resumable="out")


def _replay(inputs: Inputs) -> Command:
    words = _words("replay", str(inputs.painting / SCAN_SESSION))
    return Command("replay", words, _check_session)


def _import(inputs: Inputs) -> Command:
    capture = inputs.capture
    described = ("--capture", str(capture / "capture.toml"))
    return Command("import", _words("import", str(capture), *described), _check_session)


def _process(inputs: Inputs) -> Command:
    words = _words("process", str(inputs.painting / SCAN_SESSION))
    return Command("process", words, _check_copy, kept=_STAGES)


def _process_photographs(inputs: Inputs) -> Command:
    place = inputs.painting
    photographs = ("--photographs", str(place / PHOTOGRAPHS_SESSION))
    lamps = ("--lamps", str(place / LAMPS_FILE), "--quality", "draft")
    words = _words("process", str(place / SCAN_SESSION), *photographs, *lamps)
    return Command("process --photographs", words, _check_copy, kept=_STAGES)


def _process_dome(inputs: Inputs) -> Command:
    words = _words("process", "--lp", str(inputs.dome), "--quality", "draft")
    return Command("process --lp", words, _check_copy)


def _render(name: str, inputs: Inputs, out: str, *given: str) -> Command:
    words = _words("render", str(inputs.painting / "copy"), "--size", "160x120", *given, out=out)
    return Command(name, words, _check_pictures)


def _gallery(inputs: Inputs) -> Command:
    frames = ("--frames", "6", "--size", "96x54", "--video")
    return Command(
        "gallery", _words("gallery", str(inputs.painting / "copy"), *frames), _check_pictures
    )


def _report(inputs: Inputs) -> Command:
    place = inputs.painting
    sessions = ("--session", str(place / SCAN_SESSION))
    photographs = ("--photographs", str(place / PHOTOGRAPHS_SESSION))
    words = _words("report", str(place / "copy"), *sessions, *photographs, out="out.html")

    def check(folder: Path) -> None:
        _check_page(folder / "out.html")

    return Command("report", words, check)


def _bench() -> Command:
    def words(folder: Path) -> list[str]:
        to = ["--json", str(folder / _FIGURES), "--pictures", str(folder / "pictures")]
        return ["bench", "render", "--part", "budget", *to]

    return Command("bench", words, _check_pictures)


def _words(*given: str, out: str = "out") -> Callable[[Path], list[str]]:
    """Arguments that write a result and figures into a folder."""

    def words(folder: Path) -> list[str]:
        return [*given, "--out", str(folder / out), "--json", str(folder / _FIGURES)]

    return words


def _check_session(folder: Path) -> None:
    Session.open(folder / "out")
    _check_pictures(folder)


def _check_copy(folder: Path) -> None:
    read_copy(folder / "out")
    _check_pictures(folder)


def _check_report(folder: Path) -> None:
    json.loads((folder / "report" / "report.json").read_text())
    _check_page(folder / "report" / "index.html")


def _check_page(page: Path) -> None:
    if not page.read_text().rstrip().endswith("</html>"):
        raise SessionError(f"{page}: cut off")


def _check_pictures(folder: Path) -> None:
    """Pictures and figures at any depth are whole, and nothing is in progress."""
    for path in folder.rglob("*"):
        if ".in-progress-" in path.name:
            raise SessionError(f"{path}: a temporary file was left")
        # A PNG ends with the chunk IEND and its checksum.
        if path.suffix == ".png" and not path.read_bytes().endswith(b"IEND\xaeB`\x82"):
            raise SessionError(f"{path}: cut off")
        if path.suffix == ".json":
            json.loads(path.read_text())


NAMES = tuple(commands(Inputs(Path())))
