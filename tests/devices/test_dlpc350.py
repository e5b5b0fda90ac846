from __future__ import annotations

import errno
import subprocess
import sys
import time
from array import array
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
import usb.core
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from devices.deadline import Deadline
from devices.dlpc350.health import ask_until
from devices.dlpc350.messages import Command, FlashPattern, Leds, ValidationStatus
from devices.dlpc350.projector import Dlpc350Projector
from devices.dlpc350.settings import Dlpc350Settings, find
from devices.dlpc350.usb_link import UsbLink, find_boards
from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError
from devices.interfaces import Projection, ProjectorCapabilities
from devices.simulated.dlpc350_backend import Fault, SimulatedUsbBackend
from devices.simulated.dlpc350_board import SimulatedDlpc350

PANEL = (1140, 912)


def picture(name: str, level: int = 0) -> Projection:
    return Projection(name, np.full(PANEL, level, np.uint8))


def flash_settings(**changes) -> Dlpc350Settings:
    table = {
        "source": "flash",
        "latency_s": 0.0,
        "stored": [
            {"projection": "fringe", "image": 3, "bit_depth": 8, "pattern": 1},
            {"projection": picture("", 77).digest, "image": 5, "bit_depth": 1, "pattern": 13},
        ],
    }
    return Dlpc350Settings.model_validate(table | changes)


@pytest.fixture
def backend():
    return SimulatedUsbBackend()


@pytest.fixture
def projector(backend):
    projector = flash_settings().open(backend=backend)
    yield projector
    backend.unplug_after = None
    projector.close()


def open_link(backend: SimulatedUsbBackend) -> UsbLink:
    return UsbLink(find_boards(backend)[0], reply_timeout_s=0.2)


def soon() -> Deadline:
    return Deadline.after(2.0)


# Showing what is stored.


def test_a_stored_picture_runs_on_repeat_in_the_order_of_the_guide(projector, backend):
    backend.board.history.clear()
    since = projector.show(picture("fringe"))
    assert since <= time.monotonic()
    board = backend.board
    assert board.lit
    commands = [command for command, _ in board.history]
    assert commands == [
        Command.LED_ENABLE,
        Command.DISPLAY_MODE,
        Command.PATTERN_SOURCE,
        Command.PATTERN_CONFIG,
        Command.TRIGGER_MODE,
        Command.EXPOSURE,
        Command.MAILBOX_CONTROL,
        Command.MAILBOX_ADDRESS,
        Command.MAILBOX_DATA,
        Command.MAILBOX_CONTROL,
        Command.MAILBOX_CONTROL,
        Command.MAILBOX_ADDRESS,
        Command.MAILBOX_DATA,
        Command.MAILBOX_CONTROL,
        Command.VALIDATE,
        Command.LED_ENABLE,
        Command.PATTERN_RUN,
    ]
    assert (board.display_mode, board.source, board.trigger_mode, board.run) == (1, 3, 1, 2)
    assert board.exposure_us == (10_000, 10_000)
    assert board.config == (0, 1, 0, 0)
    assert board.images == (3,)
    # Pattern 1 of 8 bit, all LEDs, begins an image.
    assert board.patterns[0] == bytes([1 << 2, 0x78, 4])


def test_a_second_picture_replaces_the_first(projector, backend):
    projector.show(picture("fringe"))
    projector.show(picture("a name that nobody knows", 77))
    assert backend.board.images == (5,)
    assert backend.board.patterns[0][:2] == bytes([13 << 2, 0x71])
    assert backend.board.lit


def test_a_picture_that_is_not_stored_is_refused_by_name_and_the_light_is_out(projector, backend):
    projector.show(picture("fringe"))
    with pytest.raises(DeviceError, match="'Gray bit 3' is not stored") as refused:
        projector.show(picture("Gray bit 3", 1))
    assert picture("", 1).digest in str(refused.value)
    assert not backend.board.lit


def test_a_picture_of_another_size_is_refused(projector):
    with pytest.raises(DeviceError, match="912×1140"):
        projector.show(Projection("fringe", np.zeros((100, 100), np.uint8)))


