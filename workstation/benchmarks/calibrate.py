"""Calibration against known captures and simulated boards: what it leaves, and what it predicts."""

from __future__ import annotations

import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from acquisition.plan import Imager
from calibration.board_relief import (
    BoardRelief,
    compare_reliefs,
    deviation_from_polynomial,
    reconstruct_board,
)
from calibration.board_shape import align_turned_views
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.cross_validation import fit_board_pose
from calibration.dense_solve import solve_densely
from calibration.lens import transform
from calibration.measured_views import MeasuredView, measure_view
from calibration.mrcal_solution import load_solution, stored_views
from calibration.mrcal_solve import resolve, solve_lenses, with_noise_of
from calibration.procam import ProcamCalibration, ProcamOptions, calibrate_procam
from calibration.rig_geometry import RigGeometry
from calibration.surface_samples import sample_surface
from calibration.uncertainty import RigCovariance
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.degenerate_boards import degenerate_records
from workstation.benchmarks.lights import light_records
from workstation.benchmarks.registration import registration_records
from workstation.benchmarks.simulated_boards import (
    BOARD,
    CAMERA,
    PROJECTOR,
    projection_errors,
    simulate_boards,
)
from workstation.board_poses import BoardPoses
from workstation.calibration_report import write_report
from workstation.rig_calibration import calibrate_rig

PROCAM_CAPTURE = "slstudio_procam"
FIGUEROA = "mrcal-figueroa"
PAPER_BOARD = Chessboard(columns=9, rows=13, square_mm=10.0)
DISTANCE_MM = 700.0
# Degree of a polynomial over the board beyond which no lens and no pose bends a surface.
_NO_LENS = 8
# Only gross errors of a detector with heavy tails: the stored solves left out three corners.
_FIGUEROA_OUTLIER_SIGMAS = 11.5


def bench(*, seeds: int = 20) -> list[Record]:
    """Real captures where IMPASTO_REAL_DATA names them, and simulated boards."""
    records = []
    data = os.environ.get("IMPASTO_REAL_DATA")
    if data:
        records += procam_records(Path(data) / PROCAM_CAPTURE)
        records += figueroa_records(Path(data) / FIGUEROA)
    records += simulation_records(seeds=seeds) + registration_records(seeds=seeds)
    records += light_records(seeds=seeds)
    return [*records, *degenerate_records(), time_record()]


def procam_records(folder: Path) -> list[Record]:
    """Each pose left out in turn, its board reconstructed densely."""
    measured, views, description_sizes = _measured_poses(folder)
    samples = [
        sample_surface(one.correspondence, view.pixels[0], name=view.name)
        for one, view in zip(measured, views, strict=True)
    ]
    stereo, reliefs, from_corners, expected = [], [], [], []
    for number, (one, view) in enumerate(zip(measured, views, strict=True)):
        rest = [n for n in range(len(views)) if n != number]
        calibration = _calibrated([views[n] for n in rest], description_sizes)
        stereo.append(calibration.solution.rms_per_point_px)
        start = calibration.working_distance_mm
        from_corners.append(_relief(one, view, calibration.rig, start))
        # Of three poses no view turns out gross, so the poses are those that were given.
        dense = solve_densely(
            calibration.rig,
            calibration.solution.rt_ref_board,
            PAPER_BOARD,
            [views[n].pixels[0] for n in rest],
            [samples[n] for n in rest],
        )
        reliefs.append(_relief(one, view, dense.rig, start))
        expected.append(_expected_scale_error(dense.rig, view))
    repeatability = compare_reliefs(reliefs)
    corners = compare_reliefs(from_corners).rms_mm
    scales = np.abs([relief.scale_error for relief in reliefs])
    ratio = max(relief.noise_over_predicted for relief in reliefs)

    def figure(
        name: str, value: float, unit: str, bound: float, each: NDArray[np.float64]
    ) -> Record:
        note = "poses left out in turn: " + ", ".join(f"{one:.4g}" for one in each)
        return Record(
            name=f"procam.{name}",
            value=float(value),
            unit=unit,
            bound=bound,
            sense=Sense.AT_MOST,
            runs=len(each),
            note=note,
        )

    rms, detrended = repeatability.rms_mm, repeatability.detrended_rms_mm
    noise = np.array([relief.noise_over_predicted for relief in reliefs])
    fast = np.array([deviation_from_polynomial(d, _NO_LENS) for d in repeatability.difference_mm])
    return [
        figure("stereo_px", max(stereo), "px", 0.30, np.array(stereo)),
        figure("repeatability_mm", rms.mean(), "mm", 0.020, rms),
        figure("repeatability_detrended_mm", detrended.mean(), "mm", 0.010, detrended),
        figure("heldout_noise_over_predicted", ratio, "", 1.1, noise),
        figure("scale_error", scales.max(), "", 0.0005, scales),
        figure("scale_error_expected", max(expected), "", 0.0005, np.array(expected)),
        figure("corners_repeatability_mm", corners.mean(), "mm", 0.020, corners),
        figure(
            "beyond_any_lens_mm",
            np.mean(fast),
            "mm",
            0.010,
            fast,
        ),
    ]


def _measured_poses(
    folder: Path,
) -> tuple[list[MeasuredView], list[BoardView], tuple[Imager, Imager]]:
    from acquisition.capture_description import read_description
    from acquisition.decoding import decode
    from acquisition.foreign_capture import find_capture, read_picture

    fixtures = Path(__file__).parents[2] / "fixtures" / "captures"
    description = read_description(fixtures / f"{PROCAM_CAPTURE}.toml")
    measured = []
    for number in range(1, 5):
        capture = find_capture(folder / f"calseq{number}", description)
        pictures = {name: read_picture(file) for name, file in capture.files.items()}
        correspondence = decode(capture.plan, pictures.__getitem__)
        # The steps of a whole period add up to even light.
        even = np.mean([np.asarray(picture, float) for picture in pictures.values()], axis=0)
        measured.append(measure_view(f"pose {number}", even, correspondence, PAPER_BOARD))
    sizes = (description.camera, description.projector)
    views = [one.view for one in measured]
    first = solve_lenses(views, PAPER_BOARD, list(sizes), model="LENSMODEL_OPENCV4")
    return measured, align_turned_views(first, views), sizes


