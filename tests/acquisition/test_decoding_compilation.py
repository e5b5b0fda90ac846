from __future__ import annotations

from acquisition.decoding_compilation import compile_decoding
from acquisition.fringe_kernels import advance, advance_fitted, fit_fringe, merge_exposures
from acquisition.gray_kernels import read_bits, weigh_bits


def test_every_kind_of_scan_is_compiled_for_both_sample_types():
    compile_decoding()
    for kernel in (advance, advance_fitted, fit_fringe, merge_exposures, read_bits, weigh_bits):
        compiled = len(kernel.signatures)
        assert compiled >= 1
        compile_decoding()
        assert len(kernel.signatures) == compiled
