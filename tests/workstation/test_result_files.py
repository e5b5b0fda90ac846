from __future__ import annotations

import hashlib
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
    digest = write_result(scan, tmp_path / "scan.npz")
    assert_same(read_result(tmp_path / "scan.npz", digest), scan)


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
    digest = write_result(value, tmp_path / "value.npz")
    assert_same(read_result(tmp_path / "value.npz", digest), value)


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
    digest = write_result(value, tmp_path / "value.npz")
    with pytest.raises(ResultFileError, match="none of Impasto's types"):
        read_result(tmp_path / "value.npz", digest)


@pytest.mark.parametrize(
    "name",
    ["os:system", "devices.errors:ImpastoError", "acquisition.decoding:decode", "devices:nothing"],
)
def test_names_of_other_things_make_nothing(tmp_path, name):
    tree = json.dumps({"dataclass": name, "fields": {}})
    np.savez(tmp_path / "value.npz", tree=np.array(tree))
    digest = hashlib.sha256((tmp_path / "value.npz").read_bytes()).hexdigest()
    with pytest.raises(ResultFileError):
        read_result(tmp_path / "value.npz", digest)


def test_any_other_bytes_are_noticed(tmp_path):
    file = tmp_path / "value.npz"
    digest = write_result({"a": np.arange(200), "b": (1, "text")}, file)
    content = file.read_bytes()
    for place in range(0, 8 * len(content), 37):
        changed = bytearray(content)
        changed[place // 8] ^= 1 << place % 8
        file.write_bytes(changed)
        with pytest.raises(ResultFileError, match="not what was written"):
            read_result(file, digest)
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(ResultFileError, match="not what was written"):
        read_result(file, digest)
    write_result({"a": np.arange(200), "b": (2, "text")}, file)
    with pytest.raises(ResultFileError, match="another result"):
        read_result(file, digest)
    with pytest.raises(ResultFileError, match="No such file"):
        read_result(tmp_path / "nothing.npz", digest)