def _calibrated(views: list[BoardView], sizes: tuple[Imager, Imager]) -> ProcamCalibration:
    return calibrate_procam(
        views,
        PAPER_BOARD,
        camera=sizes[0],
        projector=sizes[1],
        options=ProcamOptions(board_shape=True),
    )


def _relief(one: MeasuredView, view: BoardView, rig: RigGeometry, start_mm: float) -> BoardRelief:
    return reconstruct_board(
        one.correspondence, view.pixels[0], PAPER_BOARD, rig, start_mm=start_mm
    )


def _expected_scale_error(rig: RigGeometry, view: BoardView) -> float:
    """Standard error of the board's diagonals at a pose, as the rig's covariance predicts it."""
    assert rig.covariance is not None
    grid = BoardView("diagonals", (view.pixels[0],), (np.ones(view.pixels[0].shape[:2]),))
    pose = fit_board_pose((rig.camera,), np.zeros((1, 6)), grid, PAPER_BOARD.points).rt_ref_board
    ends = transform(pose, PAPER_BOARD.points[[0, -1, 0, -1], [0, -1, -1, 0]])
    lever = RigCovariance(rig, rig.covariance, 0.0).point_jacobian(ends)
    along = np.array([ends[0] - ends[1], ends[2] - ends[3]])
    squares = np.sum(along**2, axis=1, keepdims=True)
    by_rig = np.einsum("ki,kin->kn", along / squares, lever[[0, 2]] - lever[[1, 3]]).mean(axis=0)
    return float(np.sqrt(by_rig @ rig.covariance @ by_rig))


def figueroa_records(folder: Path) -> list[Record]:
    """Fresh solves of a wide lens from stored observations."""
    records = []
    for name, file, bound, outliers in (
        ("opencv8", "opencv8-0", 0.5513, 3),
        ("splined", "splined-0", 0.4305, 0),
    ):
        stored = load_solution(folder / f"{file}.cameramodel")
        views, lens = stored_views(stored), stored.lenses[0]
        rows, columns = stored.residuals_px.shape[2:4]
        board = Chessboard(columns=columns, rows=rows, square_mm=stored.square_mm)
        imager = Imager(width=lens.width, height=lens.height)
        fresh = solve_lenses(
            views,
            board,
            [imager],
            model=lens.model,
            outlier_sigmas=_FIGUEROA_OUTLIER_SIGMAS,
        )
        # With its own noise, data and regularisation weigh as they should.
        fresh = resolve(fresh, with_noise_of(fresh, views))
        weight = 1 / np.stack([view.sigma_px for view in views])[..., np.newaxis]
        rms = float(np.sqrt(np.mean((fresh.residuals_px * weight)[fresh.inliers] ** 2)))
        left_out = int(fresh.outliers.sum())
        record = Record(
            name=f"figueroa.{name}_px",
            value=rms,
            unit="px",
            bound=bound,
            sense=Sense.AT_MOST,
            note=f"{left_out} corners left out, {outliers} in the stored solve",
        )
        records.append(record)
    return records


def simulation_records(*, seeds: int) -> list[Record]:
    """True errors of projection over their predicted standard deviations."""
    whitened: list[list[NDArray[np.float64]]] = [[], []]
    projector_errors = []
    for seed in range(seeds):
        boards = simulate_boards(seed=seed)
        calibration = calibrate_procam(
            boards.views,
            BOARD,
            camera=CAMERA,
            projector=PROJECTOR,
            options=ProcamOptions(models=("LENSMODEL_OPENCV4",)),
        )
        for number in (0, 1):
            errors, white = projection_errors(
                calibration.solution, boards, number, distance_mm=DISTANCE_MM
            )
            whitened[number].append(white)
        projector_errors.append(np.linalg.norm(errors, axis=-1))
    records = [
        Record(
            name=f"uncertainty.{name}_spread",
            value=float(np.sqrt(np.mean(np.square(whitened[number])))),
            unit="",
            bound=(0.9, 1.1),
            sense=Sense.WITHIN,
            runs=seeds,
            note="root mean square over image and seeds",
        )
        for number, name in enumerate(("camera", "projector"))
    ]
    median = float(np.median(projector_errors))
    records.append(
        Record(
            name="uncertainty.projector_median_px",
            value=median,
            unit="px",
            bound=0.03,
            sense=Sense.AT_MOST,
            runs=seeds,
        )
    )
    return records


def time_record() -> Record:
    """Time of 40 boards: choice of model, solve, uncertainty maps, halves compared, report."""
    boards = simulate_boards(40, seed=1)
    poses = BoardPoses(tuple(boards.views), {}, BOARD, False, (), CAMERA, PROJECTOR, {})
    started, spent = time.perf_counter(), time.process_time()
    done = calibrate_rig(poses)
    with TemporaryDirectory() as folder:
        write_report(done, Path(folder))
    seconds, cpu = time.perf_counter() - started, time.process_time() - spent
    return Record(
        name="calibrate.seconds",
        value=seconds,
        unit="s",
        bound=60.0,
        sense=Sense.AT_MOST,
        note=f"40 boards, three lens models, maps, report; {cpu:.1f} s of the processor",
    )
