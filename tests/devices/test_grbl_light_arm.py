"""The light arm's driver on a simulated line in virtual time."""

from __future__ import annotations

import math
import re

import pytest

from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError
from devices.grbl.codes import ALARMS
from devices.grbl.errors import (
    AlarmError,
    ArmResetError,
    ControllerSettingsError,
    DoorOpenError,
    LampError,
    NotGrblError,
    PositionUntrustedError,
    RefusedError,
    StopFailedError,
)
from devices.grbl.light_arm import GrblLightArm
from devices.grbl.settings import GrblSettings, LampOutput
from devices.interfaces import ArmPose
from devices.simulated.grbl_controller import Mounting, SimulatedGrblController
from devices.simulated.grbl_faults import (
    CommandGarbled,
    CommandLost,
    FallsSilent,
    LampSticks,
    Noise,
    RealtimeLost,
    ReplyLate,
    ReplyLost,
    ReplyRepeated,
    Unplugged,
)
from devices.simulated.grbl_memory import ARM_SETTINGS
from devices.simulated.grbl_port import VirtualClock, VirtualPort
from devices.simulated.grbl_state import Build
from devices.simulated.grbl_wire import SimulatedWire

# Lines from the host before the first operation: build, settings twice.
CONNECTING = 3
# Lines of a homing: the cycle, and the echo of a number.
HOMING = 3
# Lines before the one that moves: lights out, and the echo.
DARK = 3


class Desk:
    """An arm, what it hangs on, and a clock."""

    def __init__(
        self,
        *,
        stored=ARM_SETTINGS,
        faults=(),
        build=None,
        boot_s=None,
        mounting=None,
        before=None,
        **settings,
    ):
        self.clock = VirtualClock()
        lamp = settings.get("lamp", LampOutput.SPINDLE)
        self.controller = SimulatedGrblController(
            stored,
            build=build,
            mounting=mounting,
            lamp_outputs="F" if lamp is LampOutput.FLOOD else "SC",
        )
        if before is not None:
            before(self.controller)
        self.wire = SimulatedWire(self.controller, faults, boot_s=boot_s)
        self.arm = GrblLightArm(
            GrblSettings(port="simulated", **settings),
            open_port=self._open_port,
            clock=self.clock,
        )

    def _open_port(self):
        self.port = VirtualPort(self.wire, self.clock)
        return self.port

    def home(self):
        self.arm.home()
        return self

    @property
    def sent(self):
        return b"".join(attempt.data for attempt in self.wire.attempts)

    def happens_in_a_move(self, act, *, after_s=0.5):
        """Have something happen while the arm moves, as the wire is next looked at."""
        due = self.clock.now_s + after_s
        self.wire.later(due, lambda _: act())

    def passes(self, seconds):
        self.wire.pass_time(self.clock.now_s)
        self.clock.now_s += seconds


def pose(azimuth_deg, elevation_deg):
    return ArmPose(math.radians(azimuth_deg), math.radians(elevation_deg))


def degrees(angles):
    return [math.degrees(angles.azimuth), math.degrees(angles.elevation)]


def lit_while_moving(desk):
    return any(moment.moving and moment.lamp_on for moment in desk.controller.timeline)


def test_capabilities_come_from_the_controller():
    capabilities = Desk().arm.capabilities
    assert capabilities.model == "Grbl 1.1h"
    assert [math.degrees(angle) for angle in capabilities.limits.azimuth] == pytest.approx([1, 359])
    assert [math.degrees(angle) for angle in capabilities.limits.elevation] == pytest.approx(
        [1, 89]
    )
    assert math.degrees(capabilities.speed) == pytest.approx(1800 / 60)
    slower = Desk(feed_deg_per_s=10).arm.capabilities
    assert math.degrees(slower.speed) == pytest.approx(10)


def test_nothing_moves_before_homing():
    desk = Desk()
    assert desk.arm.pose is None
    with pytest.raises(PositionUntrustedError, match="not homed"):
        desk.arm.move_to(pose(10, 10))
    assert not any(moment.moving for moment in desk.controller.timeline)


