from __future__ import annotations

import math
from itertools import pairwise

import pytest

from devices.grbl.axes import read_axis, travel_time
from devices.simulated.grbl_controller import Mounting, SimulatedGrblController
from devices.simulated.grbl_memory import ARM_SETTINGS, FACTORY_SETTINGS
from devices.simulated.grbl_state import Build, State

WIDE = {**ARM_SETTINGS, 130: 360, 131: 90}


class Bench:
    """A controller with somebody who types at it."""

    def __init__(self, settings=WIDE, **options):
        self.controller = SimulatedGrblController(settings, **options)
        self.controller.replies()

    def say(self, *lines, seconds=0.01):
        for line in lines:
            self.controller.receive(line if isinstance(line, bytes) else line.encode() + b"\n")
        return self.wait(seconds)

    def wait(self, seconds):
        self.controller.advance(self.controller.now_s + seconds)
        return self.controller.replies()

    def status(self):
        (report,) = [line for line in self.say(b"?") if line.startswith("<")]
        return report

    def home(self):
        assert self.say("$H", seconds=60) == ["ok"]
        return self


def unlocked(settings=FACTORY_SETTINGS, **options):
    """A controller without homing or soft limits, ready for anything."""
    return Bench({**FACTORY_SETTINGS, **settings}, **options)


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("5", 1),
        ("GX", 2),
        ("$Q=1", 2),
        ("$55=1", 3),
        ("$110=-5", 4),
        ("$0=2", 6),
        ("$20=1", 10),
        ("G" + "1" * 90, 11),
        ("$J=G91X1", 22),
        ("$J=M3X1F10", 16),
        ("G7", 20),
        ("A5", 20),
        ("M7", 20),
        ("G0G1X1", 24),
        ("M3M5", 21),
        ("G90G91", 21),
        ("G1X1", 22),
        ("G21.5", 23),
        ("G0X1G92X2", 24),
        ("G0X1X2", 25),
        ("G92", 26),
        ("N10000001", 27),
        ("G4", 28),
        ("G80G53X1", 30),
        ("G80X1", 31),
        ("G0X1P2", 36),
        ("T256", 38),
        ("F-1", 4),
        ("S-1", 4),
    ],
)
def test_what_is_wrong_with_a_line_has_its_number(line, code):
    assert unlocked().say(line) == [f"error:{code}"]


def test_homing_and_locks_have_their_numbers():
    assert unlocked().say("$H") == ["error:5"]
    locked = Bench()
    assert locked.say("G0X1") == ["error:9"]
    assert locked.say("$X") == ["[MSG:Caution: Unlocked]", "ok"]
    assert locked.say("M5") == ["ok"]
    moving = unlocked()
    assert moving.say("G1X50F600", "$$", "$#") == ["ok", "error:8", "error:8"]


def test_ok_comes_when_a_move_is_queued_and_the_queue_holds_fifteen():
    bench = unlocked({10: 3})
    said = bench.say(*[f"G1X{k}F300" for k in range(1, 21)])
    assert said == ["ok"] * 15
    assert "Bf:0," in bench.status()
    assert "Run" in bench.status()
    assert bench.wait(600) == ["ok"] * 5
    assert bench.status().startswith("<Idle|MPos:20.000,0.000,0.000|Bf:15,128")


@pytest.mark.parametrize("target", [(120.0, 30.0), (5.0, 0.0), (-3.0, 60.0), (0.2, 0.1)])
def test_a_move_takes_the_time_of_its_ramps(target):
    settings = {**FACTORY_SETTINGS, **{n: ARM_SETTINGS[n] for n in (110, 111, 120, 121)}}
    bench = Bench(settings)
    bench.say(f"G1X{target[0]}Y{target[1]}F2000")
    bench.wait(100)
    moving = [moment.time_s for moment in bench.controller.timeline if moment.moving]
    axes = [
        read_axis(
            settings,
            name=letter,
            letter=letter,
            build_options="",
            degrees_per_unit=1,
            degrees_at_switch=0,
        )
        for letter in "XY"
    ]
    last = next(m.time_s for m in reversed(bench.controller.timeline) if not m.moving)
    assert last - moving[0] == pytest.approx(travel_time(axes, target, 2000 / 60), rel=1e-6)
    assert bench.controller.timeline[-1].moving is False


