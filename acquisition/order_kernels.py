"""Compiled loops of the spatial check of fringe orders; :mod:`acquisition.unwrapping` explains it.

Coordinates of one axis or two come as ``(axes)`` tuples of (rows, cols) float64 arrays, NaN where
there is none; where a scan has one axis, it is given twice. A *run* is a stretch of a row without
a jump; runs of neighbouring rows are linked where pixels one above the other do not jump either;
what is linked is a *component*.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

KEEP, REPAIR, AMBIGUOUS, ISOLATED = 0, 1, 2, 3


@njit(parallel=True, cache=True)
def rows_with_jumps(x, y, half_x, half_y):  # type: ignore[no-untyped-def]
    """Number of jumps and gaps along every row, and between every row and the next.

    Returns
    -------
    (rows,) int64 array, (rows,) int64 array
    """
    rows, cols = x.shape
    along, down = np.zeros(rows, np.int64), np.zeros(rows, np.int64)
    for r in prange(rows):
        xr, yr = x[r], y[r]
        count = np.int64(0) if cols > 1 else np.int64(np.isnan(xr[0]))
        for c in range(cols - 1):
            near = (abs(xr[c + 1] - xr[c]) < half_x) & (abs(yr[c + 1] - yr[c]) < half_y)
            count += 0 if near else 1
        along[r] = count
        if r + 1 < rows:
            xn, yn = x[r + 1], y[r + 1]
            count = np.int64(0)
            for c in range(cols):
                near = (abs(xn[c] - xr[c]) < half_x) & (abs(yn[c] - yr[c]) < half_y)
                count += 0 if near else 1
            down[r] = count
    return along, down


@njit(inline="always")
def _run_at(labels, slot, row, col):  # type: ignore[no-untyped-def]
    """Number of a pixel's run in its row; -1 where there is no coordinate."""
    return labels[slot[row], col] if slot[row] >= 0 else 0


@njit(parallel=True, cache=True)
def label_runs(x, y, half_x, half_y, slot, labels):  # type: ignore[no-untyped-def]
    """Number the runs of every row that has a jump; -1 where there is no coordinate.

    ``slot`` (rows,) names the line of ``labels`` (lines, cols) int32 that belongs to a row; rows
    without a jump are one run and have none, -1.

    Returns
    -------
    (rows,) int64 array
        Runs of every row.
    """
    rows, cols = x.shape
    runs = np.ones(rows, np.int64)
    for r in prange(rows):
        if slot[r] >= 0:
            line = labels[slot[r]]
            label, inside = -1, False
            for c in range(cols):
                if np.isnan(x[r, c]):
                    line[c], inside = -1, False
                    continue
                if (
                    not inside
                    or abs(x[r, c] - x[r, c - 1]) >= half_x
                    or abs(y[r, c] - y[r, c - 1]) >= half_y
                ):
                    label += 1
                line[c], inside = label, True
            runs[r] = label + 1
    return runs


@njit(cache=True)
def _root(parent, run):  # type: ignore[no-untyped-def]
    while parent[run] != run:
        parent[run] = parent[parent[run]]
        run = parent[run]
    return run


@njit(cache=True)
def join_runs(x, y, half_x, half_y, slot, down, labels, first_run):  # type: ignore[no-untyped-def]
    """Component of every run, and the pixels of every component.

    ``first_run`` (rows + 1,) is the number of the first run of each row.

    Returns
    -------
    (runs,) int64 array, (components,) int64 array
    """
    rows, cols = x.shape
    parent = np.arange(first_run[rows])
    pixels = np.zeros(first_run[rows], np.int64)
    for r in range(rows):
        if slot[r] < 0:
            pixels[first_run[r]] = cols
        else:
            for c in range(cols):
                run = labels[slot[r], c]
                if run >= 0:
                    pixels[first_run[r] + run] += 1
        if r + 1 == rows:
            continue
        if slot[r] < 0 and slot[r + 1] < 0 and not down[r]:
            parent[_root(parent, first_run[r + 1])] = _root(parent, first_run[r])
            continue
        last_above, last_below = -1, -1
        for c in range(cols):
            above = _run_at(labels, slot, r, c)
            below = _run_at(labels, slot, r + 1, c)
            if above < 0 or below < 0 or (above == last_above and below == last_below):
                continue
            if abs(x[r + 1, c] - x[r, c]) < half_x and abs(y[r + 1, c] - y[r, c]) < half_y:
                upper = _root(parent, first_run[r] + above)
                parent[_root(parent, first_run[r + 1] + below)] = upper
                last_above, last_below = above, below
    number = np.full(len(parent), -1)
    component, count = np.empty(len(parent), np.int64), 0
    for run in range(len(parent)):
        root = _root(parent, run)
        if number[root] < 0:
            number[root], count = count, count + 1
        component[run] = number[root]
    sizes = np.zeros(count, np.int64)
    for run in range(len(parent)):
        sizes[component[run]] += pixels[run]
    return component, sizes


