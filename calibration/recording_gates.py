"""Gates on what was recorded: tilts of the board, coverage of both imagers, and poses left out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from calibration.gate_limits import Gate, GateLimits
from calibration.lens import rotation
from calibration.procam import LENS_NAMES, ProcamCalibration
from calibration.verdicts import Criterion, Sense, Verdict

_CELLS = 4
# Of a side's cells.
_COVERED_SIDE = 0.5
_REFUSED_VIEWS_SHARE = 0.25


def normal_spread_deg(calibration: ProcamCalibration) -> NDArray[np.float64]:
    """Spread of the boards' normals along their widest and narrowest direction, degrees."""
    normals = np.array([rotation(rt)[:, 2] for rt in calibration.solution.rt_ref_board])
    normals *= np.sign(normals @ normals.sum(axis=0))[:, np.newaxis]
    values = np.linalg.svd(normals - normals.mean(axis=0), compute_uv=False)
    return np.degrees(values[:2] / np.sqrt(len(normals)))


def covered_cells(calibration: ProcamCalibration, number: int) -> NDArray[np.bool_]:
    """(4, 4) bool array: cells of a lens's imager in which corners took part."""
    lens = calibration.solution.lenses[number]
    kept = calibration.solution.inliers[:, number]
    pixels = np.stack([view.pixels[number] for view in calibration.views])[kept]
    cell = np.floor((pixels + 0.5) / [lens.width, lens.height] * _CELLS).astype(int)
    cell = cell[((cell >= 0) & (cell < _CELLS)).all(axis=1)]
    covered = np.zeros((_CELLS, _CELLS), bool)
    covered[cell[:, 1], cell[:, 0]] = True
    return covered


def tilt_verdict(calibration: ProcamCalibration, limits: GateLimits) -> Verdict:
    """Whether the boards are tilted enough to tell focal length and distance apart."""
    widest, narrowest = map(float, normal_spread_deg(calibration))
    return Verdict(
        Gate.TILT,
        (
            Criterion("widest spread of the normals, °", widest, limits.tilt_deg, Sense.AT_LEAST),
            Criterion("narrowest spread, °", narrowest, limits.tilt_deg / 3, Sense.AT_LEAST),
        ),
        f"the boards are nearly parallel, their normals spread over {widest:.1f}° and "
        f"{narrowest:.1f}° only, so focal length and distance cannot be told apart; record poses "
        f"{_missing_tilts(calibration)}, by 20° to 40°",
    )


def _missing_tilts(calibration: ProcamCalibration) -> str:
    normals = np.array([rotation(rt)[:, 2] for rt in calibration.solution.rt_ref_board])
    normals *= -np.sign(normals[:, 2:])
    limit = np.sin(np.radians(8))
    sides = (
        ("to the left", normals[:, 0] < -limit),
        ("to the right", normals[:, 0] > limit),
        ("upwards", normals[:, 1] < -limit),
        ("downwards", normals[:, 1] > limit),
    )
    missing = [name for name, there in sides if not there.any()]
    return "tilted " + (" and ".join(missing) if missing else "more, in all four directions")


def coverage_verdict(calibration: ProcamCalibration, number: int, limits: GateLimits) -> Verdict:
    """Whether corners were seen all over a lens's imager."""
    covered = covered_cells(calibration, number)
    share = float(covered.mean())
    half = _CELLS // 2
    sides = (
        ("left", covered[:, :half]),
        ("right", covered[:, half:]),
        ("top", covered[:half]),
        ("bottom", covered[half:]),
    )
    shares = {name: float(cells.mean()) for name, cells in sides}
    bare = [name for name, found in shares.items() if found < _COVERED_SIDE]
    part = f"the {' and the '.join(bare)}" if bare else "the corners of the image"
    criteria = [Criterion("share of the image", share, limits.covered_share, Sense.AT_LEAST)]
    criteria += [
        Criterion(f"share of its {name} half", found, _COVERED_SIDE, Sense.AT_LEAST)
        for name, found in shares.items()
    ]
    return Verdict(
        Gate.COVERAGE,
        tuple(criteria),
        f"corners were seen in {share:.0%} of the {LENS_NAMES[number]}'s image; record poses that "
        f"fill {part} of it",
        LENS_NAMES[number],
    )


def views_verdict(calibration: ProcamCalibration, unread: Mapping[str, str]) -> Verdict:
    """Which poses took no part, and why; those without a board are given by name."""
    rejected = calibration.rejected_views
    solved = len(rejected) + len(calibration.views)
    left = {view.name: view.why for view in rejected} | dict(unread)
    remedy = "; ".join(f"{name} was left out: {why}" for name, why in left.items())
    criteria = (
        Criterion("poses left out", float(len(left)), 0.0, refuses=False),
        Criterion(
            "share left out that contradicts the others",
            len(rejected) / max(solved, 1),
            _REFUSED_VIEWS_SHARE,
        ),
    )
    return Verdict(Gate.VIEWS, criteria, remedy)
