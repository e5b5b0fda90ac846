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


@pytest.mark.parametrize("columns", [30, 80, 120])
def test_a_printed_name_is_never_cut_and_its_note_stands_in_whole_words(
    columns, capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", str(columns))
    name = "pipeline.skip.lobes_of_diffuse_texels.torture.height_error"
    note = "of photographs kept out of the fit; their noise alone leaves 51.5 dB"
    bound = (0.8, 1.2)
    print_records(
        [
            Record(name=name, value=1.0, unit="[m]", bound=bound, sense=Sense.WITHIN, note=note),
            Record(name="b", value=2.0, unit="µm", bound=1.2, sense=Sense.AT_MOST),
        ]
    )
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    measured = "1 [m] within 0.8 to 1.2 yes"
    if columns > 100:
        assert lines[1] == f"{name} {measured}"
    else:
        assert lines[2:4] == [name, measured]
    assert lines[-1].endswith("2 µm at most 1.2 NO")
    said = " ".join(lines)
    assert said[said.index("of photo") :].startswith(f"{note} b")
