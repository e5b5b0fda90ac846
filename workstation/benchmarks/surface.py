"""Heights of simulated paintings against the truth, and the noise of a real relief."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory

from devices.simulated.rig import demo_rig
from workstation.benchmark_records import Record, Sense
from workstation.demonstration import measure_height_error, record_simulated_scan
from workstation.processing import process_session

RELIEF_CAPTURE = "slmaster_relief_mono"


def bench(*, seeds: int = 3) -> list[Record]:
    """Heights of simulated paintings against the truth, and the noise of a real relief."""
    errors = []
    with TemporaryDirectory() as folder:
        for seed in range(seeds):
            rig = demo_rig(seed=seed)
            session = Path(folder) / f"session-{seed}"
            record_simulated_scan(rig, session)
            errors.append(measure_height_error(process_session(session).copy, rig))
    ratio = sum(error.ratio for error in errors) / seeds
    spread = sum(error.spread for error in errors) / seeds
    records = [
        Record(
            name="surface.height_rms_over_predicted",
            value=ratio,
            unit="",
            bound=(0.8, 1.25),
            sense=Sense.WITHIN,
            runs=seeds,
            note="simulated small oil painting",
        ),
        Record(
            name="surface.z_spread",
            value=spread,
            unit="",
            bound=(0.95, 1.05),
            sense=Sense.WITHIN,
            runs=seeds,
            note="simulated small oil painting",
        ),
    ]
    data = os.environ.get("IMPASTO_REAL_DATA")
    if data:
        records.append(_relief_noise(Path(data) / RELIEF_CAPTURE))
    return records


def _relief_noise(capture: Path) -> Record:
    from acquisition.capture_description import read_description
    from acquisition.foreign_capture import find_capture, record_capture
    from calibration.opencv_files import read_rig_geometry

    fixtures = Path(__file__).parents[2] / "fixtures" / "captures"
    description = read_description(fixtures / f"{RELIEF_CAPTURE}.toml")
    names = description.calibration
    assert names is not None  # the fixture names one
    with TemporaryDirectory() as folder:
        rig = read_rig_geometry(
            capture / names.file, names, camera=description.camera, projector=description.projector
        )
        rig.save(Path(folder) / "calibration")
        found = find_capture(capture, description)
        record_capture(found, Path(folder) / "s", calibration=Path(folder) / "calibration")
        noise = process_session(Path(folder) / "s").surface.noise
    return Record(
        name="surface.relief_noise_over_predicted",
        value=noise.observed_mm / noise.predicted_mm,
        unit="",
        bound=1.2,
        sense=Sense.AT_MOST,
        note=f"plaster relief, {noise.observed_mm:.3f} mm observed",
    )