@pytest.mark.parametrize("target", [(1, 1), (359, 89), (123.456, 45.678), (1, 89)])
def test_the_arm_stands_where_it_was_sent(target):
    desk = Desk().home()
    assert degrees(desk.arm.pose) == pytest.approx([1, 1], abs=1e-9)
    desk.arm.move_to(pose(*target))
    assert degrees(desk.controller.pose) == pytest.approx(target, abs=1e-3)
    assert degrees(desk.arm.pose) == pytest.approx(target, abs=1e-3)
    assert not desk.controller.moving


def test_ok_is_not_arrival():
    desk = Desk().home()
    start = desk.clock.now_s
    desk.arm.move_to(pose(181, 1))
    # 180 units at 50 per second, and the ramp of 50 / 120 s.
    assert desk.clock.now_s - start > 180 / 50 + 50 / 120
    assert desk.clock.now_s - start < 180 / 50 + 50 / 120 + 0.3


@pytest.mark.parametrize("target", [(0.5, 10), (359.5, 10), (10, 0.9), (10, 89.1), (math.nan, 1)])
def test_a_pose_outside_the_limits_is_refused_before_anything_is_sent(target):
    desk = Desk().home()
    sent = desk.sent
    with pytest.raises(DeviceError, match="outside the arm's limits"):
        desk.arm.move_to(pose(*target))
    assert desk.sent == sent
    assert desk.arm.pose is not None


def test_limits_of_the_rig_may_be_narrower_than_the_controllers():
    desk = Desk(azimuth_deg=(20, 300), elevation_deg=(5, 80)).home()
    with pytest.raises(DeviceError, match=r"20\.0° to 300\.0°"):
        desk.arm.move_to(pose(10, 45))
    with pytest.raises(ControllerSettingsError, match=r"\$131 to the true travel"):
        Desk(elevation_deg=(5, 120))


def test_angles_follow_the_mounting_whatever_the_firmware_counts_from():
    for options, switches in (("V", 3), ("V", 0), ("VZ", 3), ("VZ", 0)):
        desk = Desk(
            stored={**ARM_SETTINGS, 23: switches},
            build=Build(options=options),
            mounting=Mounting(degrees_at_switch=(-20, 100), degrees_per_unit=(0.5, -1)),
            azimuth_at_switch_deg=-20,
            elevation_at_switch_deg=100,
            azimuth_deg_per_unit=0.5,
            elevation_deg_per_unit=-1,
        ).home()
        limits = desk.arm.capabilities.limits
        (a, b), (c, d) = limits.azimuth, limits.elevation
        middle = ArmPose((a + b) / 2, c + (d - c) / 3)
        desk.arm.move_to(middle)
        assert degrees(desk.controller.pose) == pytest.approx(degrees(middle), abs=2e-3)


@pytest.mark.parametrize(
    "output", [LampOutput.SPINDLE, LampOutput.SPINDLE_REVERSE, LampOutput.FLOOD]
)
def test_the_lamp_is_lit_only_at_a_stand(output):
    desk = Desk(lamp=output).home()
    desk.arm.move_to(pose(60, 30))
    since = desk.arm.switch_lamp(True)
    assert desk.controller.lamp_on
    assert desk.arm.lamp_on
    assert since == pytest.approx(desk.clock.now_s, abs=1e-3)
    desk.arm.move_to(pose(90, 30))
    assert not desk.controller.lamp_on
    assert not desk.arm.lamp_on
    desk.arm.switch_lamp(True)
    desk.arm.switch_lamp(False)
    assert not desk.controller.lamp_on
    assert not lit_while_moving(desk)


def test_the_lamp_waits_until_it_is_constant():
    desk = Desk(lamp_settle_s=2.5).home()
    start = desk.clock.now_s
    since = desk.arm.switch_lamp(True)
    assert since - start >= 2.5


def test_power_is_a_share_of_the_spindles_range():
    desk = Desk(lamp_power=0.25).home()
    desk.arm.switch_lamp(True)
    assert b"M3S250\n" in desk.sent


def test_a_lamp_that_does_not_light_is_named_and_put_out():
    desk = Desk(faults=[LampSticks(command=CONNECTING)]).home()
    with pytest.raises(LampError, match="does not light"):
        desk.arm.switch_lamp(True)
    assert re.search(rb"!\x18M5M9S0\n\?+$", desk.sent)
    assert not desk.arm.lamp_on


