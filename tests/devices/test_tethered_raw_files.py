from __future__ import annotations

import numpy as np
import pytest
from digital_negative import digital_negative

from devices.bayer import BayerPattern
from devices.errors import DeviceError
from devices.gphoto2.configuration import is_raw_only
from devices.gphoto2.raw_file import decode_raw, is_jpeg

pytest.importorskip("rawpy")

# Fujifilm's X-Trans mosaic.
X_TRANS = "GGRGGBGGBGGRBRGRBGGGBGGRGGRGGBRBGBRG"


@pytest.fixture
def mosaic():
    return np.random.default_rng(5).integers(0, 16384, (48, 66)).astype(np.uint16)


@pytest.mark.parametrize("pattern", list(BayerPattern))
def test_a_raw_file_is_its_sensor_s_numbers(mosaic, pattern):
    data = digital_negative(mosaic, pattern=pattern, black=512, white=16383)
    picture = decode_raw(data, name="IMG_1.DNG")
    np.testing.assert_array_equal(picture.image, mosaic)
    assert picture.image.dtype == np.uint16
    assert picture.bayer == pattern
    assert picture.black_levels == (512, 512, 512, 512)
    assert picture.white_level == 16383


def test_a_mosaic_that_is_no_bayer_pattern_is_refused(mosaic):
    with pytest.raises(DeviceError, match="mosaic is no Bayer pattern"):
        decode_raw(digital_negative(mosaic, pattern=X_TRANS), name="IMG_1.DNG")


@pytest.mark.parametrize("kept", [0, 150, 1000, -2])
def test_a_file_that_is_cut_off_is_refused(mosaic, kept):
    data = digital_negative(mosaic)[:kept]
    with pytest.raises(DeviceError, match=rf"IMG_1.DNG \({len(data)} bytes\) cannot be decoded"):
        decode_raw(data, name="IMG_1.DNG")


def test_a_jpeg_is_known_by_its_content():
    jpeg = b"\xff\xd8\xff\xe0 and so on"
    assert is_jpeg(jpeg)
    with pytest.raises(DeviceError, match=r"IMG_1.CR2 is a JPEG"):
        decode_raw(jpeg, name="IMG_1.CR2")


@pytest.mark.parametrize(
    ("choice", "raw"),
    [
        ("RAW", True),
        ("NEF (Raw)", True),
        ("RAW + Large Fine JPEG", False),
        ("NEF+Basic", False),
        ("Large Fine JPEG", False),
        ("mRAW", False),
        ("sRAW1", False),
        ("cRAW", False),
        ("RAW+JPEG", False),
        ("TIFF (RGB)", False),
    ],
)
def test_only_the_full_raw_file_by_itself_will_do(choice, raw):
    assert is_raw_only(choice) is raw
