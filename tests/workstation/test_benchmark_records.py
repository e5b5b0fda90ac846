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


def test_printed_records_keep_long_names_whole_and_have_notes_in_whole_words(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    name = "pipeline.skip.lobes_of_diffuse_texels.torture.height_error"
    note = "of photographs kept out of the fit; their noise alone leaves 51.5 dB"
    print_records(
        [Record(name=name, value=1.0, unit="mm", bound=(0.8, 1.2), sense=Sense.WITHIN, note=note)]
    )
    printed = capsys.readouterr().out
    assert "1 mm within 0.8 to 1.2 yes" in " ".join(printed.split())
    # The name is folded where its column ends; the figure stands beside its start.
    start, below = printed.index("pipeline"), printed.index("of photo")
    shown = "".join(printed[start:below].split())
    assert shown.replace("1mmwithin0.8to1.2yes", "") == name
    assert " ".join(printed[below:].split()) == note