@njit(cache=True)
def _compare(x, y, variance_x, variance_y, here, there, apart, periods, slopes, jump):  # type: ignore[no-untyped-def]
    """Whole periods between two pixels into ``jump``; True where the phase goes on across them."""
    goes_on = True
    dx, dy = x[there] - x[here], y[there] - y[here]
    vx, vy = variance_x[there] + variance_x[here], variance_y[there] + variance_y[here]
    for axis in range(2):
        d, v = (dx, vx) if axis == 0 else (dy, vy)
        n = np.round(d / periods[axis])
        jump[axis] = int(n)
        room = min(5 * np.sqrt(v) + apart * slopes[axis], 0.25 * periods[axis])
        goes_on &= abs(d - n * periods[axis]) <= room
    return goes_on


@njit(inline="always")
def _next_along(r, c, step_down, reach, rows, cols, slot, labels):  # type: ignore[no-untyped-def]
    """Next pixel with a coordinate to the right or below, within reach, and its run's label."""
    nr, nc = r, c
    for _ in range(reach):
        nr, nc = nr + step_down, nc + 1 - step_down
        if nr >= rows or nc >= cols:
            return nr, nc, -1
        there = _run_at(labels, slot, nr, nc)
        if there >= 0:
            return nr, nc, there
    return nr, nc, -1


@njit(cache=True)
def list_jumps(  # type: ignore[no-untyped-def]
    x, y, variance_x, variance_y, periods, slopes, reach, slot, down, labels, first_run, component
):
    """Pairs of neighbouring pixels of different components.

    Neighbours along a row or a column, or across a gap of some rejected pixels.

    Parameters
    ----------
    periods, slopes : (2,) float64 arrays
        Period of each axis, and how much a coordinate may change from pixel to pixel.
    reach : int
        How far apart two pixels may be, across rejected ones, in pixels.

    Returns
    -------
    (jumps, 6) int64 array
        The two components; whole periods from the first to the second, for each axis; 1 where the
        phase goes on across the jump; and the first one's pixel, counted along the rows.
    """
    rows, cols = x.shape
    found, count = np.empty((1024, 6), np.int64), 0
    half_x, half_y = 0.5 * periods[0], 0.5 * periods[1]
    jump = np.zeros(2, np.int64)
    for r in range(rows):
        for step_down in range(2):
            if not (down[r] if step_down else slot[r] >= 0) or r + step_down == rows:
                continue
            for c in range(cols):
                nr, nc = r + step_down, c + 1 - step_down
                if nc < cols and (
                    abs(x[nr, nc] - x[r, c]) < half_x and abs(y[nr, nc] - y[r, c]) < half_y
                ):
                    continue
                here = _run_at(labels, slot, r, c)
                if here < 0:
                    continue
                nr, nc, there = _next_along(r, c, step_down, reach, rows, cols, slot, labels)
                if there < 0:
                    continue
                a, b = component[first_run[r] + here], component[first_run[nr] + there]
                if a == b:
                    continue
                if count == len(found):
                    more = np.empty((2 * count, 6), np.int64)
                    more[:count] = found
                    found = more
                apart = nr - r + nc - c
                on = _compare(
                    x, y, variance_x, variance_y, (r, c), (nr, nc), apart, periods, slopes, jump
                )
                found[count, 0], found[count, 1] = a, b
                found[count, 2], found[count, 3], found[count, 4] = jump[0], jump[1], on
                found[count, 5] = r * cols + c
                count += 1
    return found[:count]


