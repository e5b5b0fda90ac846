from __future__ import annotations

import pytest

from workstation.benchmark_records import Record, Sense


@pytest.mark.parametrize(
    ("value", "bound", "sense", "holds"),
    [
        (1.0, 1.2, Sense.AT_MOST, True),
        (1.3, 1.2, Sense.AT_MOST, False),
        (1.0, 1.2, Sense.AT_LEAST, False),
        (1.3, 1.2, Sense.AT_LEAST, True),
        (1.0, (0.8, 1.2), Sense.WITHIN, True),
        (0.7, (0.8, 1.2), Sense.WITHIN, False),
        (float("nan"), (0.8, 1.2), Sense.WITHIN, False),
        (float("nan"), 1.2, Sense.AT_MOST, False),
    ],
)
def test_whether_a_bound_holds(value, bound, sense, holds):
    record = Record(name="a.b", value=value, unit="mm", bound=bound, sense=sense)
    assert record.holds is holds
    assert record.as_json()["holds"] is holds
    assert record.as_json()["sense"] == str(sense)
