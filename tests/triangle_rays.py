"""Rays against triangles in double precision: what a renderer's hits are held against."""

from __future__ import annotations

import numpy as np


def meet_triangles(
    origin: np.ndarray, ray: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Möller and Trumbore's intersection of a ray with every triangle (n, 3, 3).

    Returns where along the ray each plane is met, whether that is inside the triangle and ahead,
    and whether the triangle faces the ray.
    """
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(ray, edge2)
    determinant = (edge1 * p).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origin - corners[:, 0]
        u = (s * p).sum(axis=1) / determinant
        q = np.cross(s, edge1)
        v = (ray * q).sum(axis=1) / determinant
        t = (edge2 * q).sum(axis=1) / determinant
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return t, inside, determinant > 0
