from __future__ import annotations

import struct
import zlib
from itertools import pairwise

import cv2
import numpy as np
import pytest

from acquisition.errors import CaptureError, SessionError
from acquisition.foreign_capture import read_picture
from acquisition.frame_files import decode_frame
from acquisition.png_chunks import PNG_SIGNATURE, png_chunk, readable_png


def png(image, *between, level=6, pieces=1):
    """A grey picture of 8 bits in so many pieces, other chunks before them."""
    rows, cols = image.shape
    data = zlib.compress(np.pad(image, ((0, 0), (1, 0))).tobytes(), level)
    cuts = np.linspace(0, len(data), pieces + 1).astype(int)
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", cols, rows, 8, 0, 0, 0, 0))
    parts = [png_chunk(b"IDAT", data[a:b]) for a, b in pairwise(cuts)]
    return b"".join((PNG_SIGNATURE, header, *between, *parts, png_chunk(b"IEND", b"")))


SMALL = np.arange(120, dtype=np.uint8).reshape(10, 12)


def test_what_opencv_reads_is_left_as_it_is():
    for content in (png(SMALL), png(SMALL, pieces=3), b"", b"II*\0 of another format"):
        assert readable_png(content) is content


def test_a_large_picture_in_one_piece_is_read(tmp_path):
    # More than the eight million bytes at which OpenCV stops to look.
    large = np.random.default_rng(0).integers(0, 256, (3000, 3000), np.uint8)
    content = png(large, png_chunk(b"tEXt", bytes(9_000_000)), level=0)
    path = tmp_path / "large.png"
    path.write_bytes(content)
    np.testing.assert_array_equal(read_picture(path), large)
    np.testing.assert_array_equal(decode_frame(content, path=path), large)
    flipped = bytearray(content)
    flipped[-1_000_000] ^= 1
    with pytest.raises(SessionError, match=r"large\.png: truncated, or not a picture"):
        decode_frame(bytes(flipped), path=path)


@pytest.mark.parametrize("length", [0x7FFFFFFF, 0xD7A45A31, 100_000])
def test_a_chunk_longer_than_its_file_is_refused(tmp_path, length):
    content = png(SMALL)
    content = content[:33] + struct.pack(">I", length) + content[37:]
    path = tmp_path / "damaged.png"
    path.write_bytes(content)
    with pytest.raises(CaptureError, match=r"damaged\.png: truncated, or not a picture"):
        read_picture(path)
    with pytest.raises(SessionError, match=r"damaged\.png"):
        decode_frame(content, path=path)


def test_a_picture_without_its_end_is_none():
    content = png(SMALL)
    assert readable_png(content[:-12]) is None
    assert readable_png(content[:40]) is None
    assert cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) is not None
