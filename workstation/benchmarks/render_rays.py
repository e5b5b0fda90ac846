"""Rays against the triangles of a height field, in double precision and without a leak at edges.

Slow, for the few rays that Embree's single precision cannot decide: those along a silhouette.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitting.height_field import HeightField

Floats = NDArray[np.float64]


class TriangleRays:
    """Triangles between texels, found by the cells that a ray passes over.

    Parameters
    ----------
    field : HeightField
    corners : (n, 3, 3) float64 array
        Of the triangles, mm, each within four neighbouring texels.
    """

    def __init__(self, field: HeightField, corners: Floats) -> None:
        self._corners = corners
        self._pitch_mm = field.pitch_mm
        self._first_texel = np.array(field.origin_mm)
        self._cells = np.array([max(side - 1, 1) for side in field.shape[::-1]])
        self._low, self._high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        col, row = np.floor(self._places(corners.mean(axis=1))).astype(int).T
        cell = row * self._cells[0] + col
        order = np.argsort(cell, kind="stable")
        second = np.append(False, np.diff(cell[order]) == 0).astype(int)
        self._of_cell = np.full((self._cells.prod(), 2), -1)
        self._of_cell[cell[order], second] = order

    def first_front_faces(self, eye: Floats, rays: Floats) -> Floats:
        """First point on a triangle that faces each ray (n, 3) from the eye (3,); NaN for none."""
        hits = [self._first_front_face(eye, ray) for ray in rays]
        return np.array(hits, dtype=np.float64).reshape(-1, 3)

    def _first_front_face(self, eye: Floats, ray: Floats) -> Floats:
        near = self._near(eye, ray)
        t, front = _meet(eye, ray, self._corners[near])
        return eye + t[front].min() * ray if front.any() else np.full(3, np.nan)

    def _places(self, points: Floats) -> Floats:
        """Columns and rows of points (n, 3)."""
        return np.asarray((points[:, :2] - self._first_texel) / self._pitch_mm * [1, -1])

    def _near(self, eye: Floats, ray: Floats) -> NDArray[np.int64]:
        """Triangles of the cells that the ray passes over, and of those around them."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([self._low - eye, self._high - eye]) / ray
        # Along a side of the box 0 / 0 says nothing: there the other sides decide.
        first = max(np.nanmax(ends.min(axis=0)), 0.0)
        last = np.nanmin(ends.max(axis=0))
        slack = self._pitch_mm / np.linalg.norm(ray)
        if last < first - slack:
            return np.empty(0, np.int64)
        begin, end = max(first - slack, 0.0), last + slack
        across = (end - begin) * float(np.abs(ray[:2]).max()) / self._pitch_mm
        along = np.linspace(begin, end, int(2 * across) + 2)
        places = np.floor(self._places(eye + along[:, np.newaxis] * ray)).astype(int)
        around = np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
        cells = np.unique((places[:, np.newaxis] + around).reshape(-1, 2), axis=0)
        cells = cells[((cells >= 0) & (cells < self._cells)).all(axis=1)]
        triangles = self._of_cell[cells[:, 1] * self._cells[0] + cells[:, 0]].ravel()
        return np.asarray(triangles[triangles >= 0])


def _meet(eye: Floats, ray: Floats, corners: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Where along a ray the planes of triangles (n, 3, 3) are met, and whether from the front.

    Woop, Benthin, Wald, Watertight ray/triangle intersection, JCGT 2(1), 2013: triangles that share
    an edge decide on it by the same products, so no ray passes between them.
    """
    z = int(np.abs(ray).argmax())
    x, y = (z + 1) % 3, (z + 2) % 3
    if ray[z] < 0:
        x, y = y, x
    from_eye = corners - eye
    depth = from_eye[..., z] / ray[z]
    across, up = from_eye[..., x] - ray[x] * depth, from_eye[..., y] - ray[y] * depth
    ahead, behind = [1, 2, 0], [2, 0, 1]
    # Twice the areas that the ray's place makes with each edge, of the edge's opposite corner.
    areas = across[:, behind] * up[:, ahead] - up[:, behind] * across[:, ahead]
    whole = areas.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (areas * depth).sum(axis=1) / whole
    return t, (areas >= 0).all(axis=1) & (whole > 0) & (t > 0)