def test_the_latency_is_waited_for(backend):
    projector = flash_settings(latency_s=0.2).open(backend=backend)
    before = time.monotonic()
    since = projector.show(picture("fringe"))
    assert before + 0.2 <= since <= time.monotonic()
    with pytest.raises(DeviceTimeoutError):
        projector.show(picture("fringe"), deadline=Deadline.after(0.1))
    assert not backend.board.lit
    projector.close()


def test_capabilities_are_those_of_the_panel(projector):
    assert projector.capabilities == ProjectorCapabilities(
        "DLPC350, firmware 4.1.0", 912, 1140, 0.01
    )


# The light goes out.


def test_blank_stops_the_sequence_and_puts_the_leds_out(projector, backend):
    projector.show(picture("fringe"))
    projector.blank()
    assert backend.board.run == 0
    assert backend.board.led_enable == Leds.NONE
    projector.blank()


@pytest.mark.parametrize("fault", [Fault.NACK, Fault.LOST_REPLY, Fault.TRUNCATED_REPORT])
@pytest.mark.parametrize("command", [Command.LED_ENABLE, Command.PATTERN_RUN])
def test_putting_the_light_out_is_tried_again(projector, backend, fault, command):
    projector.show(picture("fringe"))
    backend.inject(fault, on=command, times=2)
    projector.blank()
    assert backend.board.run == 0
    assert backend.board.led_enable == Leds.NONE


def test_light_that_cannot_be_put_out_is_said(projector, backend):
    projector.show(picture("fringe"))
    backend.inject(Fault.NACK, on=Command.LED_ENABLE, times=3)
    with pytest.raises(DeviceError, match=r"refuses led enable \(0x1A07\)"):
        projector.blank()
    # What else makes it dark was done all the same.
    assert not backend.board.lit


def test_opening_finds_a_lit_board_and_leaves_it_dark(backend):
    assert backend.board.lit
    flash_settings().open(backend=backend).close()
    assert not backend.board.lit


def test_closing_puts_the_light_out_and_gives_the_board_back_to_the_kernel(backend):
    projector = flash_settings().open(backend=backend)
    assert not backend.kernel_driver
    projector.show(picture("fringe"))
    projector.close()
    assert not backend.board.lit
    assert backend.kernel_driver
    assert not backend.claimed
    projector.close()
    projector.blank()
    with pytest.raises(DeviceError, match="closed"):
        projector.show(picture("fringe"))


def test_an_interrupt_while_showing_leaves_the_board_dark(projector, backend, monkeypatch):
    projector.show(picture("fringe"))

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("devices.dlpc350.projector.start_sequence", interrupt)
    with pytest.raises(KeyboardInterrupt):
        projector.show(picture("fringe"))
    assert not backend.board.lit


