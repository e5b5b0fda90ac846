"""Outputs that would change what is read are refused, and folders of other kinds are kept."""

import json
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from acquisition.atomic_files import file_in_progress, folder_in_progress
from acquisition.plan import Plan
from acquisition.session import PLAN_FILE
from calibration.arm_files import ARM_FILE
from calibration.rig_geometry import CAMERA_FILE, PROJECTOR_FILE
from fitting.copy_files import COPY_FILE, FORMAT
from workstation import commands
from workstation.destinations import (
    DEMO_FILE,
    DEMO_FORMAT,
    DestinationError,
    Kind,
    check_destinations,
    check_replaced,
    kind_of,
)
from workstation.stage_cache import digest_of_files


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A folder with one of each kind, and things of others."""
    monkeypatch.chdir(tmp_path)
    plan = {"format": Plan.model_fields["format"].default}
    headers = {
        f"poses/1/{PLAN_FILE}": plan,
        f"copy/{COPY_FILE}": {"format": FORMAT},
        f"demo/{DEMO_FILE}": {"format": DEMO_FORMAT},
        "theirs/report.json": {"gates": []},
        "theirs/copy.json": {"format": "of another program"},
        "lights/" + ARM_FILE: {},
        "lamps.json": {},
    }
    for name in (f"rig/{CAMERA_FILE}", f"rig/{PROJECTOR_FILE}", "half/camera.cameramodel"):
        headers[name] = {}
    for name, header in headers.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(header))
    return tmp_path


def test_folders_are_told_by_what_only_they_hold(desk):
    found = {name: kind_of(desk / name) for name in ("poses/1", "copy", "demo", "rig", "lights")}
    assert found == {
        "poses/1": Kind.SESSION,
        "copy": Kind.COPY,
        "demo": Kind.DEMO,
        "rig": Kind.CALIBRATION,
        "lights": Kind.CALIBRATION,
    }
    assert {kind_of(desk / name) for name in ("theirs", "half", "poses", "nothing")} == {None}


@pytest.mark.parametrize(
    ("how", "path", "inputs"),
    [
        ("makes", "poses/1", ["poses/1"]),
        ("makes", "poses/1/copy", ["poses/1"]),
        ("makes", "poses", ["poses/1"]),
        ("makes", ".", ["poses/1"]),
        ("makes", "new/../rig/copy", ["poses/1", "rig"]),
        ("fills", "poses/1", ["poses/1"]),
        ("fills", "poses/1/report", ["poses"]),
        ("fills", "poses", ["poses"]),
        ("fills", "copy", []),
        ("writes", "copy/copy.json", ["copy"]),
        ("writes", "copy/x.png", ["copy"]),
        ("writes", "copy/x.png", []),
        ("writes", "rig/figures.json", ["poses/1"]),
        ("writes", "lamps.json", ["poses/1", "lamps.json"]),
        ("writes", "link/x.png", ["copy"]),
    ],
)
def test_what_is_read_is_not_written_to(desk, how, path, inputs):
    (desk / "link").symlink_to(desk / "copy")
    with pytest.raises(DestinationError, match=r"--out .*choose another place"):
        check_destinations(*map(Path, inputs), **{how: {"--out": Path(path)}})


def test_an_input_that_is_named_through_a_link_is_known(desk):
    (desk / "link").symlink_to(desk / "copy")
    with pytest.raises(DestinationError, match="lies in"):
        check_destinations(desk / "link", writes={"--out": desk / "copy" / "x.png"})
    (desk / "elsewhere.json").symlink_to(desk / "lamps.json")
    with pytest.raises(DestinationError, match="is what is read from"):
        check_destinations(desk / "lamps.json", writes={"--json": desk / "elsewhere.json"})


def test_a_damaged_session_takes_nothing_either(desk):
    (desk / "poses" / "1" / PLAN_FILE).write_text("{torn")
    with pytest.raises(DestinationError, match="lies in"):
        check_destinations(desk / "poses" / "1", writes={"--json": desk / "poses/1/f.json"})


@pytest.mark.parametrize(
    ("outputs", "message"),
    [
        ({"makes": {"--out": "c"}, "fills": {"--stages": "c/stages"}}, "--stages .* --out"),
        ({"makes": {"--out": "demo"}, "writes": {"--json": "demo/f.json"}}, "--json .* --out"),
        ({"writes": {"--out": "f", "--json": "./f"}}, "is or lies in"),
        ({"writes": {"--out": "demo"}}, "is a folder; name a file"),
        ({"writes": {"--out": "/dev/null"}}, "is a device or pipe.* name a file"),
        ({"writes": {"--out": "none/f"}}, "no folder none; make it"),
        ({"fills": {"--report": "lamps.json"}}, "is a file; name a folder"),
        ({"makes": {"--out": "lamps.json/c"}}, "lamps.json is no folder"),
        ({"writes": {"--json": "f"}, "beside": {"--out (run)": "./f"}}, r"--json .* --out \(run"),
        ({"fills": {"--stages": "f/s"}, "beside": {"--out (run)": "f"}}, "--stages f/s"),
        ({"makes": {"--out": "x" * 240}}, "too long.* 233 bytes"),
        ({"writes": {"--json": "δ" * 120}}, "too long"),
        ({"beside": {"--out (picture)": "demo"}}, "demo is a folder: choose"),
        ({"beside": {"--out (picture)": "copy/f.png"}}, "lies in .*copy, a digital copy"),
    ],
)
def test_outputs_that_cannot_be_written_together_are_refused(desk, outputs, message):
    named = {
        how: {option: Path(path) for option, path in paths.items()}
        for how, paths in outputs.items()
    }
    with pytest.raises(DestinationError, match=message):
        check_destinations(**named)


def test_places_beside_what_is_read_are_free(desk):
    check_destinations(
        *(desk / "poses" / "1", desk / "lamps.json", None),
        makes={"--out": desk / "new" / "copy"},
        fills={"--stages": desk / "poses" / "1-stages", "--report": desk / "report"},
        writes={"--json": desk / "report.json", "--opencv": None},
        beside={"--out (run)": desk / "new" / "copy-run.json"},
    )
    check_destinations(desk / "poses", makes={"--out": desk / "poses" / "rig"})
    longest = desk / ("x" * 233)
    check_destinations(makes={"--out": longest})
    with folder_in_progress(longest), file_in_progress(desk / ("y" * 229 + ".png")):
        pass
    check_destinations(desk / "half", makes={"--out": desk / "half" / "copy"})


def test_only_a_folder_of_its_kind_is_replaced(desk):
    check_replaced(desk / "nothing", Kind.DEMO, force=False)
    check_replaced(desk / "demo", Kind.DEMO, force=True)
    with pytest.raises(DestinationError, match="--force"):
        check_replaced(desk / "demo", Kind.DEMO, force=False)
    for name in ("theirs", "rig", "poses", "lamps.json"):
        for kind in (Kind.DEMO, Kind.COPY):
            with pytest.raises(DestinationError, match=f"is no {kind}"):
                check_replaced(desk / name, kind, force=True)


COMMANDS = [
    "process poses/1 --out poses/1/copy",
    "process poses/1 --out poses",
    "process poses/1 --out c --stages poses/1",
    "process poses/1 --out c --calibration rig --stages rig/stages",
    "process poses/1 --out c --stages c/stages",
    "process poses/1 --out copy --json copy/f.json",
    "process poses/1 --out c --photographs poses/1 --lamps lamps.json --json lamps.json",
    "process --lp lamps.json --out c --json lamps.json",
    "process poses/1 --out c --json c-run.json",
    "process --lp lights-run.json --out lights",
    "report copy --out copy/copy.json",
    "report copy --session poses/1 --out poses/1/report.html",
    "report copy --out theirs",
    "report copy --out r.html --json r.html",
    "render copy --out copy/x.png",
    "render copy --out copy/copy.json",
    "render copy --view all --out copy/views",
    "render copy --out x.png --json copy/copy.json",
    "gallery copy --out copy/walk",
    "gallery copy --out walk --json copy/f.json",
    "view copy --json copy/f.json",
    "import half --capture lamps.json --out poses/1/session",
    "import half --capture lamps.json --out session --json lamps.json",
    "replay poses/1 --out poses/1/again",
    "replay poses/1 --out again --json poses/1/f.json",
    "resume poses/1 --json poses/1/plan.json",
    "scan lamps.json --out rig/scan",
    "scan lamps.json --out scan --json lamps.json",
    "photograph lamps.json --out photographs --json lamps.json",
    "devices lamps.json --json lamps.json",
    "demo --out demo --force --json demo/f.json",
    "demo --out theirs --force",
    "bench render --json copy/f.json",
    "bench render --pictures copy",
]


@pytest.mark.parametrize("line", COMMANDS)
def test_commands_refuse_before_any_work(desk, line):
    before = digest_of_files(desk)
    app = typer.Typer()
    commands.register(app)
    done = CliRunner().invoke(app, line.split())
    assert isinstance(done.exception, DestinationError), done.output
    assert done.exception.exit_code == 3
    assert digest_of_files(desk) == before