@njit(cache=True)
def judge_components(order, rank, first_jump, jumps, sizes, steps, small, agreement):  # type: ignore[no-untyped-def]
    """What is to be done about every component, and by how many periods it is shifted.

    Components are judged from the largest down, by the jumps to those larger than themselves.

    Parameters
    ----------
    order, rank : (components,) int64 arrays
        Components by falling size, and the place of each in that order.
    first_jump : (components + 1,) int64 array
        Where the jumps of each component begin in ``jumps``.
    jumps : (jumps, 5 or more) int64 array
        As of :func:`list_jumps`, each listed for both of its components, which comes first.
    sizes : (components,) int64 array
    steps : (components,) bool array
        Components that a step of the surface parts from the others: they are kept.
    small : int
        Components of no more pixels must be borne out by a neighbour.
    agreement : float
        Share of a component's jumps that must agree about its repair.

    Returns
    -------
    (components,) int64 array, (components, 2) int64 array
    """
    verdict = np.zeros(len(order), np.int64)
    shift = np.zeros((len(order), 2), np.int64)
    proposals = np.zeros((16, 3), np.int64)
    for component in order:
        if steps[component]:
            continue
        known, edges = 0, 0
        for number in range(first_jump[component], first_jump[component + 1]):
            other = jumps[number, 1]
            if rank[other] > rank[component] or verdict[other] >= AMBIGUOUS:
                continue
            edges += 1
            if not jumps[number, 4]:
                continue
            sx, sy = shift[other, 0] + jumps[number, 2], shift[other, 1] + jumps[number, 3]
            place = 0
            while place < known and (proposals[place, 0] != sx or proposals[place, 1] != sy):
                place += 1
            if place == known:
                if known == len(proposals):
                    continue
                proposals[place, 0], proposals[place, 1], proposals[place, 2] = sx, sy, 0
                known += 1
            proposals[place, 2] += 1
        if edges == 0:
            continue
        best, votes = -1, 0
        for place in range(known):
            if proposals[place, 2] > votes:
                best, votes = place, proposals[place, 2]
        moves = best >= 0 and (proposals[best, 0] != 0 or proposals[best, 1] != 0)
        if moves and votes >= 3 and votes >= agreement * edges:
            verdict[component] = REPAIR
            shift[component] = proposals[best, :2]
        elif moves and 2 * votes >= edges:
            verdict[component] = AMBIGUOUS
            shift[component] = proposals[best, :2]
        elif sizes[component] <= small and 2 * votes < edges:
            verdict[component] = ISOLATED
    return verdict, shift


@njit(parallel=True, cache=True)
def apply_verdicts(  # type: ignore[no-untyped-def]
    coordinate, period, extent, shifts, verdict, slot, labels, first_run, component, wrong
):
    """Shift the components of one axis that are repaired, and mark those that are rejected.

    ``wrong`` (rows, cols) bool receives True where a component is ambiguous or isolated, or where
    its repair leads off the panel of ``extent`` pixels.
    """
    rows, cols = coordinate.shape
    for r in prange(rows):
        for c in range(cols):
            run = _run_at(labels, slot, r, c)
            if run < 0:
                continue
            of = component[first_run[r] + run]
            if verdict[of] == KEEP:
                continue
            if verdict[of] == REPAIR:
                moved = coordinate[r, c] + period * shifts[of]
                coordinate[r, c] = moved
                if not (-0.5 <= moved <= extent - 0.5):
                    wrong[r, c] = True
            else:
                wrong[r, c] = True


@njit(parallel=True, cache=True)
def reject_unsupported(uncertain, slot, labels, first_run, component, supported, wrong):  # type: ignore[no-untyped-def]
    """Mark uncertain pixels (rows, cols) of components that are not supported.

    ``uncertain`` holds bits, uncertain where not 0; ``supported`` (components,) bool.
    """
    rows, cols = uncertain.shape
    for r in prange(rows):
        for c in range(cols):
            run = _run_at(labels, slot, r, c)
            if run >= 0 and uncertain[r, c] and not supported[component[first_run[r] + run]]:
                wrong[r, c] = True


def component_rank(sizes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Components by falling size, and the place of each in that order."""
    order = np.argsort(-sizes, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return order, rank
