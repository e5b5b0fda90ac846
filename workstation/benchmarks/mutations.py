"""Random damage to files, by what they are: bytes, text, JSON and pictures.

Half the damage is blind (bits, spans, cuts), half keeps to the format and changes what it says:
values of another kind, numbers at the edge of their range, missing and doubled entries. The first
finds what a parser does not expect, the second what the code behind the parser does not.
"""

from __future__ import annotations

import json
import re
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

Mutation = Callable[[bytes, np.random.Generator], bytes]

_NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?")
# What a number in a text is replaced by: out of range, of another kind, or no number.
_ODD_TEXT = (
    *(b"0", b"-1", b"1", b"2", b"0.5", b"1e-320", b"-0.0", b"1e308", b"-1e308", b"1e999", b"nan"),
    *(
        b"inf",
        b"-inf",
        b"NaN",
        b"Infinity",
        b"2147483648",
        b"9223372036854775808",
        b"1" + b"0" * 40,
    ),
    *(b"", b'"0"', b"[]", b"{}", b"true", b"null", b"0x7f", b"1.2.3"),
)
_ODD_VALUES: tuple[Any, ...] = (
    *(0, -1, 1, 2, 0.5, -0.0, 1e308, -1e308, 1e-320, 1 << 31, 1 << 63, 10**40, float("nan")),
    *(float("inf"), "", "0", "../../x", "\0", "ä" * 300, [], {}, [[]], None, True, [0] * 1000),
)


def mutate_bytes(content: bytes, random: np.random.Generator) -> bytes:
    """Flip bits, overwrite, cut, double, move or insert a span, or cut the end off."""
    changed = bytearray(content)
    length = len(changed)
    start = int(random.integers(0, length + 1))
    span = slice(start, start + int(min(2 ** random.integers(0, 10), length - start)))
    match int(random.integers(0, 7)):
        case 0:
            for at in random.integers(0, max(length, 1), random.integers(1, 4)):
                changed[at : at + 1] = bytes(
                    b ^ (1 << random.integers(0, 8)) for b in changed[at : at + 1]
                )
        case 1:
            changed[span] = random.bytes(span.stop - span.start)
        case 2:
            del changed[span]
        case 3:
            changed[start:start] = changed[span]
        case 4:
            other = int(random.integers(0, length + 1))
            changed[other:other] = changed[span]
        case 5:
            changed[start:start] = random.bytes(int(2 ** random.integers(0, 6)))
        case _:
            del changed[start:]
    return bytes(changed)


def mutate_text(content: bytes, random: np.random.Generator) -> bytes:
    """Replace numbers, or remove, double, swap or cut lines."""
    numbers = list(_NUMBER.finditer(content))
    if numbers and random.random() < 0.6:
        for _ in range(int(random.integers(1, 3))):
            found = numbers[random.integers(len(numbers))]
            odd = _ODD_TEXT[random.integers(len(_ODD_TEXT))]
            content = content[: found.start()] + odd + content[found.end() :]
            numbers = list(_NUMBER.finditer(content)) or numbers
        return content
    lines = content.split(b"\n")
    at, other = (int(i) for i in random.integers(0, len(lines), 2))
    match int(random.integers(0, 4)):
        case 0:
            del lines[at]
        case 1:
            lines.insert(other, lines[at])
        case 2:
            lines[at], lines[other] = lines[other], lines[at]
        case _:
            lines[at] = lines[at][: random.integers(0, len(lines[at]) + 1)]
    return b"\n".join(lines)


def mutate_json(content: bytes, random: np.random.Generator) -> bytes:
    """Change one value, key or entry of a JSON document and write it anew."""
    document = json.loads(content)
    places = list(_places(document))
    if places:
        container, key = places[random.integers(len(places))]
        match int(random.integers(0, 5)):
            case 0:
                del container[key]
            case 1 if isinstance(container, dict):
                container[f"{key}x"] = container.pop(key)
            case 1:
                container.insert(key, container[key])
            case 2:
                other, its = places[random.integers(len(places))]
                if not _holds(container[key], other):
                    other[its] = container[key]
            case _:
                container[key] = _ODD_VALUES[random.integers(len(_ODD_VALUES))]
    return json.dumps(document).encode("utf-8", "surrogatepass")


def mutate_png(content: bytes, random: np.random.Generator) -> bytes:
    """Change a chunk of a PNG picture and give it a checksum that fits."""
    chunks = _png_chunks(content)
    at = int(random.integers(len(chunks)))
    kind, data = chunks[at]
    match int(random.integers(0, 5)):
        case 0:
            del chunks[at]
        case 1:
            chunks.insert(int(random.integers(len(chunks))), chunks[at])
        case 2 if kind == b"IHDR":
            sizes = [struct.pack(">I", n) for n in (0, 1, 7, 65, 1 << 16, (1 << 31) - 1)]
            width, height = (sizes[i] for i in random.integers(0, len(sizes), 2))
            chunks[at] = kind, width + height + data[8:]
        case 2 if kind == b"IDAT":
            chunks[at] = kind, zlib.compress(_recoded(data, random))
        case _:
            chunks[at] = kind, mutate_bytes(data, random)
    written = [
        struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks
    ]
    return content[:8] + b"".join(written)


def mutate_exr(content: bytes, random: np.random.Generator) -> bytes:
    """Change values, size, type or name of a channel of an OpenEXR picture and write it anew."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.exr"
        path.write_bytes(content)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(c.pixels) for name, c in file.channels().items()}
        name = sorted(channels)[random.integers(len(channels))]
        values = channels.pop(name)
        match int(random.integers(0, 6)):
            case 0:
                channels[f"{name}x"] = values
            case 1:
                channels[name] = values.astype(
                    (np.float16, np.float32, np.uint32)[random.integers(3)]
                )
            case 2:
                channels = {n: c[: len(c) // 2] for n, c in (channels | {name: values}).items()}
            case _:
                odd = (np.nan, np.inf, -np.inf, 0.0, -1.0, 65504.0, 6e-8)[random.integers(7)]
                share = (1.0, 0.1, 1 / values.size)[random.integers(3)]
                channels[name] = np.where(random.random(values.shape) < share, odd, values).astype(
                    values.dtype
                )
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with np.errstate(all="ignore"):
            OpenEXR.File(header, channels).write(str(path))
        return path.read_bytes()


def _recoded(data: bytes, random: np.random.Generator) -> bytes:
    try:
        return mutate_bytes(zlib.decompress(data), random)
    except zlib.error:
        return data


def _png_chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    chunks, at = [], 8
    while at < len(content):
        (length,) = struct.unpack_from(">I", content, at)
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    return chunks


def _places(document: Any) -> list[tuple[Any, Any]]:
    """Every value of a document as its container and key."""
    found: list[tuple[Any, Any]] = []
    todo = [document]
    while todo:
        container = todo.pop()
        if isinstance(container, dict | list):
            keys = list(container) if isinstance(container, dict) else range(len(container))
            found += [(container, key) for key in keys]
            todo += [container[key] for key in keys]
    return found


def _holds(value: Any, container: Any) -> bool:
    """Whether a container is the value or lies within it: it cannot be put into itself."""
    return value is container or any(inner[key] is container for inner, key in _places(value))