def test_nothing_moves_under_a_lamp_that_does_not_go_out():
    desk = Desk().home()
    desk.arm.switch_lamp(True)
    desk.controller.stick_lamp()
    with pytest.raises(StopFailedError, match=r"stays lit.*cut the power"):
        desk.arm.move_to(pose(60, 30))
    with pytest.raises(StopFailedError):
        desk.arm.home()
    assert not lit_while_moving(desk)


def test_stop_leaves_an_idle_arm_its_position_and_puts_the_lamp_out():
    desk = Desk().home()
    desk.arm.move_to(pose(60, 30))
    desk.arm.switch_lamp(True)
    desk.arm.stop()
    desk.arm.stop()
    assert not desk.controller.lamp_on
    assert degrees(desk.arm.pose) == pytest.approx([60, 30], abs=1e-3)
    desk.arm.move_to(pose(61, 31))


def test_close_stops_and_is_harmless_again():
    desk = Desk().home()
    desk.arm.switch_lamp(True)
    desk.arm.close()
    desk.arm.close()
    desk.arm.stop()
    assert not desk.controller.lamp_on
    with pytest.raises(DeviceError, match="was closed"):
        desk.arm.home()


@pytest.mark.parametrize("code", [1, 3])
def test_an_alarm_in_a_move_is_named_and_needs_homing(code):
    desk = Desk().home()
    desk.happens_in_a_move(lambda: desk.controller.trip_alarm(code))
    with pytest.raises(AlarmError, match=ALARMS[code].name) as caught:
        desk.arm.move_to(pose(300, 60))
    assert caught.value.code == code
    assert desk.arm.pose is None
    assert not desk.controller.moving
    with pytest.raises(PositionUntrustedError, match="failed"):
        desk.arm.move_to(pose(10, 10))
    desk.arm.home()
    desk.arm.move_to(pose(10, 10))
    assert degrees(desk.controller.pose) == pytest.approx([10, 10], abs=1e-3)


def test_a_reset_that_nobody_asked_for_loses_the_position():
    desk = Desk().home()
    desk.happens_in_a_move(desk.controller.power_cycle)
    with pytest.raises(ArmResetError, match="started anew while moving"):
        desk.arm.move_to(pose(300, 60))
    assert desk.arm.pose is None


def test_a_reset_between_two_operations_is_noticed():
    desk = Desk().home()
    desk.arm.switch_lamp(True)
    desk.controller.power_cycle()
    desk.passes(1)
    assert desk.arm.pose is None
    assert not desk.arm.lamp_on
    with pytest.raises(PositionUntrustedError, match="by itself"):
        desk.arm.move_to(pose(10, 10))


def test_a_door_stops_the_arm():
    desk = Desk().home()
    desk.happens_in_a_move(desk.controller.open_door)
    with pytest.raises(DoorOpenError):
        desk.arm.move_to(pose(300, 60))
    assert not desk.controller.moving
    with pytest.raises(DoorOpenError):
        desk.arm.home()
    desk.controller.close_door()
    desk.arm.home()
    assert desk.arm.pose is not None


def test_a_hold_by_somebody_else_is_named():
    desk = Desk().home()
    desk.happens_in_a_move(lambda: desk.controller.receive(b"!"))
    with pytest.raises(DeviceError, match="somebody held it"):
        desk.arm.move_to(pose(300, 60))
    assert not desk.controller.moving


def test_a_move_that_is_not_done_in_time_is_stopped_where_it_is():
    desk = Desk().home()
    start = desk.clock.now_s
    with pytest.raises(DeviceTimeoutError, match="did not arrive in time"):
        desk.arm.move_to(pose(350, 60), deadline=Deadline(start + 1.0))
    assert desk.clock.now_s - start < 1.0 + desk.arm.longest_stop_s
    assert not desk.controller.moving
    assert 5 < degrees(desk.controller.pose)[0] < 100
    # Slowed down along the path, not cut: the controller raised no alarm.
    assert str(desk.controller.state) == "Idle"


def test_a_move_is_never_sent_twice():
    move = CONNECTING + HOMING + DARK
    desk = Desk(faults=[CommandLost(command=move)]).home()
    start = desk.clock.now_s
    with pytest.raises(DeviceError, match=r"stands still at azimuth 1\.00°"):
        desk.arm.move_to(pose(100, 60))
    assert desk.clock.now_s - start < 5
    assert desk.sent.count(b"$J=") == 1
    assert not any(moment.moving and not moment.homing for moment in desk.controller.timeline)


