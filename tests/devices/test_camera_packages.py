"""What each camera driver needs is loaded when it is opened, and named when it is missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from devices.aravis import settings as aravis
from devices.errors import MissingPackageError
from devices.gphoto2 import settings as gphoto2
from devices.gphoto2.raw_file import decode_raw

DRIVERS = [
    (aravis, aravis.AravisSettings(), "gi", "apt install gir1.2-aravis-0.8 python3-gi"),
    (gphoto2, gphoto2.Gphoto2Settings(), "gphoto2", "pip install gphoto2"),
]


@pytest.mark.parametrize(("driver", "settings", "package", "command"), DRIVERS)
def test_a_missing_package_is_named_with_the_command_that_installs_it(
    monkeypatch, driver, settings, package, command
):
    monkeypatch.setitem(sys.modules, package, None)
    for use in (settings.open, driver.find):
        with pytest.raises(MissingPackageError, match=f"needs the package '{package}'.*{command}"):
            use()


def test_raw_files_need_their_decoder(monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(MissingPackageError, match="pip install rawpy"):
        decode_raw(b"raw", name="IMG_1.CR2")


def test_settings_of_cameras_load_no_camera_library():
    code = (
        "import sys\n"
        "import devices.aravis.settings, devices.gphoto2.settings, devices.opencv.settings\n"
        "print(*sorted({'gi', 'gphoto2', 'rawpy', 'cv2'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
