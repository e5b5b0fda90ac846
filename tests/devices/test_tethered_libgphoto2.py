"""The driver against libgphoto2 itself, with the virtual PTP camera that its wheel carries."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from digital_negative import digital_negative

from devices.errors import DeviceError
from devices.gphoto2.settings import Gphoto2Settings, find

pytest.importorskip("gphoto2")
pytest.importorskip("rawpy")

# The library reads its environment when it is loaded, so each run has a process of its own.
RUN = """
import json, sys
from devices.errors import DeviceError
from devices.gphoto2.settings import Gphoto2Settings, find

said = {"found": [[one.model, one.address, one.problem] for one in find()]}
try:
    camera = Gphoto2Settings(aperture=8.0, timeout_s=10.0).open()
    said["model"] = camera.capabilities.model
    said["range_s"] = camera.capabilities.exposure_range_s
    said["aperture"] = camera.aperture
    said["frames"] = []
    for exposure_s in (0.001, 0.003, 0.004):
        frame = camera.capture(exposure_s)
        said["frames"].append(
            [frame.sequence, frame.exposure_applied_s, frame.image.shape, int(frame.image.sum())]
        )
    try:
        camera.capture(1.0)
    except DeviceError as error:
        said["too soon"] = str(error)
    camera.close()
    said["again"] = [one.problem for one in find()]
except DeviceError as error:
    said["error"] = str(error)
json.dump(said, sys.stdout)
"""


def run_with_virtual_camera(folder: Path) -> dict:
    virtual = Path(find_spec("gphoto2").origin).parent / "libgphoto2" / "vusb"
    if not virtual.is_dir():
        pytest.skip("this build of gphoto2 has no virtual camera")
    done = subprocess.run(
        [sys.executable, "-c", RUN],
        env={**os.environ, "VCAMERADIR": str(folder)},
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()
    return json.loads(done.stdout)


def test_pictures_are_taken_with_the_virtual_camera(tmp_path):
    # What it delivers at a release is the first file whose name says JPEG.
    mosaic = np.random.default_rng(2).integers(0, 4096, (48, 64)).astype(np.uint16)
    (tmp_path / "DCIM").mkdir()
    (tmp_path / "DCIM" / "picture.jpg").write_bytes(digital_negative(mosaic))
    said = run_with_virtual_camera(tmp_path)
    assert "error" not in said, said["error"]
    assert said["found"] == [["Nikon DSC D750", "usb:001,001", None]]
    assert said["range_s"] == [0.0001, 1.0]
    assert said["aperture"] == "f/8"
    total = int(mosaic.sum())
    assert said["frames"] == [
        [1, 0.0012, [48, 64], total],
        [2, 0.0025, [48, 64], total],
        [3, 0.005, [48, 64], total],
    ]
    # It does not wait for its exposures.
    assert "before its exposure can have ended" in said["too soon"]
    assert said["again"] == [None]


def test_a_virtual_camera_that_cannot_release_says_why(tmp_path):
    (tmp_path / "DCIM").mkdir()
    said = run_with_virtual_camera(tmp_path)
    assert "the camera did not release" in said["error"]
    assert "manual focus" in said["error"]


def test_a_virtual_camera_that_delivers_jpeg_is_refused(tmp_path):
    (tmp_path / "DCIM").mkdir()
    (tmp_path / "DCIM" / "picture.jpg").write_bytes(b"\xff\xd8\xff\xe0 not raw at all")
    assert "delivered only a JPEG" in run_with_virtual_camera(tmp_path)["error"]


def test_no_camera_is_said_to_be_missing():
    if find():
        pytest.skip("there is a camera on this computer's USB")
    with pytest.raises(DeviceError, match=r"no camera is plugged in \(found: none\); switch it on"):
        Gphoto2Settings().open()
