from __future__ import annotations

import numpy as np

from fitting.reflectance.elementary_functions import vector_exp, vector_log


def test_exponential_over_its_range():
    x = np.concatenate([np.linspace(-690, 690, 20001), [-1e-300, 0.0, 1e-17]])
    ours = np.array([vector_exp(v) for v in x])
    assert np.max(np.abs(ours / np.exp(x) - 1)) < 3e-12


def test_logarithm_of_normal_numbers():
    x = np.concatenate([np.logspace(-300, 300, 20001), 1 + np.linspace(-1e-3, 1e-3, 1001)])
    ours = np.array([vector_log(v) for v in x])
    assert np.max(np.abs(ours - np.log(x))) < 1e-11
