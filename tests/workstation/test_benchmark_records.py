from __future__ import annotations

import pytest

from workstation.benchmark_records import Record, Sense, print_records


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


def test_a_printed_note_stands_in_whole_words_below_its_figure(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    note = "of photographs kept out of the fit; their noise alone leaves 51.5 dB"
    print_records(
        [Record(name="a.b", value=1.0, unit="mm", bound=1.2, sense=Sense.AT_MOST, note=note)]
    )
    printed = capsys.readouterr().out
    heading, first, below = printed.index("figure"), printed.index("a.b"), printed.index("of photo")
    assert heading < first < below
    assert "at most 1.2" in printed
    assert " ".join(printed[below:].split()) == note
