"""Picture frames: a moulding's profile drawn around a copy, mitred at the corners."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from render.opengl import pyrender

_ARC = 8  # points on each curve of the profile


@dataclass(frozen=True)
class Finish:
    """How a part of a frame looks: linear base colour, and pyrender's metalness and roughness."""

    colour: tuple[float, float, float]
    metalness: float
    roughness: float

    @property
    def material(self) -> pyrender.MetallicRoughnessMaterial:
        """As pyrender has it."""
        return pyrender.MetallicRoughnessMaterial(
            baseColorFactor=[*self.colour, 1.0],
            metallicFactor=self.metalness,
            roughnessFactor=self.roughness,
        )


class FrameFinish(Enum):
    """Moulding and sight edge of a frame."""

    GILDED = (Finish((0.68, 0.46, 0.17), 0.55, 0.38), Finish((0.74, 0.52, 0.2), 0.6, 0.3))
    WALNUT = (Finish((0.105, 0.052, 0.026), 0.0, 0.42), Finish((0.7, 0.49, 0.19), 0.6, 0.32))
    EBONISED = (Finish((0.018, 0.016, 0.015), 0.0, 0.35), Finish((0.03, 0.027, 0.025), 0.0, 0.3))


@dataclass(frozen=True)
class Opening:
    """What a frame goes around, in the scene's mm.

    Attributes
    ----------
    low, high : (3,) array
        Corners of the box that is seen: from left and bottom at the lowest surface, to right and
        top at the highest.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]


def frame_mesh(
    opening: Opening, *, width: float, wall_z: float, finish: FrameFinish
) -> pyrender.Mesh:
    """A frame that hangs on a wall, with a board behind the opening.

    Parameters
    ----------
    opening : Opening
    width : float
        Of the moulding, mm.
    wall_z : float
        Where the wall is, mm; behind the opening.
    finish : FrameFinish

    Returns
    -------
    pyrender.Mesh
    """
    moulding, sight = finish.value
    # Distances from the opening and heights above its lip, in widths of the moulding.
    sight_edge = [_bead(0.0, 0.12, 0.0, 0.035)]
    profile = [
        _cove((0.12, 0.0), (0.58, 0.34)),
        _line((0.58, 0.34), (0.62, 0.34)),
        _bead(0.62, 0.92, 0.34, 0.13),
        _line((0.92, 0.34), (0.94, 0.25)),
        _line((0.94, 0.25), (1.0, 0.25)),
    ]
    lip = opening.high[2] + 0.03 * width
    rebate = _line((0.0, opening.low[2]), (0.0, lip))
    side = _line((width, lip + 0.25 * width), (width, wall_z))
    inner = [rebate, *(width * curve + (0, lip) for curve in sight_edge)]
    outer = [*(width * curve + (0, lip) for curve in profile), side]
    board = Finish((0.2, 0.19, 0.18), 0.0, 0.9)
    return pyrender.Mesh(
        [
            _around(opening, inner, sight),
            _around(opening, outer, moulding),
            _board(opening, board),
        ]
    )


def _line(start: tuple[float, float], end: tuple[float, float]) -> NDArray[np.float64]:
    return np.array([start, end], dtype=np.float64)


def _bead(start: float, end: float, foot: float, rise: float) -> NDArray[np.float64]:
    """Half an ellipse."""
    angle = np.linspace(np.pi, 0, 2 * _ARC)
    middle, half = 0.5 * (start + end), 0.5 * (end - start)
    return np.column_stack([middle + half * np.cos(angle), foot + rise * np.sin(angle)])


def _cove(start: tuple[float, float], end: tuple[float, float]) -> NDArray[np.float64]:
    """A hollow quarter of an ellipse, flat at its start and steep at its end."""
    angle = np.linspace(0, np.pi / 2, 2 * _ARC)
    return np.column_stack(
        [
            start[0] + (end[0] - start[0]) * np.sin(angle),
            start[1] + (end[1] - start[1]) * (1 - np.cos(angle)),
        ]
    )


def _around(
    opening: Opening, curves: list[NDArray[np.float64]], finish: Finish
) -> pyrender.Primitive:
    """Curves of (distance from the opening, height) led around its four sides."""
    (x0, y0), (x1, y1) = opening.low[:2], opening.high[:2]
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    mitres = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    outwards = np.array([(0, -1), (1, 0), (0, 1), (-1, 0)])
    positions, normals, faces, count = [], [], [], 0
    for curve in curves:
        slope = np.gradient(curve, axis=0)
        slope /= np.linalg.norm(slope, axis=1, keepdims=True)
        for side in range(4):
            ends = (side, (side + 1) % 4)
            flat = np.stack([corners[e] + curve[:, :1] * mitres[e] for e in ends], axis=1)
            heights = np.repeat(curve[:, np.newaxis, 1:], 2, axis=1)
            positions.append(np.concatenate([flat, heights], axis=2).reshape(-1, 3))
            normal = np.column_stack([-slope[:, 1:] * outwards[side], slope[:, 0]])
            normals.append(np.repeat(normal, 2, axis=0))
            first = count + 2 * np.arange(len(curve) - 1)
            faces += [
                np.column_stack([first, first + 2, first + 1]),
                np.column_stack([first + 1, first + 2, first + 3]),
            ]
            count += 2 * len(curve)
    return pyrender.Primitive(
        np.concatenate(positions).astype(np.float32),
        normals=np.concatenate(normals).astype(np.float32),
        indices=np.concatenate(faces),
        material=finish.material,
    )


def _board(opening: Opening, finish: Finish) -> pyrender.Primitive:
    (x0, y0, z), (x1, y1, _) = opening.low, opening.high
    corners = np.array([(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)], np.float32)
    return pyrender.Primitive(
        corners,
        normals=np.tile(np.array([0, 0, 1], np.float32), (4, 1)),
        indices=np.array([(0, 1, 2), (0, 2, 3)]),
        material=finish.material,
    )