def test_no_axis_is_ever_faster_or_accelerates_more_than_it_may():
    settings = {**FACTORY_SETTINGS, 110: 3000, 111: 1200, 120: 100, 121: 40}
    bench = Bench(settings)
    bench.say("G1X30Y0F6000", "G1X30Y30", "G1X0Y31", "G1X0Y0", "G0X20Y20")
    places = []
    for _ in range(3000):
        bench.wait(0.005)
        places.append(bench.controller.timeline[-1].place)
    speeds = [
        [(b - a) / 0.005 for a, b in zip(first, second, strict=True)]
        for first, second in pairwise(places)
    ]
    assert max(abs(x) for x, _, _ in speeds) <= 50 + 1e-6
    assert max(abs(y) for _, y, _ in speeds) <= 20 + 1e-6
    assert max(abs(x) for x, _, _ in speeds) > 20
    assert not bench.controller.moving


def test_a_hold_stops_within_the_braking_distance_and_goes_on_only_when_it_stands():
    bench = unlocked({110: 3000, 120: 100})
    bench.say("G1X100F3000", seconds=1.0)
    before = bench.controller.timeline[-1].place[0]
    bench.say(b"!")
    assert bench.status().startswith("<Hold:1")
    bench.say(b"~")
    assert bench.status().startswith("<Hold:1")
    bench.wait(2)
    assert bench.status().startswith("<Hold:0")
    way = bench.controller.timeline[-1].place[0] - before
    assert way == pytest.approx(50 * 0.05 + 50**2 / 200, abs=0.6)
    bench.say(b"~", seconds=30)
    assert bench.status().startswith("<Idle|MPos:100.000,0.000,0.000")


def test_a_reset_in_a_move_cuts_it_loses_steps_and_locks():
    bench = unlocked({110: 3000, 120: 100})
    bench.say("M3S500", "G1X100F3000", seconds=1.0)
    said = bench.say(b"\x18", seconds=1.0)
    assert said == ["ALARM:3", "", "Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"]
    assert not bench.controller.moving
    assert not bench.controller.lamp_on
    counted = float(bench.status().split("MPos:")[1].split(",")[0])
    assert abs(bench.controller.timeline[-1].place[0] - 100 - counted) > 0.1


def test_homing_finds_the_switches_from_anywhere_and_is_silent_meanwhile():
    for place in [(-359.0, -89.0, 0.0), (-180.0, -45.0, 0.0), (-0.5, -0.5, 0.0)]:
        bench = Bench(place=place)
        assert bench.say("$H", b"?", seconds=0.1) == []
        said = bench.wait(60)
        assert said[-1] == "ok"
        assert said[0].startswith("<Home") or said[0].startswith("<Idle")
        assert bench.status().startswith("<Idle|MPos:-359.000,-89.000,0.000")
        assert bench.controller.timeline[-1].place[:2] == pytest.approx((-359, -89))
        pose = bench.controller.pose
        assert math.degrees(pose.azimuth) == pytest.approx(1)
        assert math.degrees(pose.elevation) == pytest.approx(1)


def test_firmware_whose_homing_sets_the_origin_counts_from_there():
    bench = Bench(build=Build(options="VZ")).home()
    assert bench.status().startswith("<Idle|MPos:0.000,0.000,0.000")
    assert math.degrees(bench.controller.pose.azimuth) == pytest.approx(1)
    bench.say("G53G1X100F3000", seconds=60)
    assert math.degrees(bench.controller.pose.azimuth) == pytest.approx(101)
    assert bench.say("G53G1X-1F3000") == ["ALARM:2"]


@pytest.mark.parametrize(
    ("options", "act", "code"),
    [
        ({"build": Build(active_inputs="X")}, None, 8),
        ({"place": (-10.0, 600.0, 0.0)}, None, 9),
        ({"build": Build(homing_cycles=((2,),))}, None, 9),
        ({}, lambda bench: bench.say(b"\x18"), 6),
        ({}, lambda bench: bench.controller.open_door(), 7),
    ],
)
def test_a_homing_that_fails_says_how(options, act, code):
    bench = Bench(**options)
    bench.say("$H", seconds=0.2)
    said = (act(bench) if act is not None else None) or []
    said += bench.wait(120)
    assert f"ALARM:{code}" in said
    assert not bench.controller.moving


def test_soft_limits_come_to_a_stand_first_and_then_lock_until_a_reset():
    bench = Bench().home()
    bench.say("G53G1X-200F3000", seconds=0.5)
    bench.say("G53G1X1")
    assert bench.wait(5) == ["ALARM:2", "[MSG:Reset to continue]"]
    assert bench.say(b"?", "$X") == []
    assert -359 < bench.controller.timeline[-1].place[0] < -200
    assert bench.say(b"\x18")[-1] == "[MSG:'$H'|'$X' to unlock]"


