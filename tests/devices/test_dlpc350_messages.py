from __future__ import annotations

import struct

import pytest

from devices.dlpc350.messages import (
    LEAST_EXPOSURE_US,
    Command,
    FlashPattern,
    HardwareStatus,
    Leds,
    Version,
    bit_names,
    pack_config,
    pack_exposure,
    pack_images,
    pack_message,
    parse_reply,
)
from devices.errors import DeviceError


def test_a_message_has_the_bytes_of_the_programmers_guide():
    (report,) = pack_message(Command.PATTERN_RUN, sequence=0x2A, data=b"\x02")
    # Write with reply, sequence, length with the command's two bytes, CMD3, CMD2, data.
    assert report[:7].hex(" ") == "40 2a 03 00 24 1a 02"
    assert len(report) == 64
    assert not any(report[7:])


def test_a_read_sets_the_read_bit_and_carries_no_data():
    (report,) = pack_message(Command.VERSION, sequence=1, read=True)
    assert report[:6].hex(" ") == "c0 01 02 00 05 02"


@pytest.mark.parametrize(("size", "reports"), [(58, 1), (59, 2), (122, 2), (123, 3), (384, 7)])
def test_a_long_payload_spans_reports_without_a_second_header(size, reports):
    data = bytes(range(1, 256)) * 2
    packed = pack_message(Command.MAILBOX_DATA, sequence=0, data=data[:size])
    assert [len(report) for report in packed] == [64] * reports
    assert b"".join(packed)[6 : 6 + size] == data[:size]
    assert not any(b"".join(packed)[6 + size :])


def test_data_of_the_wrong_length_is_refused_before_it_is_sent():
    with pytest.raises(DeviceError, match=r"exposure \(0x1A29\) takes 8 bytes, not 4"):
        pack_message(Command.EXPOSURE, sequence=0, data=bytes(4))


def test_a_reply_is_taken_apart():
    reply = parse_reply(b"\xc0\x07\x02\x00\xaa\xbb".ljust(64, b"\0"))
    assert (reply.refused, reply.sequence, reply.length) == (False, 7, 2)
    assert reply.data == b"\xaa\xbb"
    assert parse_reply(b"\x60\x01\x00\x00".ljust(64, b"\0")).refused


@pytest.mark.parametrize("depth", range(1, 9))
def test_exposures_are_held_to_the_table_of_bit_depths(depth):
    least = LEAST_EXPOSURE_US[depth - 1]
    packed = pack_exposure(depth, exposure_s=least * 1e-6, period_s=least * 1e-6)
    assert struct.unpack("<II", packed) == (least, least)
    with pytest.raises(DeviceError, match=f"{depth}-bit patterns"):
        pack_exposure(depth, exposure_s=(least - 1) * 1e-6, period_s=1.0)


@pytest.mark.parametrize("extra", [1, 229, -1, -5000])
def test_a_period_between_exposure_and_230_us_more_is_refused(extra):
    with pytest.raises(DeviceError, match="must equal the exposure"):
        pack_exposure(8, exposure_s=0.010, period_s=0.010 + extra * 1e-6)
    pack_exposure(8, exposure_s=0.010, period_s=0.010230)


@pytest.mark.parametrize("time", [float("nan"), float("inf")])
def test_times_that_are_none_are_refused(time):
    with pytest.raises(DeviceError, match="no times"):
        pack_exposure(1, exposure_s=time, period_s=time)


def test_a_period_beyond_the_controllers_counter_is_refused():
    with pytest.raises(DeviceError, match="longer than the DLPC350 can count"):
        pack_exposure(1, exposure_s=0.01, period_s=4295.0)


def test_a_pattern_entry_packs_trigger_planes_depth_light_and_flags():
    pattern = FlashPattern(3, 1, 9, Leds.RED | Leds.BLUE, inverted=True)
    word = int.from_bytes(pattern.packed(swap=True), "little")
    assert word & 3 == 0
    assert word >> 2 & 63 == 9
    assert word >> 8 & 15 == 1
    assert word >> 12 & 15 == 0b101
    assert word >> 16 & 1 == 1
    assert word >> 18 & 1 == 1


@pytest.mark.parametrize(
    ("image", "depth", "pattern"), [(0, 0, 0), (0, 9, 0), (0, 8, 3), (0, 1, 24), (256, 8, 0)]
)
def test_planes_that_do_not_exist_are_refused(image, depth, pattern):
    with pytest.raises(DeviceError):
        FlashPattern(image, depth, pattern)


def test_a_table_of_two_images_is_sent_in_the_opposite_order():
    assert pack_images([4, 9]) == bytes([9, 4])
    assert pack_images([4, 9, 2]) == bytes([4, 9, 2])


def test_lengths_are_sent_as_one_less():
    assert pack_config(3, 2, repeat=True) == bytes([2, 1, 2, 1])


def test_the_version_is_read_and_ordered():
    version = Version.parse(struct.pack("<HBB", 7, 1, 4))
    assert str(version) == "4.1.7"
    assert version < Version(4, 2, 0)
    with pytest.raises(DeviceError, match="2 bytes instead of 16"):
        Version.parse(b"\0\0")


def test_status_bits_have_names():
    status = HardwareStatus(1 | 128)
    assert bit_names(status) == "initialised, sequencer error"
    assert bit_names(HardwareStatus(0)) == "nothing"
    assert bit_names(HardwareStatus(8 | 32)) == "forced swap error, unknown bits 0x20"
