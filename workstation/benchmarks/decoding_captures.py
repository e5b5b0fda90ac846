"""Decoding of real captures: wrong periods, swapped files, phase errors by gamma."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.capture_description import read_description
from acquisition.correspondence import CorrespondenceMap
from acquisition.decoding import DecodingOptions, decode
from acquisition.errors import DecodingError
from acquisition.foreign_capture import find_capture, read_picture
from acquisition.frame_files import Samples
from acquisition.patterns import Axis, Gray, PhaseShift
from acquisition.plan import Plan
from acquisition.robust_spread import robust_sigma
from workstation.benchmark_records import Record, Sense

_DESCRIPTIONS = Path(__file__).parents[2] / "fixtures" / "captures"
_BOARDS = ("calseq1", "calseq2", "calseq3", "calseq4")
_DEGREE = 5
_BLOCK = 12
_PHASE_ERROR_BOUND = 0.03


def bench_captures(data: Path) -> list[Record]:
    """Records of the captures under a folder of real data."""
    return [
        _wrong_periods_on_boards(data / "slstudio_procam"),
        *_relief(data / "slmaster_relief_mono"),
        _gamma(data / "kamino410_gamma_plane"),
    ]


def _load(folder: Path, name: str) -> tuple[Plan, dict[str, Samples]]:
    capture = find_capture(folder, read_description(_DESCRIPTIONS / f"{name}.toml"))
    return capture.plan, {key: read_picture(path) for key, path in capture.files.items()}


def _wrong_periods_on_boards(folder: Path) -> Record:
    """Pixels half a period or more off a smooth surface through each board."""
    wrong = accepted = pixels = 0
    for board in _BOARDS:
        plan, frames = _load(folder / board, "slstudio_procam")
        found = decode(plan, frames.__getitem__)
        valid = found.valid
        pixels += valid.size
        accepted += int(valid.sum())
        off = np.zeros(valid.shape, bool)
        for axis in found.axes.values():
            left = axis.coordinate - _smooth(axis.coordinate, valid)
            off |= np.abs(left) > axis.period_px / 2
        wrong += int((off & valid).sum())
    return Record(
        name="decode.accepted_wrong_period",
        value=wrong / accepted,
        unit="",
        bound=1e-4,
        sense=Sense.AT_MOST,
        runs=len(_BOARDS),
        note=f"{wrong} of {accepted} accepted pixels of four real boards (of {pixels}) are half a "
        f"period or more off a polynomial of degree {_DEGREE}, in either axis",
    )


def _smooth(coordinate: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """A polynomial through most of the pixels, robustly."""
    rows, cols = coordinate.shape
    v, u = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : cols * 1j]
    terms = np.stack(
        [u**i * v**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)], axis=-1
    )
    used, observed = terms[valid][::7], coordinate[valid][::7]
    keep = np.ones(len(observed), bool)
    for _ in range(8):
        solution = np.linalg.lstsq(used[keep], observed[keep], rcond=None)[0]
        left = np.abs(observed - used @ solution)
        keep = left < max(5 * robust_sigma(left[keep]), 3.0)
    return np.asarray(terms @ solution)


def _relief(folder: Path) -> list[Record]:
    plan, frames = _load(folder, "slmaster_relief_mono")
    found = decode(plan, frames.__getitem__)
    errors, checked = _period_errors(found)
    refused, worst = _swaps(plan, frames, found)
    return [
        Record(
            name="decode.relief_period_errors",
            value=errors,
            unit="pixels",
            bound=0.0,
            sense=Sense.AT_MOST,
            note=f"plaster relief: pixels three quarters of a period or more off the robust plane "
            f"of their block of {_BLOCK} × {_BLOCK} (a wrong period is a whole one off), of "
            f"{checked}",
        ),
        Record(
            name="decode.swapped_files_accepted",
            value=worst,
            unit="",
            bound=1e-3,
            sense=Sense.AT_MOST,
            runs=15,
            note=f"plaster relief, one axis: largest share of pixels accepted with another order "
            f"when two of its six Gray files are swapped; {refused} of 15 swaps are refused",
        ),
    ]


def _period_errors(found: CorrespondenceMap) -> tuple[int, int]:
    decoded = found.axes[Axis.COLUMN]
    errors = checked = 0
    rows, cols = found.shape
    v, u = np.mgrid[:_BLOCK, :_BLOCK] - (_BLOCK - 1) / 2
    plane = np.stack([np.ones_like(u), u, v], axis=-1)
    for row in range(0, rows - _BLOCK + 1, _BLOCK):
        for col in range(0, cols - _BLOCK + 1, _BLOCK):
            part = decoded.coordinate[row : row + _BLOCK, col : col + _BLOCK]
            there = np.isfinite(part)
            if there.sum() < 20:
                continue
            terms, observed = plane[there], part[there]
            weight = np.ones(len(observed))
            for _ in range(10):
                root = np.sqrt(weight)
                solution = np.linalg.lstsq(
                    terms * root[:, np.newaxis], observed * root, rcond=None
                )[0]
                weight = 1 / np.maximum(np.abs(observed - terms @ solution), 0.1)
            errors += int((np.abs(observed - terms @ solution) > 0.75 * decoded.period_px).sum())
            checked += len(observed)
    return errors, checked


def _swaps(plan: Plan, frames: dict[str, Samples], right: CorrespondenceMap) -> tuple[int, float]:
    """How many swaps of two Gray files are refused, and the worst share that another accepts."""
    bits = [frame.id for frame in plan.frames if isinstance(frame.pattern, Gray)]
    refused, worst = 0, 0.0
    for one, other in combinations(bits, 2):
        swapped = frames | {one: frames[other], other: frames[one]}
        try:
            found = decode(plan, swapped.__getitem__)
        except DecodingError:
            refused += 1
            continue
        axis = found.axes[Axis.COLUMN]
        both = found.valid & right.valid
        apart = np.abs(axis.coordinate - right.axes[Axis.COLUMN].coordinate)[both]
        worst = max(worst, float((apart > axis.period_px / 2).sum() / right.valid.sum()))
    return refused, worst


def _gamma(folder: Path) -> Record:
    """Phase error of two pre-distorted fringes against a fine Gray code.

    The code tells the fringe's order; the compensation sees the fringe alone.
    """
    plan, frames = _load(folder, "kamino410_gamma_plane")
    gray = tuple(frame for frame in plan.frames if isinstance(frame.pattern, Gray))
    reference = decode(plan.model_copy(update={"frames": gray}), frames.__getitem__)
    before: list[float] = []
    after: list[float] = []
    for gamma in (0.75, 1.25):
        fringe = tuple(
            frame
            for frame in plan.frames
            if isinstance(frame.pattern, PhaseShift) and frame.pattern.gamma == gamma
        )
        chosen = plan.model_copy(update={"frames": (*fringe, *gray)})
        for errors, compensate in ((before, False), (after, True)):
            options = DecodingOptions(compensate_harmonics=compensate)
            errors.append(_phase_error(decode(chosen, frames.__getitem__, options), reference))
    return Record(
        name="decode.gamma_phase_error",
        value=max(after),
        unit="rad",
        bound=_PHASE_ERROR_BOUND,
        sense=Sense.AT_MOST,
        runs=2,
        note="worse of two pre-distortions, against a Gray code good to 0.02 rad; "
        f"compensated {after[0]:.4f} and {after[1]:.4f}, raw {before[0]:.3f} and {before[1]:.3f}",
    )


def _phase_error(found: CorrespondenceMap, reference: CorrespondenceMap) -> float:
    both = found.valid & reference.valid
    decoded = found.axes[Axis.COLUMN]
    apart = (decoded.coordinate - reference.axes[Axis.COLUMN].coordinate)[both]
    # Bits read wrongly put the reference off by whole halves of its panel.
    near = np.abs(apart) < decoded.period_px / 4
    return float(np.sqrt(np.mean(apart[near] ** 2)) * 2 * np.pi / decoded.period_px)