def test_hard_limits_stop_dead():
    bench = Bench({**WIDE, 21: 1, 20: 0}).home()
    said = bench.say("G53G1X-400F3000", seconds=20)
    assert said == ["ok", "ALARM:1", "[MSG:Reset to continue]"]
    assert bench.controller.timeline[-1].place[0] == pytest.approx(-360, abs=3)


def test_a_door_puts_the_lamp_out_and_a_resume_lights_it_again():
    bench = Bench().home()
    bench.say("M3S800")
    assert bench.controller.lamp_on
    bench.controller.open_door()
    assert bench.wait(0.1) == ["[MSG:Check Door]"]
    assert not bench.controller.lamp_on
    assert "<Door:1" in bench.status()
    assert "Pn:D" in bench.status()
    bench.controller.close_door()
    assert "<Door:0" in bench.status()
    bench.say(b"~", seconds=5)
    assert bench.controller.lamp_on
    assert bench.status().startswith("<Idle")


def test_a_jog_is_cancelled_where_it_is():
    bench = unlocked({110: 3000, 120: 100})
    assert bench.say("$J=G91X100F3000", seconds=0.5) == ["ok"]
    assert bench.status().startswith("<Jog")
    assert bench.say("G0X1") == ["error:9"]
    bench.say(b"\x85", seconds=3)
    assert bench.status().startswith("<Idle")
    start, end = (bench.controller.timeline[k].place[0] for k in (0, -1))
    assert 5 < end - start < 40


def test_outputs_wait_until_motion_has_ended():
    bench = unlocked({110: 3000, 120: 100})
    assert bench.say("G1X10F3000", "M3S100") == ["ok"]
    assert not bench.controller.lamp_on
    bench.wait(10)
    assert bench.controller.lamp_on
    assert not any(m.moving and m.lamp_on for m in bench.controller.timeline)


@pytest.mark.parametrize("line", ["M3S100", "M4S100", "M8"])
def test_outputs_are_told_in_the_next_report_but_one(line):
    bench = unlocked()
    bench.status()
    bench.status()
    bench.say(line)
    letter = {"M3": "S", "M4": "C", "M8": "F"}[line[:2]]
    assert any(f"A:{letter}>" in bench.status() for _ in range(2))
    assert bench.controller.lamp_on
    bench.say("M5M9")
    assert not bench.controller.lamp_on


def test_no_speed_is_no_light_on_the_spindle_output():
    bench = unlocked()
    bench.say("M3S0")
    assert not bench.controller.lamp_on


def test_units_and_relative_moves():
    bench = unlocked()
    bench.say("G20G91", "G1X1F100", "G21", "G1X-5.4Y2", seconds=60)
    assert bench.status().startswith("<Idle|MPos:20.000,2.000,0.000")
    bench.say("G90G92X0", "G1X1", seconds=60)
    assert bench.status().startswith("<Idle|MPos:21.000")


def test_offsets_and_overrides_come_seldom_and_never_together():
    bench = unlocked()
    reports = [bench.status() for _ in range(60)]
    offset = [k for k, report in enumerate(reports) if "WCO:" in report]
    overrides = [k for k, report in enumerate(reports) if "Ov:" in report]
    assert offset == [0, 10, 20, 30, 40, 50]
    assert overrides == [1, 11, 21, 31, 41, 51]


def test_feed_overrides_change_the_speed_at_once():
    bench = unlocked({110: 3000, 120: 1000})
    bench.say("G1X100F600", seconds=1.0)
    assert "FS:600," in bench.status()
    for _ in range(3):
        bench.say(b"\x91")
    assert "FS:780," in bench.status()
    bench.say(b"\x90")
    assert "FS:600," in bench.status()


def test_angles_follow_the_mounting():
    bench = Bench(
        mounting=Mounting(degrees_at_switch=(10, 95), degrees_per_unit=(0.5, -1.0))
    ).home()
    pose = bench.controller.pose
    assert math.degrees(pose.azimuth) == pytest.approx(10.5)
    assert math.degrees(pose.elevation) == pytest.approx(94)


def test_power_loss_forgets_where_it_stands():
    bench = Bench().home()
    bench.say("G53G1X-100F3000", seconds=30)
    bench.controller.power_cycle()
    assert bench.wait(0)[1].startswith("Grbl")
    assert bench.controller.state is State.ALARM
    assert "MPos:0.000" in bench.status()
    assert bench.controller.timeline[-1].place[0] == pytest.approx(-100)
