from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.impasto_command import IMPASTO

SAYING = """
import sys
from workstation.standard_streams import outlive_readers
outlive_readers()
for stream in (sys.stdout, sys.stderr):
    for _ in range(2000):
        print("δ0 is 3 µm × 2, and more of it to fill what a pipe holds", file=stream, flush=True)
sys.exit(7)
"""


def without_reader(command, **environment):
    """Exit status of a command whose output and messages nobody reads."""
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            command, stdout=writing, stderr=writing, check=False, env=os.environ | environment
        )
    finally:
        os.close(writing)
    return done.returncode


def test_work_goes_on_without_its_readers():
    assert without_reader([sys.executable, "-c", SAYING]) == 7


def test_a_terminal_that_is_gone_is_no_reader_either():
    leader, follower = os.openpty()
    with subprocess.Popen(
        [sys.executable, "-c", SAYING], stdout=follower, stderr=follower, start_new_session=True
    ) as running:
        os.close(follower)
        os.read(leader, 10)
        os.close(leader)
    assert running.returncode == 7


@pytest.mark.parametrize("letters", ["ascii", "latin-1"])
def test_what_a_terminal_has_no_letters_for_is_said_otherwise(letters):
    environment = os.environ | {"PYTHONIOENCODING": letters}
    command = [sys.executable, "-c", SAYING]
    done = subprocess.run(command, capture_output=True, check=False, env=environment)
    assert done.returncode == 7
    assert b"0 is 3" in done.stdout
    assert b"0 is 3" in done.stderr


def test_a_full_disk_is_told():
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", SAYING], stdout=full, stderr=subprocess.PIPE, check=False
        )
    assert b"No space left" in done.stderr


def test_a_command_leaves_its_figures_though_nobody_reads_what_it_says(tmp_path):
    figures = tmp_path / "f.json"
    rig = "fixtures/rigs/simulated.toml"
    assert without_reader([IMPASTO, "devices", rig, "--json", figures]) == 0
    assert figures.is_file()
