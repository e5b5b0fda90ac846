from __future__ import annotations

import pytest

from devices.errors import DeviceError
from devices.gphoto2.exposure_times import ExposureTimes, parse_exposure_time


@pytest.mark.parametrize(
    ("choice", "seconds"),
    [
        ("1/60", 1 / 60),
        ("1/8000", 1 / 8000),
        ("1/1.3", 1 / 1.3),
        ("10/25", 0.4),
        ("2.5", 2.5),
        ("30", 30.0),
        ("0.0166s", 0.0166),
        ("1/250 s", 1 / 250),
        ('0"3', 0.3),
        ('15"', 15.0),
        ("bulb", None),
        ("Bulb", None),
        ("Time", None),
        ("auto", None),
        ("x 1/200", None),
        ("1/0", None),
        ("0", None),
        ("-1", None),
        ("nan", None),
        ("60000000", None),
        ("", None),
    ],
)
def test_choices_of_all_makers_are_understood(choice, seconds):
    assert parse_exposure_time(choice) == (pytest.approx(seconds) if seconds else None)


def test_the_nearest_time_is_nearest_in_ratio():
    times = ExposureTimes(["bulb", "30", "1", "0.5", "1/4", "1/60"])
    assert times.range_s == pytest.approx((1 / 60, 30.0))
    # 5.4 is nearer to 1 in seconds, 30 and 1 are equally far in ratio at √30 = 5.48.
    assert times.nearest(5.4).choice == "1"
    assert times.nearest(5.6).choice == "30"
    assert times.nearest(0.36).choice == "0.5"


def test_a_list_without_times_is_refused():
    with pytest.raises(DeviceError, match=r"in seconds \(bulb, auto\); turn its mode dial to M"):
        ExposureTimes(["bulb", "auto"])
