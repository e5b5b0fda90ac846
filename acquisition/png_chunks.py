"""PNG files put so that OpenCV comes to an end with them.

OpenCV 4.11 looks for the first piece of the picture among a file's chunks (ISO/IEC 15948, 5.3),
and looks for ever where a chunk says that it is longer than eight million bytes: one of which the
length is damaged, or one that is the whole of a large picture, as some software writes it.
"""

from __future__ import annotations

import struct
import zlib

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PICTURE, _END = b"IDAT", b"IEND"
_AROUND = 12  # length, kind and checksum
_LONGEST = 1 << 22


def readable_png(content: bytes) -> bytes | None:
    """A picture's file as OpenCV can read it.

    Parameters
    ----------
    content : bytes
        Of a file of any format.

    Returns
    -------
    bytes or None
        The content itself where it is no PNG, or one of short chunks; the same picture in short
        ones otherwise; None where a PNG is cut off, or a chunk of it is longer than the file.
    """
    if not content.startswith(PNG_SIGNATURE):
        return content
    chunks = _places(content)
    if chunks is None:
        return None
    if max(stop - start for _, start, stop in chunks) <= _LONGEST:
        return content
    written = [PNG_SIGNATURE]
    for kind, start, stop in chunks:
        if stop - start <= _LONGEST:
            written.append(content[start - 8 : stop + 4])
        elif kind == _PICTURE:
            if struct.pack(">I", zlib.crc32(content[start - 4 : stop])) != content[stop : stop + 4]:
                return None
            pieces = (content[at : min(at + _LONGEST, stop)] for at in range(start, stop, _LONGEST))
            written += [png_chunk(kind, piece) for piece in pieces]
        # Others of that length describe the picture, and are not needed to see it.
    return b"".join(written)


def _places(content: bytes) -> list[tuple[bytes, int, int]] | None:
    """Kind of each chunk and where its data begin and end; None unless the last is the end's."""
    found = []
    at = len(PNG_SIGNATURE)
    while at + _AROUND <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        kind, start = content[at + 4 : at + 8], at + 8
        if start + length + 4 > len(content):
            return None
        found.append((kind, start, start + length))
        if kind == _END:
            return found
        at = start + length + 4
    return None


def png_chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk with its length and checksum."""
    checksum = zlib.crc32(data, zlib.crc32(kind))
    return b"".join((struct.pack(">I", len(data)), kind, data, struct.pack(">I", checksum)))
