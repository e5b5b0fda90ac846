from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from calibration.lens import Lens
from calibration.rig_geometry import RigGeometry


def pytest_configure() -> None:
    # A shell that starts the tests in the background lets them ignore Ctrl-C, and so would every
    # command that they start and mean to interrupt.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def real_data() -> Path:
    folder = os.environ.get("IMPASTO_REAL_DATA")
    if not folder:
        pytest.skip("IMPASTO_REAL_DATA names no folder of real captures")
    return Path(folder)


@pytest.fixture
def rig_geometry() -> RigGeometry:
    camera = Lens(
        "LENSMODEL_OPENCV5",
        np.array([900.0, 905, 159, 118, -0.08, 0.05, 4e-4, -3e-4, 0.01]),
        320,
        240,
    )
    projector = Lens(
        "LENSMODEL_OPENCV5",
        np.array([1100.0, 1100, 250, 150, -0.05, 0.03, -5e-4, 2e-4, 0]),
        512,
        320,
    )
    return RigGeometry(camera, projector, np.array([0.02, 0.35, 0.01, -150.0, 6.0, 25.0]))


@pytest.fixture(params=[signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def ending_signal(request: pytest.FixtureRequest) -> signal.Signals:
    """A signal that ends commands: all but the one that ``nohup`` tells them to ignore."""
    if signal.getsignal(request.param) is signal.SIG_IGN:
        pytest.skip(f"the tests were started to ignore {request.param.name}")
    return signal.Signals(request.param)
