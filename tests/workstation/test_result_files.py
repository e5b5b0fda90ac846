from __future__ import annotations

import json
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path

import numpy as np
import pytest

from acquisition.correspondence import Rejection
from workstation.benchmarks.analytic_scans import scan_of, surface_rig
from workstation.result_files import ResultFileError, read_result, write_result


def assert_same(found, expected):
    assert type(found) is type(expected)
    if is_dataclass(expected):
        for field in fields(expected):
            assert_same(getattr(found, field.name), getattr(expected, field.name))
    elif isinstance(expected, np.ndarray):
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
    elif isinstance(expected, dict):
        assert list(found) == list(expected)
        for key, value in expected.items():
            assert_same(found[key], value)
    elif isinstance(expected, tuple | list):
        assert len(found) == len(expected)
        for a, b in zip(found, expected, strict=True):
            assert_same(a, b)
    elif isinstance(expected, float):
        np.testing.assert_equal(found, expected)
    else:
        assert found == expected


def test_a_correspondence_map_comes_back_bit_for_bit(tmp_path):
    scan = scan_of(surface_rig(48))
    write_result(scan, tmp_path / "scan.npz")
    assert_same(read_result(tmp_path / "scan.npz"), scan)


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        3,
        "text",
        0.1,
        float("nan"),
        -float("inf"),
        (1, (2.5, "a"), [None]),
        {"a": 1, 2: (3,)},
        Rejection.SATURATED | Rejection.OUTLIER,
        Path("a/b"),
        np.float32(0.1),
        np.zeros((0, 3), np.uint16),
    ],
    ids=repr,
)
def test_every_kind_of_value_comes_back(tmp_path, value):
    write_result(value, tmp_path / "value.npz")
    assert_same(read_result(tmp_path / "value.npz"), value)


@dataclass(frozen=True)
class NotOurs:
    value: int = 1


class Colour(Enum):
    RED = 1


@pytest.mark.parametrize(
    "value",
    [object(), {1, 2}, np.array([object()]), b"bytes"],
    ids=["object", "set", "array of objects", "bytes"],
)
def test_what_cannot_be_stored_is_refused_and_leaves_nothing(tmp_path, value):
    with pytest.raises(ResultFileError, match="cannot be stored"):
        write_result((1, value), tmp_path / "value.npz")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("value", [NotOurs(), Colour.RED], ids=["dataclass", "enum"])
def test_types_of_others_are_not_made(tmp_path, value):
    write_result(value, tmp_path / "value.npz")
    with pytest.raises(ResultFileError, match="none of Impasto's types"):
        read_result(tmp_path / "value.npz")


@pytest.mark.parametrize(
    "name",
    ["os:system", "devices.errors:ImpastoError", "acquisition.decoding:decode", "devices:nothing"],
)
def test_names_of_other_things_make_nothing(tmp_path, name):
    tree = json.dumps({"dataclass": name, "fields": {}})
    np.savez(tmp_path / "value.npz", tree=np.array(tree))
    with pytest.raises(ResultFileError):
        read_result(tmp_path / "value.npz")


def test_damage_is_noticed_wherever_it_is(tmp_path):
    file = tmp_path / "value.npz"
    value = {"a": np.arange(200), "b": (1, "text")}
    write_result(value, file)
    content = file.read_bytes()
    random = np.random.default_rng(0)
    for _ in range(200):
        changed = bytearray(content)
        changed[random.integers(len(content))] ^= 1 << random.integers(8)
        file.write_bytes(changed)
        try:
            found = read_result(file)
        except ResultFileError:
            continue
        # Dates and the like: what was read is what was written.
        assert_same(found, value)
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(ResultFileError, match="damaged"):
        read_result(file)
    with pytest.raises(ResultFileError, match="No such file"):
        read_result(tmp_path / "nothing.npz")
