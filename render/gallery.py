"""A gallery: framed copies on a wall, each under a lamp of its own, and a walk along them.

The room is made for the copies, as large as they ask for; they keep their sizes to each other.
Lamps stand high and well before the wall, at 36° to the vertical: nearer to it they would throw the
frame's shadow on the painting, farther from it shine back from varnish into the visitor's eyes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from render.bounded import BUDGET_PX
from render.errors import RenderError
from render.gallery_room import DEPTH, label_mesh, room_nodes
from render.gallery_walk import Walk
from render.opengl import pyrender
from render.painter import Painter, RenderedImage
from render.painting_node import Mode, painting_mesh
from render.painting_renderer import RoomLight
from render.picture_frames import FrameFinish, Opening, frame_mesh
from render.surface_shapes import bounds

# In units of the largest side of any copy.
_EYE = 1.95  # height of the middle of every painting, and of the camera
_FRAME = 0.11  # width of the moulding, in units of the root of the copy's own area
_GAP = 0.85  # between frames
_MARGIN = 2.6  # between the outermost frames and the ends of the room
_LAMP = np.array([0.0, 2.6, 1.9])  # from the middle of its painting
_LAMP_RADIUS = 0.1
_FROM_WALL = 0.02
_LEAST_POOL = 0.3  # half the diagonal that a lamp lights at least
_PROUD = 0.02  # how far a frame may rise over the middle height of the edges that it holds
_LEAST_ASPECT = 4 / 3

_AMBIENT = 0.2
_AMBIENT_SLOPE = (0.0, 0.3, 0.12)  # more from the ceiling and the room than from the floor


@dataclass(frozen=True)
class Hanging:
    """A copy on the wall.

    Attributes
    ----------
    copy : DigitalCopy
    title : str
        For its label.
    """

    copy: DigitalCopy
    title: str


class Gallery:
    """A room with framed copies, as a pyrender scene with a walk through it.

    Parameters
    ----------
    hangings : list of Hanging
        From left to right.
    mode : Mode
    budget_px : float
        For :attr:`Mode.BOUNDED`.
    field_of_view : float
        Vertical, radians.

    Attributes
    ----------
    scene : pyrender.Scene
        Axes are those of the canvases on the wall; y is from the floor, z from the wall; mm.
    unit : float
        The largest side of any copy, mm.

    Raises
    ------
    RenderError
        No copy at all, or one that the mode cannot draw.
    """

    def __init__(
        self,
        hangings: list[Hanging],
        *,
        mode: Mode = Mode.BOUNDED,
        budget_px: float = BUDGET_PX,
        field_of_view: float = float(np.deg2rad(44.0)),
    ) -> None:
        if not hangings:
            raise RenderError("a gallery needs at least one copy")
        sizes = np.array([hanging.copy.height_field.size_mm for hanging in hangings])
        self.unit = float(sizes.max())
        frames = _FRAME * np.sqrt(sizes.prod(axis=1))
        widths = sizes[:, 0] + 2 * frames
        steps = 0.5 * (widths[:-1] + widths[1:]) + _GAP * self.unit
        middles = np.concatenate([[0.0], np.cumsum(steps)])
        self.scene = pyrender.Scene(bg_color=[0.0] * 4, ambient_light=[_AMBIENT] * 3)
        ends = middles[[0, -1]] + (0.5 * widths[[0, -1]] + _MARGIN * self.unit) * [-1, 1]
        borders = np.concatenate([ends[:1], 0.5 * (middles[:-1] + middles[1:]), ends[1:]])
        for node in room_nodes(borders, self.unit):
            self.scene.add_node(node)
        finishes = cycle(FrameFinish)
        for hanging, x, frame in zip(hangings, middles, frames, strict=True):
            mesh = painting_mesh(hanging.copy, mode, budget_px=budget_px)
            middle = np.array([x, _EYE * self.unit, 0.0])
            self._hang(hanging, mesh, middle, float(frame), next(finishes))
        framed = sizes.max(axis=1) + 2 * frames
        self._walk = Walk(middles, framed, _EYE * self.unit, self.unit)
        reach = float(np.hypot(np.ptp(borders), 2 * DEPTH * self.unit))
        camera = pyrender.PerspectiveCamera(yfov=field_of_view, znear=0.02 * self.unit, zfar=reach)
        self._field_of_view = field_of_view
        self._camera = self.scene.add(camera, pose=self._walk.pose(0.0))

    def _hang(
        self,
        hanging: Hanging,
        mesh: pyrender.Mesh,
        middle: NDArray[np.float64],
        frame_width: float,
        finish: FrameFinish,
    ) -> None:
        copy, unit = hanging.copy, self.unit
        low, high = bounds(copy)
        # The canvas's middle is hung at the eye's height; its lowest point stays off the wall.
        shift = middle - 0.5 * (low + high) * np.array([1, 1, 0])
        shift[2] = _FROM_WALL * unit - low[2]
        pose = np.eye(4)
        pose[:3, 3] = shift
        self.scene.add(mesh, pose=pose, name=hanging.title)
        # The rebate holds the canvas by its edges, and the board is behind everything.
        rebate = np.array([1.0, 1.0, 0.0]) * max(0.004 * unit, copy.height_field.pitch_mm)
        rebate = np.minimum(rebate, 0.2 * (high - low))
        low[2] -= 0.5 * _FROM_WALL * unit
        high[2] = self._lip(copy)
        opening = Opening(low + shift + rebate, high + shift - rebate)
        frame = frame_mesh(opening, width=frame_width, wall_z=0.0, finish=finish)
        self.scene.add(frame, pose=np.eye(4))
        self._add_label(hanging.title, opening.high[0] + frame_width)
        self._add_lamp(middle, opening, frame_width)

    def _lip(self, copy: DigitalCopy) -> float:
        """Height that a frame must have to hold a copy by its edges; deep reliefs stand proud."""
        height, mask = copy.height_field.height, copy.height_field.mask
        rim = np.ones_like(mask)
        edge = [max(side // 30, 1) for side in mask.shape]
        rim[edge[0] : -edge[0], edge[1] : -edge[1]] = False
        held = height[mask & rim] if (mask & rim).any() else height[mask]
        return float(min(held.max(), np.median(held) + _PROUD * self.unit))

    def _add_label(self, title: str, frame_right: float) -> None:
        pose = np.eye(4)
        pose[:3, 3] = (frame_right + 0.08 * self.unit, (_EYE - 0.2) * self.unit, 0.004 * self.unit)
        self.scene.add(label_mesh(title, 0.15 * self.unit), pose=pose)

    def _add_lamp(self, middle: NDArray[np.float64], opening: Opening, frame_width: float) -> None:
        """A spot lamp whose cone holds the frame, aimed low: there its light is thinner."""
        place = middle + _LAMP * self.unit
        half = 0.5 * (opening.high - opening.low)[:2] + frame_width
        target = middle - np.array([0.0, 0.3 * half[1], 0.0])
        backward = place - target
        away = float(np.linalg.norm(backward))
        backward /= away
        right = np.array([1.0, 0.0, 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(backward, right), backward], axis=1)
        pose[:3, 3] = place
        lit = max(1.5 * float(np.linalg.norm(half)), 1.5 * _LEAST_POOL * self.unit)
        outer = float(np.arctan(lit / away))
        to_middle = _LAMP * self.unit
        r2 = float(to_middle @ to_middle)
        cosine = to_middle[2] / np.sqrt(r2)
        # White paint at the middle of the canvas has the radiance 1, ambient light included.
        inner = 0.35 * outer
        axis = float(backward @ to_middle) / np.sqrt(r2)
        edge = min((axis - np.cos(outer)) / (np.cos(inner) - np.cos(outer)), 1.0) ** 2
        intensity = np.pi * (1 - _AMBIENT) * r2 / (cosine * edge)
        lamp = pyrender.SpotLight(
            color=[1.0, 1.0, 1.0], intensity=intensity, innerConeAngle=inner, outerConeAngle=outer
        )
        self.scene.add(lamp, pose=pose)

    def paint(self, painter: Painter, share: float, *, width: int, height: int) -> RenderedImage:
        """The picture at a share of the walk from 0 to 1.

        Raises
        ------
        RenderError
            A size that OpenGL cannot draw.
        """
        self.scene.set_pose(self._camera, self._walk.pose(share))
        # Tall pictures see as much of the wall to the sides as those of the least aspect.
        taller = max(1.0, _LEAST_ASPECT * height / width)
        half = np.tan(self._field_of_view / 2) * taller
        self._camera.camera.yfov = float(2 * np.arctan(half))
        room_light = RoomLight(
            lamp_radius_mm=_LAMP_RADIUS * self.unit, ambient_slope=_AMBIENT_SLOPE
        )
        return painter.paint_scene(self.scene, width=width, height=height, room_light=room_light)
