"""Time of frames of the simulated rig: patterns, and light-arm frames with cast shadows.

Run as ``python benchmarks/simulated_rig.py [--painting oil] [--json FILE]``. Frames of three
megapixels, best of five after a first one that compiles and casts. A frame's time on the wall is
that of two cores only on a machine that does nothing else; the time of the processor, of which two
cores have twice as much, is the steadier figure.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from devices.bayer import BayerPattern
from devices.interfaces import ArmPose
from devices.simulated.rig import build_rig
from devices.simulated.settings import PaintingKind, SimulationSettings
from workstation.benchmark_records import Record, Sense, print_records

RUNS = 5


def best_of(action: Callable[[int], object]) -> tuple[float, float]:
    """Least seconds on the wall and of the processor."""
    wall, cpu = [], []
    for run in range(RUNS):
        started, busy = time.perf_counter(), time.process_time()
        action(run)
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - busy)
    return min(wall), min(cpu)


def bench(painting: PaintingKind) -> list[Record]:
    """Frame times of a painting, monochrome and through a mosaic."""
    records = []
    for bayer in (None, BayerPattern.RGGB):
        started = time.perf_counter()
        rig = build_rig(SimulationSettings(painting=painting, bayer=bayer))
        built = time.perf_counter() - started
        colour = "mono" if bayer is None else "bayer"
        panel = np.full(rig.projector.capabilities.size[::-1], 128, np.uint8)
        started = time.perf_counter()
        rig.scene.show(panel)
        rig.camera.capture(0.04)
        first = time.perf_counter() - started

        def pattern(run: int, rig=rig, panel=panel) -> None:
            rig.scene.show(np.roll(panel, run))
            rig.camera.capture(0.04)

        def lit(run: int, rig=rig) -> None:
            rig.arm.move_to(ArmPose(1.0 + run, 0.4))
            rig.arm.switch_lamp(True)
            rig.camera.capture(0.04)

        shown = best_of(pattern)
        rig.projector.blank()
        rig.arm.home()
        lit(-1)
        under_lamp = best_of(lit)
        for name, seconds, bound in (
            ("pattern_frame_s", shown[0], 0.15),
            ("pattern_frame_cpu_s", shown[1], 0.3),
            ("lamp_frame_s", under_lamp[0], 1.0),
            ("lamp_frame_cpu_s", under_lamp[1], 2.0),
        ):
            records.append(
                Record(
                    name=f"simulated.{name}.{painting}.{colour}",
                    value=seconds,
                    unit="s",
                    bound=bound,
                    sense=Sense.AT_MOST,
                    runs=RUNS,
                )
            )
        print(f"{painting} {colour}: built in {built:.1f} s, first frame after {first:.1f} s")
    return records


def main() -> None:
    """Print the records, and write them where asked."""
    from workstation.json_output import write_json

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--painting", type=PaintingKind, default=PaintingKind.OIL)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    records = bench(options.painting)
    print_records(records)
    write_json(options.json, [record.as_json() for record in records])


if __name__ == "__main__":
    main()
