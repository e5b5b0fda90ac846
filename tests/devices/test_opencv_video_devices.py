from __future__ import annotations

import errno
import os
import struct

import pytest

from devices.opencv.video_devices import exposure_range_s, find_video_devices

QUERYCAP, ENUM_FMT, REQBUFS, QUERYCTRL = 0x80685600, 0xC0405602, 0xC0145608, 0xC0445624


class Kernel:
    """Answers of the kernel for one kind of device."""

    def __init__(self, formats, *, own=0x1, busy=False, exposure=(1, 5000)):
        self.formats, self.own, self.busy, self.exposure = formats, own, busy, exposure

    def __call__(self, handle, request, data):
        if request == QUERYCAP:
            assert len(data) == 104
            text = struct.pack("<16s32s32s", b"uvcvideo", b"Test camera", b"usb-1")
            return text + struct.pack("<III12x", 0x060100, 0x84A00001, self.own)
        if request == ENUM_FMT:
            assert len(data) == 64
            number = struct.unpack_from("<I", data)[0]
            if number >= len(self.formats):
                raise OSError(errno.EINVAL, "no more formats")
            return data[:44] + self.formats[number].ljust(4).encode() + data[48:]
        if request == REQBUFS:
            if self.busy:
                raise OSError(errno.EBUSY, "busy")
            return data
        assert request == QUERYCTRL
        assert struct.unpack_from("<I", data)[0] == 0x009A0902
        if self.exposure is None:
            raise OSError(errno.EINVAL, "no such control")
        return data[:40] + struct.pack("<iiii", *self.exposure, 1, 157) + data[56:]


@pytest.fixture
def nodes(tmp_path):
    for number in (0, 2, 10):
        (tmp_path / f"video{number}").touch()
    return tmp_path


def test_devices_are_listed_in_their_order(nodes):
    found = find_video_devices(nodes=nodes, ioctl=Kernel(["YUYV", "Y16"]))
    assert [one.address for one in found] == [str(nodes / f"video{n}") for n in (0, 2, 10)]
    assert {(one.driver, one.model, one.problem) for one in found} == {
        ("opencv", "Test camera", None)
    }


@pytest.mark.parametrize(
    ("kernel", "problem"),
    [
        (Kernel(["MJPG", "YUYV"]), r"delivers no raw samples (MJPG, YUYV)"),
        (Kernel([]), "no format at all"),
        (Kernel(["GREY"], busy=True), "another program takes pictures with it"),
    ],
)
def test_what_is_wrong_with_a_device_is_told(nodes, kernel, problem):
    assert all(problem in one.problem for one in find_video_devices(nodes=nodes, ioctl=kernel))


def test_files_for_metadata_are_no_cameras(nodes):
    # The device as a whole takes pictures, this file of it does not.
    assert find_video_devices(nodes=nodes, ioctl=Kernel(["GREY"], own=0x00A00000)) == []


def test_a_device_without_permission_is_listed_with_what_to_do(nodes, monkeypatch):
    def refuse(path, flags):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    found = find_video_devices(nodes=nodes)
    assert len(found) == 3
    assert all("usermod -aG video" in one.problem for one in found)


def test_a_file_that_is_no_device_does_not_answer(nodes):
    found = find_video_devices(nodes=nodes)
    assert all("does not answer" in one.problem for one in found)


def test_the_range_of_exposures_is_the_device_s(nodes):
    node = nodes / "video0"
    assert exposure_range_s(node, ioctl=Kernel([])) == pytest.approx((1e-4, 0.5))
    assert exposure_range_s(node, ioctl=Kernel([], exposure=None)) is None
    assert exposure_range_s(node, ioctl=Kernel([], exposure=(0, 0))) is None
    assert exposure_range_s(nodes / "video7") is None
