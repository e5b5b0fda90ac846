from __future__ import annotations

import time

import pytest

from devices.child_process import call_all
from devices.discovery import Found
from devices.drivers import DeviceKind, Driver
from devices.errors import DeviceError
from devices.search import SEARCHED, search

DRIVERS = {
    "quick": "return [Found('quick', 'bus 1', 'a device'), Found('quick', 'bus 2', '', 'is mute')]",
    "talkative": "print('noise of a library'); return []",
    "hanging": "import time; time.sleep(600)",
    "crashing": "import os; os.kill(os.getpid(), 11)",
    "raising": "raise RuntimeError('a defect')",
    "refusing": "raise OwnError('bus', 'no permission')",
    "missing": "import_optional('no_such_module', needed_by='it', install='pip install it')",
}
BEFORE = """
from devices.discovery import Found
from devices.errors import DeviceError
from devices.optional_packages import import_optional

class OwnError(DeviceError):
    def __init__(self, where, what):
        super().__init__(f"{where}: {what}")

def find():
    """


@pytest.fixture
def drivers(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    for name, body in DRIVERS.items():
        (tmp_path / f"driver_{name}.py").write_text(BEFORE + body + "\n")
    return [
        Driver(name, DeviceKind.CAMERA, f"driver_{name}", "Settings")
        for name in (*DRIVERS, "absent")
    ]


def test_each_driver_has_its_own_time_and_its_own_end(drivers, capfd):
    began = time.monotonic()
    results = {result.driver.name: result for result in search(drivers, limit_s=8.0)}
    assert time.monotonic() - began < 30
    assert set(results) == {*DRIVERS, "absent"}
    assert results["quick"].found == (
        Found("quick", "bus 1", "a device"),
        Found("quick", "bus 2", "", "is mute"),
    )
    assert results["talkative"].found == ()
    assert "did not answer within 8 s" in results["hanging"].problem
    assert "crashed (exit code -11)" in results["crashing"].problem
    assert "RuntimeError: a defect" in results["raising"].problem
    assert results["refusing"].problem == "bus: no permission"
    assert "install it: pip install it" in results["missing"].missing
    assert results["missing"].problem is None
    assert "No module named 'driver_absent'" in results["absent"].problem
    # What a driver prints is no part of this program's output.
    assert capfd.readouterr().out == ""


def test_the_quick_need_not_wait_for_those_that_hang(drivers):
    answers = search([d for d in drivers if d.name in ("quick", "hanging")], limit_s=60.0)
    began = time.monotonic()
    assert next(answers).driver.name == "quick"
    assert time.monotonic() - began < 30
    answers.close()
    assert time.monotonic() - began < 40


def test_results_and_errors_come_back_by_name():
    calls = {"right": (divmod, (7, 2)), "wrong": (divmod, (7, 0))}
    answers = {answer.name: answer for answer in call_all(calls, limit_s=30.0)}
    assert answers["right"].value == (3, 1)
    assert answers["right"].error is None
    assert isinstance(answers["wrong"].error, DeviceError)
    assert "ZeroDivisionError" in str(answers["wrong"].error)


def test_every_kind_of_real_device_is_searched_for():
    assert {driver.kind for driver in SEARCHED} == {
        DeviceKind.CAMERA,
        DeviceKind.PROJECTOR,
        DeviceKind.ARM,
    }
