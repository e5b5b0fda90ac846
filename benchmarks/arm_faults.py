"""Ten thousand scripts of faults against the light arm's driver, judged from the controller's side.

Run ``python benchmarks/arm_faults.py --json arm_faults.json``. Each script is drawn from its seed
alone (:func:`devices.simulated.arm_trials.draw_trial`), so any one can be looked at again by
``--first SEED --count 1``.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from devices.simulated.arm_trials import Verdict, draw_trial, run_trial
from workstation.benchmark_records import Record, Sense, print_records
from workstation.json_output import write_json

_SHOWN = 20


def judge(seed: int) -> tuple[int, Verdict, tuple[str, ...]]:
    trial = draw_trial(seed)
    return seed, run_trial(trial), tuple(type(fault).__name__ for fault in trial.faults)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10_000, help="number of scripts")
    parser.add_argument("--first", type=int, default=0, help="seed of the first script")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path, help="write the records to this file")
    arguments = parser.parse_args()

    seeds = range(arguments.first, arguments.first + arguments.count)
    outcomes: Counter[str] = Counter()
    faults: Counter[str] = Counter()
    wrong: list[tuple[int, Verdict]] = []
    start_s = time.perf_counter()
    with ProcessPoolExecutor(arguments.processes) as pool:
        for seed, verdict, kinds in pool.map(judge, seeds, chunksize=50):
            outcomes.update(verdict.outcomes)
            faults.update(kinds)
            if verdict.violations:
                wrong.append((seed, verdict))
    seconds = time.perf_counter() - start_s

    print(f"{len(seeds)} scripts, seeds {seeds.start} to {seeds.stop - 1}, in {seconds:.0f} s")
    print("operations ended: " + ", ".join(f"{name} {n}" for name, n in outcomes.most_common()))
    print("faults: " + ", ".join(f"{name} {n}" for name, n in faults.most_common()))
    for seed, verdict in wrong[:_SHOWN]:
        print(f"seed {seed}: {'; '.join(verdict.violations)}")
    records = [
        Record(
            name="arm.scripts",
            value=len(seeds),
            unit="",
            bound=arguments.count,
            sense=Sense.AT_LEAST,
            runs=len(seeds),
            note=f"{sum(outcomes.values())} operations, {sum(faults.values())} faults",
        ),
        Record(
            name="arm.violations",
            value=len(wrong),
            unit="scripts",
            bound=0,
            sense=Sense.AT_MOST,
            runs=len(seeds),
            note="moved outside its limits, lit while moving, too long, not stopped, or wrong",
        ),
        Record(
            name="arm.unnamed_errors",
            value=outcomes["unnamed"],
            unit="",
            bound=0,
            sense=Sense.AT_MOST,
            runs=sum(outcomes.values()),
            note="errors that are no DeviceError",
        ),
    ]
    print_records(records)
    if arguments.json is not None:
        write_json(arguments.json, [record.as_json() for record in records])
    sys.exit(0 if all(record.holds for record in records) else 1)


if __name__ == "__main__":
    main()
