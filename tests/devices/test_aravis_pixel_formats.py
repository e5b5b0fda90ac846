from __future__ import annotations

import fake_gv_camera as fake
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.aravis.pixel_formats import PIXEL_FORMATS, Packing, choose_pixel_format
from devices.errors import DeviceError


def bits_of(pixel_format, samples):
    """Bytes of a buffer, by the layouts' definition bit by bit."""
    if pixel_format.packing is Packing.PFNC:
        stream = [sample >> bit & 1 for sample in samples for bit in range(pixel_format.bits)]
        stream += [0] * (-len(stream) % 8)
        return bytes(
            sum(bit << k for k, bit in enumerate(stream[at : at + 8]))
            for at in range(0, len(stream), 8)
        )
    if pixel_format.packing is Packing.GIGE_VISION:
        low_bits = pixel_format.bits - 8
        out = bytearray()
        for at in range(0, len(samples), 2):
            pair = samples[at : at + 2]
            low = [sample & ((1 << low_bits) - 1) for sample in pair] + [0]
            out += bytes([pair[0] >> low_bits, low[0] | low[1] << 4])
            if len(pair) == 2:
                out.append(pair[1] >> low_bits)
        return bytes(out)
    width = 1 if pixel_format.bits == 8 else 2
    return b"".join(sample.to_bytes(width, "little") for sample in samples)


@pytest.mark.parametrize("name", sorted(PIXEL_FORMATS))
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), width=st.integers(1, 9), height=st.integers(1, 4))
def test_samples_come_out_of_every_layout(name, seed, width, height):
    pixel_format = PIXEL_FORMATS[name]
    random = np.random.default_rng(seed)
    samples = random.integers(0, pixel_format.saturation_level + 1, (height, width))
    samples.flat[0] = pixel_format.saturation_level
    data = bits_of(pixel_format, samples.ravel().tolist())
    image = pixel_format.decode(data, width=width, height=height)
    np.testing.assert_array_equal(image, samples)
    assert image.dtype == (np.uint8 if pixel_format.bits == 8 else np.uint16)
    assert image.flags.writeable


def test_codes_are_those_of_aravis():
    fake.require_aravis()
    from gi.repository import Aravis

    letters = {"GRBG": "GR", "RGGB": "RG", "GBRG": "GB", "BGGR": "BG"}
    suffixes = {Packing.NONE: "", Packing.GIGE_VISION: "_PACKED", Packing.PFNC: "P"}
    compared = 0
    for name, pixel_format in PIXEL_FORMATS.items():
        family = f"BAYER_{letters[pixel_format.bayer]}" if pixel_format.bayer else "MONO"
        constant = f"PIXEL_FORMAT_{family}_{pixel_format.bits}{suffixes[pixel_format.packing]}"
        if hasattr(Aravis, constant):
            assert getattr(Aravis, constant) == pixel_format.code, name
            compared += 1
        # Bits of a pixel stand in the third byte of every code.
        assert pixel_format.code >> 16 & 0xFF == pixel_format.bits_in_buffer, name
    assert compared >= 37


@pytest.mark.parametrize("change", [-1, 1])
def test_a_buffer_of_another_length_is_refused(change):
    data = bytes(4 * 3 * 2 + change)
    with pytest.raises(DeviceError, match=r"sent (23|25) bytes where 4×3 pixels of Mono12 take 24"):
        PIXEL_FORMATS["Mono12"].decode(data, width=4, height=3)


def test_padding_between_rows_is_left_out():
    rows = np.arange(12, dtype="<u2").reshape(3, 4)
    data = b"".join(row.tobytes() + b"\xff\xff" for row in rows)
    image = PIXEL_FORMATS["Mono10"].decode(data, width=4, height=3, row_padding=2)
    np.testing.assert_array_equal(image, rows)
    with pytest.raises(DeviceError, match="padding between rows"):
        PIXEL_FORMATS["Mono12p"].decode(bytes(21), width=4, height=3, row_padding=1)


def test_samples_aligned_to_the_high_bits_are_refused():
    shifted = (np.array([[1, 4095]], "<u2") << 4).tobytes()
    with pytest.raises(DeviceError, match=r"up to 65520 as Mono12, whose largest is 4095"):
        PIXEL_FORMATS["Mono12"].decode(shifted, width=2, height=1)


def test_the_deepest_raw_format_is_chosen_and_unpacked_before_packed():
    offered = ["Mono8", "RGB8", "Mono12Packed", "Mono12", "YUV422Packed"]
    assert choose_pixel_format(offered, None).name == "Mono12"
    assert choose_pixel_format(offered[:3], None).name == "Mono12Packed"
    assert choose_pixel_format(offered, "Mono8").name == "Mono8"


def test_processed_formats_are_refused_by_name():
    with pytest.raises(DeviceError, match=r"RGB8 is not one raw sample per pixel; usable: Mono8"):
        choose_pixel_format(["Mono8", "RGB8"], "RGB8")
    with pytest.raises(DeviceError, match=r"no raw pixel format \(it has RGB8, BGR8\)"):
        choose_pixel_format(["RGB8", "BGR8"], None)
