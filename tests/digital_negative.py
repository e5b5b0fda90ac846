"""Raw files made by code: a mosaic in the TIFF tags that make it a digital negative.

Source: TIFF 6.0; Adobe's Digital Negative Specification 1.4.
"""

from __future__ import annotations

import struct

import numpy as np

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _SIGNED_RATIONAL = 1, 2, 3, 4, 5, 10
_COLOURS = {"R": 0, "G": 1, "B": 2}
_STRIP_OFFSETS = 273


def digital_negative(
    image: np.ndarray, *, pattern: str = "RGGB", black: int = 64, white: int = 4095
) -> bytes:
    """A raw file that holds ``image``, a (rows, cols) uint16 array, uncompressed."""
    rows, cols = image.shape
    unity = [(int(i == j), 1) for i in range(3) for j in range(3)]
    size = round(len(pattern) ** 0.5)
    tags = {
        254: (_LONG, [0]),  # the full picture
        256: (_LONG, [cols]),
        257: (_LONG, [rows]),
        258: (_SHORT, [16]),
        259: (_SHORT, [1]),  # not compressed
        262: (_SHORT, [32803]),  # colour filter array
        271: (_ASCII, b"Impasto\0"),
        272: (_ASCII, b"Test camera\0"),
        _STRIP_OFFSETS: (_LONG, [0]),
        274: (_SHORT, [1]),
        277: (_SHORT, [1]),
        278: (_LONG, [rows]),
        279: (_LONG, [2 * rows * cols]),
        284: (_SHORT, [1]),
        33421: (_SHORT, [size, size]),
        33422: (_BYTE, bytes(_COLOURS[letter] for letter in pattern)),
        50706: (_BYTE, bytes([1, 4, 0, 0])),
        50707: (_BYTE, bytes([1, 1, 0, 0])),
        50708: (_ASCII, b"Impasto Test camera\0"),
        50714: (_SHORT, [black]),
        50717: (_LONG, [white]),
        50721: (_SIGNED_RATIONAL, unity),
        50728: (_RATIONAL, [(1, 1)] * 3),
        50778: (_SHORT, [21]),  # daylight
    }
    return _tiff(tags, image.astype("<u2").tobytes())


def _tiff(tags: dict, picture: bytes) -> bytes:
    values_at = 8 + 2 + 12 * len(tags) + 4
    values = b""
    fields = {}
    for tag, (kind, content) in sorted(tags.items()):
        data = _packed(kind, content)
        if len(data) > 4:
            fields[tag] = kind, len(content), struct.pack("<I", values_at + len(values))
            values += data + b"\0" * (len(data) % 2)
        else:
            fields[tag] = kind, len(content), data.ljust(4, b"\0")
    kind, count, _ = fields[_STRIP_OFFSETS]
    fields[_STRIP_OFFSETS] = kind, count, struct.pack("<I", values_at + len(values))
    directory = struct.pack("<H", len(fields))
    for tag, (kind, count, data) in fields.items():
        directory += struct.pack("<HHI", tag, kind, count) + data
    return struct.pack("<2sHI", b"II", 42, 8) + directory + b"\0" * 4 + values + picture


def _packed(kind: int, content: object) -> bytes:
    if isinstance(content, bytes):
        return content
    if kind in (_RATIONAL, _SIGNED_RATIONAL):
        return b"".join(struct.pack("<ii", *value) for value in content)
    return struct.pack(f"<{len(content)}{'H' if kind == _SHORT else 'I'}", *content)
