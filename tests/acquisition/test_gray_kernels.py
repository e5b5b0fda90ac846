from __future__ import annotations

import fringe_reference as reference
import numpy as np
import pytest

from acquisition.gray_kernels import cell_centres, gray_to_cell, read_bits, weigh_bits


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("length", [1, 2, 7, 10])
def test_words_and_cells_agree_with_bit_by_bit_decoding(dtype, length):
    random = np.random.default_rng(length)
    pictures = random.integers(0, 255, (length, 5000)).astype(dtype)
    inverses = random.integers(0, 255, (length, 5000)).astype(dtype)
    words = np.full(5000, 77, np.int32)
    smallest, second = (np.full(5000, np.inf, np.float32) for _ in range(2))
    for bit in range(0, length, 2):
        both = bit + 1 < length
        other = bit + 1 if both else bit
        pair = (pictures[bit], inverses[bit], pictures[other], inverses[other])
        read_bits(words, bit == 0, *pair, both)
        weigh_bits(smallest, second, *pair, both)
    cells = reference.gray_cells((pictures > inverses).astype(np.int64))
    np.testing.assert_array_equal(gray_to_cell(words), cells)
    centres = np.empty(5000)
    cell_centres(words, 1.5, 4.0, centres)
    np.testing.assert_array_equal(centres, 1.5 + 4.0 * cells)
    contrasts = np.sort(np.abs(pictures.astype(float) - inverses), axis=0)
    np.testing.assert_array_equal(smallest, contrasts[0])
    np.testing.assert_array_equal(second, contrasts[1] if length > 1 else np.inf)
