"""Compile the numerical kernels once, at set-up, so that no first command waits for them.

Run as ``python -m workstation.precompilation``.
"""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

from acquisition.decoding_compilation import compile_decoding
from devices.simulated.rig import demo_rig
from devices.simulated.sensor import Sensor
from workstation.demonstration import record_simulated_scan
from workstation.processing import process_session
from workstation.reflectance_compilation import compile_reflectance


def compile_kernels() -> None:
    """Process a small simulated scan in each of the sample types that cameras deliver.

    The kernels of reflectance are compiled by another process meanwhile.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as other:
        reflectance = other.submit(compile_reflectance)
        compile_decoding()
        for bits in (8, 12):
            rig = demo_rig(camera_width=160, sensor=Sensor(bits=bits))
            with TemporaryDirectory() as folder:
                record_simulated_scan(rig, Path(folder) / "session")
                process_session(Path(folder) / "session")
        reflectance.result()


if __name__ == "__main__":
    compile_kernels()
