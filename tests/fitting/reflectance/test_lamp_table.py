from __future__ import annotations

import json
import math

import pytest
from photographed_relief import lamp

from devices.interfaces import ArmPose
from fitting.errors import FittingError
from fitting.reflectance.lamp_table import LampTable

POSES = (ArmPose(0.1, 0.5), ArmPose(2 * math.pi - 0.1, 1.2))


@pytest.fixture
def file(tmp_path):
    LampTable(POSES, (lamp(40, 10), lamp(60, 200))).save(tmp_path / "lamps.json")
    return tmp_path / "lamps.json"


def test_lamps_survive_the_disk(file):
    table = LampTable.load(file)
    found = table.lamp(ArmPose(-0.1, 1.2))  # the same pose, a turn away
    assert found.position == pytest.approx(lamp(60, 200).position)
    assert found.intensity == pytest.approx(lamp(60, 200).intensity)
    assert found.exponent == 4.0


def test_a_pose_that_nobody_calibrated_is_refused(file):
    with pytest.raises(FittingError, match=r"azimuth 5\.73°, elevation 34\.38°"):
        LampTable.load(file).lamp(ArmPose(0.1, 0.6))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not a table"),
        ("[]", "format"),
        ('{"format": "impasto-lamps-1"}', "no lamp"),
        ('{"format": "impasto-lamps-1", "lamps": 5}', "no lamp"),
        ('{"format": "impasto-lamps-1", "lamps": [5]}', "lamp 1"),
        ('{"format": "impasto-lamps-1", "lamps": [{"azimuth_deg": 1}]}', "lamp 1"),
    ],
)
def test_files_that_are_no_tables_are_refused_by_name(tmp_path, content, message):
    (tmp_path / "lamps.json").write_text(content)
    with pytest.raises(FittingError, match=message):
        LampTable.load(tmp_path / "lamps.json")
    with pytest.raises(FittingError, match="no such"):
        LampTable.load(tmp_path / "none.json")


def test_a_lamp_of_no_sense_is_named(file):
    content = json.loads(file.read_text())
    content["lamps"][1]["intensity"] = [0, 1, 1]
    file.write_text(json.dumps(content))
    with pytest.raises(FittingError, match="lamp 2: a lamp's intensity"):
        LampTable.load(file)