def test_readings_are_asked_for_again():
    faults = [
        *[ReplyLost(reply=reply) for reply in (3, 40, 80, 90)],
        RealtimeLost(command=6),
        RealtimeLost(command=9),
        ReplyRepeated(reply=95),
        Noise(reply=85, data=b"\xff\x00#"),
    ]
    desk = Desk(faults=faults).home()
    desk.arm.move_to(pose(20, 10))
    desk.arm.switch_lamp(True)
    assert degrees(desk.controller.pose) == pytest.approx([20, 10], abs=1e-3)
    assert desk.controller.lamp_on


def test_late_reports_do_not_tell_an_arrival_that_is_none():
    """Reports of where the arm stood come while it moves back there."""
    desk = Desk(faults=[ReplyLate(reply=reply, seconds=0.4) for reply in range(90, 400, 3)]).home()
    for target in [(30, 10), (1, 1), (30, 10), (1, 1)]:
        desk.arm.move_to(pose(*target))
        assert not desk.controller.moving
        assert degrees(desk.controller.pose) == pytest.approx(target, abs=1e-3)
        desk.arm.switch_lamp(True)
    assert not lit_while_moving(desk)


MOVE_LINE = "$J=G21G90G53X-19.000Y-20.000F12728"
QUICK = {**ARM_SETTINGS, 24: 600, 25: 3000, 26: 10, 110: 9000, 111: 9000, 120: 900, 121: 900}
QUICK |= {130: 50, 131: 40}


@pytest.mark.parametrize("place", range(len(MOVE_LINE)))
@pytest.mark.parametrize("options", ["V", "VZ"])
@pytest.mark.parametrize("lamp", [LampOutput.SPINDLE, LampOutput.FLOOD])
def test_no_altered_move_lights_the_lamp_or_passes_for_the_one_asked_for(place, options, lamp):
    for byte in b"38MSX":
        desk = Desk(stored=QUICK, build=Build(options=options), lamp=lamp).home()
        desk.arm.switch_lamp(True)
        move = desk.wire.commands + DARK
        desk.wire.faults.append(CommandGarbled(command=move, place=place, byte=byte))
        # With firmware that counts from home, X8.000 and Y3.000, which M would make commands.
        target = (9, 4) if options == "VZ" else (31, 20)
        try:
            desk.arm.move_to(pose(*target))
        except DeviceError:
            assert desk.arm.pose is None
            assert not desk.controller.moving
        else:
            assert degrees(desk.controller.pose) == pytest.approx(target, abs=0.06)
        assert not lit_while_moving(desk)


def test_a_silent_controller_is_an_error_within_its_time():
    for deaf in (False, True):
        desk = Desk(faults=[FallsSilent(command=CONNECTING + HOMING + DARK, deaf=deaf)]).home()
        start = desk.clock.now_s
        with pytest.raises(StopFailedError, match=r"did not report its status.*cut the power"):
            desk.arm.move_to(pose(300, 60))
        assert desk.clock.now_s - start < 2 + 3 + desk.arm.longest_stop_s
        desk.passes(20)
        desk.wire.pass_time(desk.clock.now_s)
        reached = degrees(desk.controller.pose)[0] > 299
        assert reached == deaf  # one that hears was stopped all the same


def test_an_unplugged_arm_can_be_homed_when_it_is_back():
    desk = Desk(
        faults=[Unplugged(command=CONNECTING + HOMING + DARK, delay_s=0.5, back_after_s=6)]
    ).home()
    with pytest.raises(StopFailedError, match=r"gone from simulated.*could not be told to stop"):
        desk.arm.move_to(pose(300, 60))
    with pytest.raises(DeviceError, match="plug the controller in"):
        desk.arm.home()
    desk.passes(10)
    desk.arm.home()
    desk.arm.move_to(pose(20, 20))
    assert degrees(desk.controller.pose) == pytest.approx([20, 20], abs=1e-3)


def test_a_port_whose_handle_died_is_opened_again_to_stop():
    desk = Desk().home()
    desk.happens_in_a_move(lambda: desk.port.close())
    with pytest.raises(DeviceLostError, match="gone"):
        desk.arm.move_to(pose(300, 60))
    assert not desk.controller.moving
    desk.arm.home()
    assert desk.arm.pose is not None


