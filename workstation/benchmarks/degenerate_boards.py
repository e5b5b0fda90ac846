"""Sets of boards that tell less than they seem to: each has to be refused or flagged by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calibration.board_views import BoardView
from calibration.gate_limits import Gate
from calibration.gates import KnownDistance, check_calibration
from calibration.procam import ProcamCalibration, ProcamOptions, calibrate_procam
from calibration.verdicts import GateReport
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.simulated_boards import (
    BOARD,
    CAMERA,
    PROJECTOR,
    simulate_boards,
    true_rig,
)

TRUE_BASELINE_MM = float(np.linalg.norm(true_rig()[1].rt_lens_ref[3:]))
BOW_MM = (0.8, 0.5)
"""Of :func:`warped_board`, along columns and rows."""
_POSES = 9


def good_boards() -> list[BoardView]:
    """Nothing is wrong with these."""
    return list(simulate_boards(_POSES, seed=1).views)


def parallel_boards() -> list[BoardView]:
    """All boards face the same way."""
    return list(simulate_boards(_POSES, seed=1, tilt=0.0).views)


def half_covered() -> list[BoardView]:
    """The right half of the camera's image sees no board."""
    return list(simulate_boards(_POSES, seed=1, region=0.1).views)


def other_end_in_one_lens() -> list[BoardView]:
    """Corners of pose 5 are counted from another end in the camera than in the projector."""
    views = good_boards()
    one, turned = views[4], views[4].turned()
    views[4] = BoardView(
        one.name, (turned.pixels[0], one.pixels[1]), (turned.sigma_px[0], one.sigma_px[1])
    )
    return views


def swapped_corners() -> list[BoardView]:
    """Two neighbours of pose 3 have changed places in the camera."""
    views = good_boards()
    one = views[2]
    pixels = one.pixels[0].copy()
    pixels[4, [5, 6]] = pixels[4, [6, 5]]
    views[2] = BoardView(one.name, (pixels, one.pixels[1]), one.sigma_px)
    return views


def warped_board() -> list[BoardView]:
    """The board is bent by :data:`BOW_MM`."""
    points = BOARD.points.copy()
    u, v = (points[..., k] / points[..., k].max() * 2 - 1 for k in (0, 1))
    points[..., 2] = BOW_MM[0] * (1 - u**2) + BOW_MM[1] * (1 - v**2)
    return list(simulate_boards(_POSES, seed=1, board_points=points).views)


def calibrated(views: list[BoardView]) -> ProcamCalibration:
    """A calibration from views of the simulated board."""
    return calibrate_procam(
        views,
        BOARD,
        camera=CAMERA,
        projector=PROJECTOR,
        options=ProcamOptions(models=("LENSMODEL_OPENCV4",)),
    )


def with_wrong_square(good: ProcamCalibration) -> GateReport:
    """What is said of squares given 1 % too large, where the baseline was measured."""
    # All lengths follow the square, so the same views with another one give a scaled rig.
    baseline = float(np.linalg.norm(good.rig.rt_proj_cam[3:]))
    wrong = replace(good, board=replace(BOARD, square_mm=1.01 * BOARD.square_mm))
    known = KnownDistance(1.01 * baseline, TRUE_BASELINE_MM, 0.2)
    return check_calibration(wrong, distances=[known])


@dataclass(frozen=True)
class _Degenerate:
    name: str
    report: Callable[[], GateReport]
    gate: Gate
    refused: bool
    said: str

    def found(self) -> bool:
        """Whether it is refused, or flagged, by its gate and in words that name it."""
        report = self.report()
        named = any(v.gate is self.gate and self.said in v.remedy for v in report.failures)
        return named and report.passed is not self.refused


def degenerate_records() -> list[Record]:
    """How many degenerate sets are found, and what is said of a good one."""
    good = calibrated(good_boards())

    def of(views: Callable[[], list[BoardView]]) -> Callable[[], GateReport]:
        return lambda: check_calibration(calibrated(views()))

    sets = (
        _Degenerate("parallel boards", of(parallel_boards), Gate.TILT, True, "nearly parallel"),
        _Degenerate("half uncovered", of(half_covered), Gate.COVERAGE, True, "fill the right"),
        _Degenerate(
            *("one lens from another end", of(other_end_in_one_lens), Gate.VIEWS, False),
            "pose 5 was left out",
        ),
        _Degenerate(
            "swapped corners", of(swapped_corners), Gate.VIEWS, False, "pose 3 was left out"
        ),
        _Degenerate(
            "wrong square", lambda: with_wrong_square(good), Gate.SCALE, True, "squares of 20.0"
        ),
        _Degenerate("warped board", of(warped_board), Gate.WARP, False, "warped by 1."),
    )
    found = {one.name: one.found() for one in sets}
    said = {name: "named" if held else "NOT NAMED" for name, held in found.items()}
    baseline = float(np.linalg.norm(good.rig.rt_proj_cam[3:]))
    known = KnownDistance(baseline, TRUE_BASELINE_MM, 0.2)
    failures = check_calibration(good, distances=[known]).failures
    return [
        Record(
            name="degenerate.named",
            value=float(sum(found.values())),
            unit="",
            bound=float(len(sets)),
            sense=Sense.AT_LEAST,
            runs=len(sets),
            note="; ".join(f"{name}: {what}" for name, what in said.items()),
        ),
        Record(
            name="degenerate.good_set_failures",
            value=float(len(failures)),
            unit="",
            bound=0.0,
            sense=Sense.AT_MOST,
            note="gates that the set fails from which the others are made",
        ),
    ]
