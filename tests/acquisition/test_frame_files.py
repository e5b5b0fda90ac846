from __future__ import annotations

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from acquisition.errors import SessionError
from acquisition.frame_files import decode_frame, encode_frame

SIZES = [(1, 1), (1, 7), (7, 1), (2, 2), (3, 5), (129, 64), (240, 321)]


def pictures(shape, kind):
    random = np.random.default_rng(3)
    most = np.iinfo(kind).max
    rows, cols = np.indices(shape)
    yield np.zeros(shape, kind)
    yield np.full(shape, most, kind)
    yield random.integers(0, most + 1, shape).astype(kind)
    yield (most / 2 * (1 + np.sin(cols / 5.0))).astype(kind)
    yield (most / 2 * (1 + np.sin(rows / 5.0))).astype(kind)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", SIZES)
def test_frames_come_back_to_the_last_sample_from_two_independent_readers(shape, kind, tmp_path):
    for picture in pictures(shape, kind):
        content = encode_frame(picture, name="a")
        decoded = decode_frame(content, path=tmp_path)
        assert decoded.dtype == kind
        np.testing.assert_array_equal(decoded, picture)
        with Image.open(io.BytesIO(content)) as read:
            np.testing.assert_array_equal(np.array(read).astype(kind), picture)


def test_parts_of_arrays_are_frames_too(tmp_path):
    whole = np.arange(4000, dtype=np.uint16).reshape(40, 100)
    for picture in (whole[::2, 3:50:3], whole.T):
        decoded = decode_frame(encode_frame(picture, name="a"), path=tmp_path)
        np.testing.assert_array_equal(decoded, picture)


def test_the_file_is_one_zlib_stream_with_its_checksums():
    picture = np.random.default_rng(0).integers(0, 4096, (90, 60)).astype(np.uint16)
    content = encode_frame(picture, name="a")
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    kinds, place = [], 8
    while place < len(content):
        (length,) = struct.unpack_from(">I", content, place)
        part = content[place + 4 : place + 8 + length]
        (checksum,) = struct.unpack_from(">I", content, place + 8 + length)
        assert checksum == zlib.crc32(part)
        kinds.append(part[:4])
        if part[:4] == b"IDAT":
            coder = zlib.decompressobj()
            assert len(coder.decompress(part[4:])) == 90 * (1 + 2 * 60)
            assert coder.eof
            assert not coder.unused_data
        place += 12 + length
    assert kinds == [b"IHDR", b"IDAT", b"IEND"]


def test_large_frames_come_in_chunks_that_every_reader_takes(tmp_path, monkeypatch):
    monkeypatch.setattr("acquisition.frame_files._CHUNK_BYTES", 1000)
    picture = np.random.default_rng(0).integers(0, 65536, (50, 61)).astype(np.uint16)
    content = encode_frame(picture, name="a")
    lengths, place = [], 8
    while place < len(content):
        lengths.append(struct.unpack_from(">I", content, place)[0])
        place += 12 + lengths[-1]
    assert len(lengths) == 2 + 7
    assert max(lengths) == 1000
    np.testing.assert_array_equal(decode_frame(content, path=tmp_path), picture)
    with Image.open(io.BytesIO(content)) as read:
        np.testing.assert_array_equal(np.array(read), picture)


def test_nothing_warns_of_noise_that_fills_a_large_frame(tmp_path, capfd):
    picture = np.random.default_rng(0).integers(0, 65536, (1600, 2600)).astype(np.uint16)
    np.testing.assert_array_equal(
        decode_frame(encode_frame(picture, name="a"), path=tmp_path), picture
    )
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("along_rows", [True, False])
def test_noisy_fringes_take_no_more_room_than_with_a_general_encoder(along_rows):
    random = np.random.default_rng(1)
    fringe = 900 * (1 + np.cos(np.indices((300, 400))[int(along_rows)] * 0.4))
    picture = np.round(100 + fringe + random.normal(0, 6, fringe.shape)).astype(np.uint16)
    ours = len(encode_frame(picture, name="a"))
    theirs = len(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])
    assert ours < 1.02 * theirs


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((2, 2, 3), np.uint8),
        np.zeros((2, 2), np.float32),
        np.zeros((2, 2), np.int16),
        np.zeros((0, 2), np.uint8),
    ],
)
def test_what_is_no_frame_is_refused(picture):
    with pytest.raises(SessionError, match="frame x: "):
        encode_frame(picture, name="x")


def test_truncated_files_are_refused(tmp_path):
    content = encode_frame(np.ones((50, 60), np.uint16), name="a")
    with pytest.raises(SessionError, match="not a picture"):
        decode_frame(content[:20], path=tmp_path / "f.png")


def test_a_size_beyond_all_measure_and_nothing_at_all_are_refused(tmp_path):
    content = encode_frame(np.ones((50, 60), np.uint16), name="a")
    header = b"IHDR" + struct.pack(">II", 65536, 2**31 - 1) + content[24:29]
    huge = content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:]
    for damaged in (huge, b""):
        with pytest.raises(SessionError, match=r"f\.png: .*not a picture"):
            decode_frame(damaged, path=tmp_path / "f.png")