def test_a_program_that_ends_without_closing_leaves_the_board_dark():
    script = """
import atexit, numpy as np
from devices.dlpc350.settings import Dlpc350Settings
from devices.interfaces import Projection
from devices.simulated.dlpc350_backend import SimulatedUsbBackend
backend = SimulatedUsbBackend()
atexit.register(lambda: print("lit at the end:", backend.board.lit))
settings = Dlpc350Settings.model_validate(
    {"source": "flash", "latency_s": 0.0, "stored": [{"projection": "a", "image": 0}]})
projector = settings.open(backend=backend)
projector.show(Projection("a", np.zeros((1140, 912), np.uint8)))
print("lit:", backend.board.lit)
raise SystemExit(3)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.split("\n")[:2] == ["lit: True", "lit at the end: False"], done.stderr
    assert done.returncode == 3


@pytest.mark.parametrize("fault", [Fault.NACK, Fault.LOST_REPLY, Fault.TRUNCATED_REPORT])
@pytest.mark.parametrize(
    "command",
    [
        Command.DISPLAY_MODE,
        Command.PATTERN_SOURCE,
        Command.PATTERN_CONFIG,
        Command.TRIGGER_MODE,
        Command.EXPOSURE,
        Command.MAILBOX_CONTROL,
        Command.MAILBOX_ADDRESS,
        Command.MAILBOX_DATA,
        Command.VALIDATE,
        Command.PATTERN_RUN,
        Command.MAIN_STATUS,
    ],
)
def test_any_fault_of_any_command_is_an_error_with_the_light_out(
    projector, backend, fault, command
):
    # Questions are asked three times.
    asked = command in (Command.MAIN_STATUS, Command.DISPLAY_MODE)
    times = 3 if asked and fault is Fault.LOST_REPLY else 1
    backend.inject(fault, on=command, times=times)
    with pytest.raises(DeviceError) as failed:
        projector.show(picture("fringe"))
    if fault is Fault.NACK:
        assert f"0x{command.code:04X}" in str(failed.value)
        assert "NACK" in str(failed.value)
    if fault is Fault.LOST_REPLY:
        assert isinstance(failed.value, DeviceTimeoutError)
    assert not backend.board.lit
    projector.show(picture("fringe"))
    assert backend.board.lit


def test_unplugging_at_any_transfer_is_a_loss_by_name():
    whole = SimulatedUsbBackend()
    projector = flash_settings().open(backend=whole)
    opened = whole.transfers
    projector.show(picture("fringe"))
    shown = whole.transfers
    projector.close()
    assert shown - opened > 30
    for transfer in range(1, shown):
        backend = SimulatedUsbBackend(unplug_after=transfer)
        with pytest.raises(DeviceLostError, match="unplugged"):
            open_and_show(backend)


def open_and_show(backend: SimulatedUsbBackend) -> None:
    projector = flash_settings().open(backend=backend)
    try:
        projector.show(picture("fringe"))
    finally:
        projector.close()


def test_after_a_loss_every_call_says_so_and_closing_is_harmless(projector, backend):
    backend.unplug_after = backend.transfers
    with pytest.raises(DeviceLostError, match="switch it off by hand"):
        projector.show(picture("fringe"))
    with pytest.raises(DeviceLostError, match="gone"):
        projector.blank()
    projector.close()


# The wire.


def test_a_lost_reply_to_a_question_is_asked_again(backend):
    link = open_link(backend)
    backend.inject(Fault.LOST_REPLY, on=Command.DISPLAY_MODE, times=2)
    assert link.read(Command.DISPLAY_MODE, deadline=soon()) == b"\0"


def test_a_lost_reply_to_a_command_is_a_timeout_and_not_repeated(backend):
    link = open_link(backend)
    backend.inject(Fault.LOST_REPLY, on=Command.LED_CURRENT)
    with pytest.raises(DeviceTimeoutError, match=r"did not answer led current \(0x0B01\)"):
        link.write(Command.LED_CURRENT, bytes([250] * 3), deadline=soon())
    assert [command for command, _ in backend.board.history] == [Command.LED_CURRENT]


def test_a_stale_reply_is_dropped(backend):
    link = open_link(backend)
    backend.inject(Fault.STALE_REPLY)
    assert link.read(Command.VERSION, deadline=soon())[:4] == bytes([0, 0, 1, 4])


def test_a_late_reply_is_not_taken_for_that_to_the_next_question(backend):
    link = open_link(backend)
    backend.inject(Fault.LATE_REPLY)
    with pytest.raises(DeviceTimeoutError):
        link.write(Command.LED_ENABLE, b"\0", deadline=soon())
    assert link.read(Command.HARDWARE_STATUS, deadline=soon()) == b"\x01"


def test_a_reply_left_by_an_earlier_program_is_dropped(backend):
    # The very number that the first message of this program carries, with another answer.
    backend.leave_reply(bytes([0xC0, 1, 1, 0, 0x55]))
    link = open_link(backend)
    assert link.read(Command.HARDWARE_STATUS, deadline=soon()) == b"\x01"


def test_a_long_answer_spans_reports(backend):
    backend.board.display_mode = 1
    link = open_link(backend)
    entries = bytes(range(96)) * 4
    link.write(Command.MAILBOX_CONTROL, b"\x02", deadline=soon())
    link.write(Command.MAILBOX_ADDRESS, b"\x00", deadline=soon())
    link.write(Command.MAILBOX_DATA, entries, deadline=soon())
    assert link.read(Command.MAILBOX_DATA, deadline=soon()) == entries


@pytest.mark.parametrize("entries", [18, 96])
def test_a_short_report_anywhere_in_an_answer_is_refused(backend, entries):
    backend.board.display_mode = 1
    backend.board.patterns = {address: b"abc" for address in range(entries)}
    backend.board.mailbox = 2
    link = open_link(backend)
    backend.inject(Fault.TRUNCATED_REPORT, on=Command.MAILBOX_DATA)
    with pytest.raises(DeviceError, match="report of 10 bytes where 64 belong"):
        link.read(Command.MAILBOX_DATA, deadline=soon())


def test_a_board_that_chatters_does_not_hold_anybody_up(backend, monkeypatch):
    link = open_link(backend)

    def chatter(dev_handle, ep, intf, buff, timeout):
        buff[:5] = array("B", [0xC0, 200, 1, 0, 1])
        return 64

    monkeypatch.setattr(backend, "intr_read", chatter)
    with pytest.raises(DeviceTimeoutError, match="answers old questions only"):
        link.write(Command.LED_ENABLE, b"\0", deadline=soon())
    link.close()
    with pytest.raises(DeviceError, match="without being asked"):
        open_link(backend)


@given(st.data())
@hypothesis_settings(max_examples=60, deadline=None)
def test_any_bytes_from_a_board_end_in_a_picture_or_an_error_with_a_name(data):
    backend = SimulatedUsbBackend()
    read, garbled = backend.intr_read, data.draw(st.integers(0, 60), label="from")
    reports = 0

    def garble(dev_handle, ep, intf, buff, timeout):
        nonlocal reports
        length = read(dev_handle, ep, intf, buff, timeout)
        reports += 1
        if reports == garbled:
            content = data.draw(st.binary(min_size=0, max_size=64), label="report")
            # Most of all, what looks like an answer to the question.
            if data.draw(st.booleans(), label="keeps its header") and len(content) > 4:
                content = bytes(buff[:2]) + content[2:]
            buff[: len(content)] = array("B", content)
            length = len(content)
        return length

    backend.intr_read = garble
    settings = flash_settings(timeout_s=0.3, reply_timeout_s=0.05)
    try:
        with closing(settings.open(backend=backend)) as projector:
            projector.show(picture("fringe"))
            assert backend.board.lit
    except DeviceError:
        pass
    assert not backend.board.lit


def test_sequence_numbers_run_over(backend):
    link = open_link(backend)
    for _ in range(300):
        link.read(Command.DISPLAY_MODE, deadline=soon())


def test_a_passed_deadline_sends_nothing(backend):
    link = open_link(backend)
    before = backend.transfers
    with pytest.raises(DeviceTimeoutError):
        link.write(Command.LED_ENABLE, b"\0", deadline=Deadline.after(-1.0))
    assert backend.transfers == before


# Opening.


def test_without_permission_the_message_holds_the_udev_rule():
    backend = SimulatedUsbBackend(open_error=errno.EACCES)
    with pytest.raises(DeviceError, match="udev") as refused:
        flash_settings().open(backend=backend)
    assert 'ATTR{idVendor}=="0451", ATTR{idProduct}=="6401"' in str(refused.value)


def test_a_board_that_another_program_holds_is_said_to_be_in_use():
    backend = SimulatedUsbBackend(claim_error=errno.EBUSY)
    with pytest.raises(DeviceError, match="in use by another program"):
        flash_settings().open(backend=backend)
    assert backend.kernel_driver


def test_a_board_is_opened_once_at_a_time(projector, backend):
    with pytest.raises(DeviceError, match="in use by another program"):
        flash_settings().open(backend=backend)
    projector.close()
    flash_settings().open(backend=backend).close()


def test_no_board_and_another_address_are_said():
    with pytest.raises(DeviceError, match="no DLPC350 on the USB bus"):
        flash_settings().open(backend=SimulatedUsbBackend(unplug_after=0))
    with pytest.raises(DeviceError, match=r"no DLPC350 at 1:1 .*found: 3:7"):
        flash_settings(address="1:1").open(backend=SimulatedUsbBackend())


@pytest.mark.parametrize(
    ("board", "problem"),
    [
        (SimulatedDlpc350(version=(2, 0, 0)), "older than 3.0.0"),
        (SimulatedDlpc350(hardware_status=0), "not finished its own start"),
        (SimulatedDlpc350(hardware_status=1 | 64 | 128), "sequencer aborted, sequencer error"),
        (SimulatedDlpc350(hardware_status=1 | 4), "panel reset controller error"),
        (SimulatedDlpc350(system_status=0), "internal memory failed"),
        (SimulatedDlpc350(images_in_flash=5), "image 5 is not in the board's flash"),
    ],
)
def test_a_board_that_is_not_well_is_refused_and_dark(board, problem):
    backend = SimulatedUsbBackend(board=board)
    with pytest.raises(DeviceError, match=problem):
        flash_settings().open(backend=backend)
    assert not board.lit
    assert backend.kernel_driver


def test_a_board_in_standby_is_woken(backend):
    backend.board.standby = True
    flash_settings().open(backend=backend).close()
    assert not backend.board.standby


def test_find_tells_version_and_problem():
    (found,) = find(backend=SimulatedUsbBackend())
    assert (found.driver, found.address) == ("dlpc350", "3:7")
    assert found.model == "DLPC350, firmware 4.1.0"
    assert found.problem is None
    board = SimulatedDlpc350(hardware_status=1 | 128)
    (found,) = find(backend=SimulatedUsbBackend(board=board))
    assert "sequencer error" in (found.problem or "")
    (found,) = find(backend=SimulatedUsbBackend(open_error=errno.EACCES))
    assert "udev" in (found.problem or "")
    assert find(backend=SimulatedUsbBackend(unplug_after=0)) == []


def test_find_changes_nothing_about_the_board(backend):
    find(backend=backend)
    assert backend.board.history == []
    assert backend.kernel_driver


# LED currents.


def test_currents_above_the_safe_limit_are_refused():
    with pytest.raises(ValueError, match=r"led_currents.green = 136 is above the safe limit"):
        flash_settings(led_currents={"green": 136})
    raised = flash_settings(led_currents={"green": 136}, led_current_limits={"green": 150})
    assert raised.led_currents.green == 136


@pytest.mark.parametrize("inverted", [True, False])
def test_currents_follow_the_boards_polarity_and_unused_leds_get_none(inverted):
    backend = SimulatedUsbBackend(board=SimulatedDlpc350(inverted_currents=inverted))
    flash_settings(leds=["green"], led_currents={"green": 100}).open(backend=backend).close()
    expected = (255, 155, 255) if inverted else (0, 100, 0)
    assert backend.board.led_currents == expected


def test_only_the_chosen_leds_light_a_pattern(backend):
    projector = flash_settings(leds=["red", "blue"]).open(backend=backend)
    projector.show(picture("fringe"))
    assert backend.board.patterns[0][1] >> 4 == 0b101
    projector.close()


# Whole sequences.


def test_a_sequence_of_many_images_is_played_once(projector, backend):
    patterns = [FlashPattern(i % 12, 1, plane) for i in range(60) for plane in (0, 1)]
    projector.play(patterns, exposure_s=0.001, period_s=0.002)
    board = backend.board
    # Sixty indices need two reports.
    assert board.images == tuple(i % 12 for i in range(60))
    assert board.config == (119, 0, 119, 59)
    assert [bool(board.patterns[i][2] & 4) for i in range(4)] == [True, False, True, False]
    assert board.exposure_us == (1000, 2000)
    assert board.run == 2
    assert board.lit


def test_two_images_arrive_in_their_order(projector, backend):
    projector.play([FlashPattern(7, 8), FlashPattern(2, 8)], exposure_s=0.01, period_s=0.01)
    assert backend.board.images == (7, 2)


@pytest.mark.parametrize(
    ("patterns", "exposure_s", "period_s", "refusal"),
    [
        ([], 0.01, 0.01, "sequence of 0 patterns"),
        ([FlashPattern(0, 1)] * 129, 0.01, 0.01, "sequence of 129 patterns"),
        ([FlashPattern(i % 2, 1) for i in range(65)], 0.01, 0.01, "loads images 65 times"),
        ([FlashPattern(12, 1)], 0.01, 0.01, "image 12 is not in the board's flash"),
        ([FlashPattern(0, 1), FlashPattern(0, 8)], 0.001, 0.001, "8-bit patterns"),
        ([FlashPattern(0, 1)], 0.001, 0.0011, "must equal the exposure"),
    ],
)
def test_impossible_sequences_are_refused_before_anything_is_configured(
    projector, backend, patterns, exposure_s, period_s, refusal
):
    backend.board.history.clear()
    with pytest.raises(DeviceError, match=refusal):
        projector.play(patterns, exposure_s=exposure_s, period_s=period_s)
    written = {command for command, _ in backend.board.history}
    assert written <= {Command.LED_ENABLE, Command.PATTERN_RUN}


def test_what_the_board_finds_wrong_is_named(projector, backend):
    backend.board.images_in_flash = 2
    with pytest.raises(DeviceError, match="pattern number invalid"):
        projector.show(picture("fringe"))
    assert not backend.board.lit


# Pictures over the video input.


class Screen:
    """An inner projector that remembers what it was told."""

    def __init__(self, size=(912, 1140)) -> None:
        self.capabilities = ProjectorCapabilities("screen", *size, 1 / 60)
        self.shown: list[str] = []
        self.fail = False

    def show(self, projection, *, deadline=None):
        if self.fail:
            raise DeviceLostError("the window is gone")
        self.shown.append(projection.name)
        return time.monotonic()

    def blank(self):
        self.shown.append("black")

    def close(self):
        self.shown.append("closed")


def video_settings(timeout_s: float = 5.0) -> Dlpc350Settings:
    return Dlpc350Settings.model_validate(
        {
            "source": "video",
            "timeout_s": timeout_s,
            "screen": {"screen": "HDMI-1", "width": 912, "height": 1140},
        }
    )


def test_video_pictures_go_to_the_screen_with_the_leds_on(backend):
    screen = Screen()
    backend.board.display_mode = 1
    projector = Dlpc350Projector(open_link(backend), video_settings(), screen)
    assert not backend.board.lit
    projector.show(picture("fringe"))
    assert screen.shown[-1] == "fringe"
    assert backend.board.lit
    assert backend.board.display_mode == 0
    assert projector.capabilities.frame_period_s == 1 / 60
    projector.blank()
    assert screen.shown[-1] == "black"
    assert not backend.board.lit
    projector.close()
    assert screen.shown[-1] == "closed"


def test_a_lost_screen_puts_the_leds_out(backend):
    screen = Screen()
    projector = Dlpc350Projector(open_link(backend), video_settings(), screen)
    projector.show(picture("fringe"))
    screen.fail = True
    with pytest.raises(DeviceLostError, match="window"):
        projector.show(picture("fringe"))
    assert not backend.board.lit


def test_a_lost_board_blackens_the_screen(backend):
    screen = Screen()
    projector = Dlpc350Projector(open_link(backend), video_settings(), screen)
    projector.show(picture("fringe"))
    backend.unplug_after = backend.transfers
    with pytest.raises(DeviceLostError):
        projector.show(picture("fringe"))
    assert screen.shown[-1] == "black"


@pytest.mark.parametrize(
    ("signal", "refusal"),
    [((1280, 800), "receives a picture of 1280×800"), (None, "did not lock to its video input")],
)
def test_a_video_input_that_would_be_scaled_is_refused(backend, signal, refusal):
    backend.board.video_signal = signal
    with pytest.raises(DeviceError, match=refusal):
        Dlpc350Projector(open_link(backend), video_settings(timeout_s=1.0), Screen())
    assert not backend.board.lit


@pytest.mark.parametrize(
    ("takes_s", "complaint"), [(1.0, "the board did not wake in time"), (0.5, "no answer")]
)
def test_a_last_question_too_late_is_told_from_a_board_that_fell_silent(
    monkeypatch, takes_s, complaint
):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr("devices.deadline.time", SimpleNamespace(monotonic=lambda: clock.now))
    answers = iter([False])

    def ask() -> bool:
        for answer in answers:
            return answer
        clock.now += takes_s
        raise DeviceTimeoutError("no answer")

    with pytest.raises(DeviceTimeoutError, match=complaint):
        ask_until(ask, bool, deadline=Deadline(101.0), what="the board did not wake")
    assert clock.now == 100.0 + takes_s


def test_settings_name_the_table_that_is_missing():
    with pytest.raises(ValueError, match=r"\[projector.screen\]"):
        Dlpc350Settings(source="video")
    with pytest.raises(ValueError, match=r"\[\[projector.stored\]\]"):
        Dlpc350Settings(source="flash")


# The simulated board refuses what the real one refuses.


@pytest.fixture
def pattern_link(backend):
    backend.board.display_mode = 1
    return open_link(backend)


@pytest.mark.parametrize(
    ("command", "data"),
    [
        (Command.MAILBOX_ADDRESS, b"\0"),
        (Command.MAILBOX_DATA, b"\0\0\0"),
        (Command.PATTERN_RUN, b"\2"),
        (Command.PATTERN_RUN, b"\1"),
        (Command.DISPLAY_MODE, b"\7"),
        (Command.PATTERN_SOURCE, b"\1"),
        (Command.LED_ENABLE, b"\x10"),
    ],
)
def test_the_board_refuses_what_its_state_does_not_allow(pattern_link, command, data):
    with pytest.raises(DeviceError, match="NACK"):
        pattern_link.write(command, data, deadline=soon())


def test_the_board_refuses_patterns_in_video_mode_and_changes_while_running(backend, projector):
    link = projector._link
    projector.show(picture("fringe"))
    for command, data in ((Command.EXPOSURE, bytes(8)), (Command.DISPLAY_MODE, b"\0")):
        with pytest.raises(DeviceError, match="NACK"):
            link.write(command, data, deadline=soon())
    projector.blank()
    link.write(Command.DISPLAY_MODE, b"\0", deadline=soon())
    with pytest.raises(DeviceError, match="NACK"):
        link.write(Command.EXPOSURE, bytes(8), deadline=soon())


def test_the_board_refuses_a_wrong_length(backend):
    board = SimulatedDlpc350(display_mode=1)
    message = bytes([0x40, 1, 6, 0, 0x29, 0x1A]) + bytes(4)
    assert board.answer(message) == (False, b"")
    assert board.answer(bytes([0x40, 1, 2, 0, 0x99, 0x99])) == (False, b"")


@pytest.mark.parametrize(
    ("exposure", "period", "bits"),
    [
        (8332, 8332, ValidationStatus.EXPOSURE_OR_PERIOD_INVALID),
        (9000, 8999, ValidationStatus.EXPOSURE_OR_PERIOD_INVALID),
        (9000, 9229, ValidationStatus.DARK_TIME_TOO_SHORT),
        (9000, 9230, ValidationStatus(0)),
    ],
)
def test_the_board_validates_exposure_and_period(pattern_link, backend, exposure, period, bits):
    times = exposure.to_bytes(4, "little") + period.to_bytes(4, "little")
    for command, data in (
        (Command.PATTERN_CONFIG, bytes(4)),
        (Command.EXPOSURE, times),
        (Command.MAILBOX_CONTROL, b"\2"),
        (Command.MAILBOX_ADDRESS, b"\0"),
        (Command.MAILBOX_DATA, b"\x00\x78\x00"),
        (Command.MAILBOX_CONTROL, b"\0"),
        (Command.VALIDATE, b"\0"),
    ):
        pattern_link.write(command, data, deadline=soon())
    answers = [pattern_link.read(Command.VALIDATE, deadline=soon())[0] for _ in range(3)]
    assert answers == [128, 128, bits]
    if bits:
        with pytest.raises(DeviceError, match="NACK"):
            pattern_link.write(Command.PATTERN_RUN, b"\2", deadline=soon())


# An independent client of the same board.


@pytest.fixture
def pycrafter(backend, monkeypatch):
    client = pytest.importorskip("pycrafter4500")
    backend.kernel_driver = False
    search = usb.core.find
    monkeypatch.setattr(usb.core, "find", lambda **about: search(backend=backend, **about))
    return client


def test_an_independent_client_starts_and_stops_patterns(pycrafter, backend):
    pycrafter.pattern_mode(bit_depth=7, period=4600, led_color=0b010)
    board = backend.board
    assert (board.display_mode, board.source, board.run) == (1, 0, 2)
    assert board.exposure_us == (4600, 4600)
    assert board.config == (2, 1, 2, 0)
    assert board.validation == 0
    first, *rest = (board.patterns[address] for address in range(3))
    assert first == bytes([0 << 2 | 1, 0x27, 0])
    assert [entry[0] >> 2 for entry in rest] == [1, 2]
    pycrafter.video_mode()
    assert (board.display_mode, board.run) == (0, 0)


def test_an_independent_client_is_refused_as_the_board_would(pycrafter, backend):
    pycrafter.pattern_mode(bit_depth=8, period=4600)
    assert backend.board.validation == ValidationStatus.EXPOSURE_OR_PERIOD_INVALID
    assert backend.board.run == 0


def test_an_independent_client_powers_the_board_down_and_up(pycrafter, backend):
    pycrafter.power_down()
    assert backend.board.standby
    pycrafter.power_up()
    assert not backend.board.standby
