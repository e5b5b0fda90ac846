from __future__ import annotations

import os

import pytest

from devices.usb_tree import STILL_IMAGE, USB3_VISION, find_usb_devices


@pytest.fixture
def plugged(tmp_path):
    """A kernel's list with a camera, a hub and a device that is just being unplugged."""
    sysfs, nodes = tmp_path / "sys", tmp_path / "dev"
    devices = {
        "1-4": ("1", "7", "Canon Inc.", "EOS R5"),
        "1-0": ("1", "1", "Linux", "root hub"),
        "2-1.3": ("2", "12", "", "blackfly"),
    }
    for name, (bus, number, maker, product) in devices.items():
        folder = sysfs / name
        folder.mkdir(parents=True)
        (folder / "busnum").write_text(bus + "\n")
        (folder / "devnum").write_text(number + "\n")
        (folder / "product").write_text(product + "\n")
        if maker:
            (folder / "manufacturer").write_text(maker + "\n")
        node = nodes / f"{int(bus):03d}" / f"{int(number):03d}"
        node.parent.mkdir(parents=True, exist_ok=True)
        node.touch()
    interfaces = {
        "1-4:1.0": ("06", "01"),
        "1-0:1.0": ("09", "00"),
        "2-1.3:1.0": ("ef", "05"),
        "2-1.3:1.1": ("ef", "05"),
        "3-1:1.0": ("06", "01"),
        "3-2:1.0": ("", ""),
    }
    for name, (number, subclass) in interfaces.items():
        folder = sysfs / name
        folder.mkdir()
        (folder / "bInterfaceClass").write_text(number + "\n")
        (folder / "bInterfaceSubClass").write_text(subclass + "\n")
    return {"sysfs": sysfs, "nodes": nodes}


def test_devices_are_found_by_the_class_of_an_interface(plugged):
    (camera,) = find_usb_devices(STILL_IMAGE, **plugged)
    assert (camera.address, camera.model) == ("usb:001,007", "Canon Inc. EOS R5")
    (camera,) = find_usb_devices(USB3_VISION, **plugged)
    assert (camera.bus, camera.number, camera.model) == (2, 12, "blackfly")
    assert camera.problem() is None


def test_a_device_file_that_may_not_be_opened_is_named(plugged, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    (camera,) = find_usb_devices(STILL_IMAGE, **plugged)
    assert "no permission for" in camera.problem()
    assert "001/007; install the udev rules" in camera.problem()


def test_a_computer_without_usb_has_no_devices(tmp_path):
    assert find_usb_devices(STILL_IMAGE, sysfs=tmp_path / "none", nodes=tmp_path) == []