@pytest.mark.parametrize("boot_s", [None, 1.6])
def test_boards_that_start_anew_when_opened_and_boards_that_do_not(boot_s):
    desk = Desk(boot_s=boot_s).home()
    assert degrees(desk.arm.pose) == pytest.approx([1, 1])


def test_a_controller_locked_by_a_limit_is_woken():
    """It answers nothing, not even its status, until it is reset."""

    def hit_a_limit(controller):
        controller.trip_alarm(1)
        controller.advance(2.0)
        controller.replies()

    desk = Desk(before=hit_a_limit).home()
    assert degrees(desk.arm.pose) == pytest.approx([1, 1])


def test_a_board_that_lags_a_line_behind_is_understood():
    desk = Desk(build=Build(replies_lag=True)).home()
    desk.arm.move_to(pose(40, 20))
    desk.arm.switch_lamp(True)
    assert degrees(desk.controller.pose) == pytest.approx([40, 20], abs=1e-3)
    assert desk.controller.lamp_on


@pytest.mark.parametrize(
    ("number", "value", "match"),
    [
        (22, 0, r"\$22=1"),
        (20, 0, r"\$20=1"),
        (13, 1, r"\$13=0"),
        (10, 0, r"\$10=1"),
        (1, 25, r"\$1=255"),
        (32, 1, r"\$32=0"),
        (30, 0, r"\$30=1000"),
        (110, 0, r"\$110=0"),
        (25, 0, r"\$24 and \$25"),
        (131, 1.5, r"no travel.*\$131"),
    ],
)
def test_settings_that_do_not_fit_are_named_with_their_remedy(number, value, match):
    with pytest.raises(ControllerSettingsError, match=match):
        Desk(stored={**ARM_SETTINGS, number: value})


def test_a_balanced_arm_may_let_its_motors_go():
    assert Desk(stored={**ARM_SETTINGS, 1: 25}, motors_hold=False).arm.pose is None


def test_another_version_is_refused():
    with pytest.raises(NotGrblError, match=r"0\.9j"):
        Desk(build=Build(version="0.9j"), boot_s=0.5)


def test_silence_at_the_port_is_named():
    with pytest.raises(DeviceTimeoutError, match="power"):
        Desk(boot_s=100.0)


def test_settings_read_twice_alike_or_not_at_all():
    """A digit altered in one reading would move the soft limits unnoticed."""
    for reply in range(3, 37):
        desk = Desk(faults=[CommandLost(command=40), ReplyLost(reply=reply)])
        assert degrees(ArmPose(*[a[1] for a in vars(desk.arm.capabilities.limits).values()])) == (
            pytest.approx([359, 89])
        )


def test_unlock_lights_the_lamp_without_a_position():
    desk = Desk()
    with pytest.raises(RefusedError, match="locked"):
        desk.arm.switch_lamp(True)
    desk.arm.unlock()
    desk.arm.switch_lamp(True)
    assert desk.controller.lamp_on
    assert desk.arm.pose is None


def test_an_interruption_in_a_read_stops_the_arm_before_it_gets_out():
    desk = Desk().home()

    def interrupt():
        raise KeyboardInterrupt

    desk.happens_in_a_move(interrupt)
    with pytest.raises(KeyboardInterrupt):
        desk.arm.move_to(pose(300, 60))
    assert not desk.controller.moving
    assert desk.arm.pose is None
    desk.arm.stop()
    desk.arm.close()


def test_an_interruption_in_the_middle_of_a_line_leaves_no_half_of_it():
    """What is left of a broken line must not join the next one."""
    desk = Desk().home()
    line = desk.arm._talk.line
    whole = line.send_line

    def break_off(text):
        if "$J=" not in text:
            return whole(text)
        line._write(text.encode()[:-4])
        raise KeyboardInterrupt

    line.send_line = break_off
    with pytest.raises(KeyboardInterrupt):
        desk.arm.move_to(pose(300, 60))
    line.send_line = whole
    desk.arm.stop()
    desk.passes(5)
    assert degrees(desk.controller.pose) == pytest.approx([1, 1], abs=1e-3)
    desk.arm.home()
    desk.arm.move_to(pose(30, 30))


def test_homing_that_ends_elsewhere_is_refused():
    # Firmware as it comes homes Z first, then X and Y; here Y is left out.
    with pytest.raises(DeviceError, match="homing ended at"):
        Desk(build=Build(homing_cycles=((0,),))).home()
