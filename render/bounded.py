"""The bounded mode: how much search a view needs for its parallax to stay within a budget.

What a plane shows of a height that differs from its own by Δh is off by e = Δh · sin θ / (d · ω)
pixels: θ between viewing ray and normal, d the distance, ω the angle of a pixel. Only what is off
by more than the budget has to be searched for.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from fitting.height_field import HeightField
from render.errors import RenderError
from render.exact import NEARLY_EXACT_SHADERS, exact_doubles
from render.height_pyramid import Heading
from render.opengl import GL
from render.painting_maps import PaintingMaterial
from render.painting_primitive import PaintingPrimitive
from render.surface_shapes import bounds, box
from render.surface_tiles import SurfaceTiles

BUDGET_PX = 0.25
"""Parallax in pixels that is left by default: too little to be seen."""

# Slope of rays, horizontal over vertical, beyond which a plane is no way to carry them.
_FLATTEST = 40.0
# Depth over the shorter side, and share of measured texels, up to which and from which a relief is
# that of a painting.
_DEEP, _WHOLE = 0.05, 0.98
# Levels by which the cones are finer than what is shown, for the default budget: their levels are
# whole, and from one to the next nothing must be seen to move.
_FINER = 3.0
# Steps after which a ray is left where it is: where texels are smaller than pixels, for the default
# budget; and at most, on triangles.
_STEPS, _MOST_STEPS = 9, 48
# Steps of the cones longer than is safe, for the default budget, and how near is near enough in
# budgets: where texels are smaller than pixels, and on triangles.
_RELAXED, _NEAR_ENOUGH = (2.2, 1.2), (1.0, 0.5)
# Where one way gives way to another: in slopes of nearly all texels over the flattest ray's, and in
# texels a pixel.
_GRAZING = (0.7, 1.0)
_TRIANGLES = (0.7, 0.5)
# Pixels of the picture per triangle of a sculpted relief from which its triangles are drawn, and
# rays do not search for them.
_LARGE_PX = 4.0
# First and number of triangles: of the plane, and of the box for exact searches; after them come
# the surface's own.
_PLANE, _BOX = (0, 2), (2, 12)


class Search(StrEnum):
    """How the shader looks for the surface; the names of its variants."""

    PLANE = "PLANE"
    FRONT = "FRONT"
    BETWEEN = "BETWEEN"
    GRAZING = "GRAZING"
    EXACT = "EXACT"


@dataclass(frozen=True)
class ViewNeeds:
    """What a view asks of a bounded search.

    Attributes
    ----------
    search : Search
    grazing_share : float
        Of what cones find, where they are mixed with what is found from the plane.
    triangle_share : float
        Of the triangles, which are seen where texels are larger than pixels.
    plane_mm : float
        Height of the plane.
    plane_error_mm : float
        By which heights may differ from it.
    level : int
        Of the heights that are searched.
    heading : Heading
        Of all rays.
    rectangle : (float, float, float, float)
        Part of the plane on which the surface is seen: lowest X and Y, highest X and Y, mm.
    """

    search: Search
    grazing_share: float
    triangle_share: float
    plane_mm: float
    plane_error_mm: float
    level: int
    heading: Heading
    rectangle: tuple[float, float, float, float]


@dataclass(frozen=True)
class SurfaceShape:
    """What a bounded search needs to know of a surface as a whole.

    Attributes
    ----------
    low, high, median : float
        Of the heights, mm.
    corners : (float, float, float, float)
        Lowest X and Y, highest X and Y of the canvas.
    pitch_mm : float
    steepest : list of float
        Slope that all but 2 % of the texels keep to, by level of the maps.
    sculpted : bool
        Whether the relief is too deep or too full of gaps to be found from a plane.
    profiles : two (3, n) arrays
        X of the columns of texels, and Y of the rows, with the least and greatest height of each.
    """

    low: float
    high: float
    median: float
    corners: tuple[float, float, float, float]
    pitch_mm: float
    steepest: list[float]
    sculpted: bool
    profiles: tuple[NDArray[np.float64], NDArray[np.float64]]

    @classmethod
    def of(cls, field: HeightField, levels: list[NDArray[np.float32]]) -> SurfaceShape:
        """Of a height field, and the levels (rows, cols, 1) of its heights."""
        low, high = field.height_range_mm
        (x, y), (width, height) = field.origin_mm, field.size_mm
        half = 0.5 * field.pitch_mm
        steepest = []
        for number, level in enumerate(levels):
            rises = [np.abs(np.diff(level[..., 0], axis=axis)).ravel() for axis in (0, 1)]
            joined = np.concatenate(rises)
            slope = np.quantile(joined, 0.98) / (field.pitch_mm * 2**number) if len(joined) else 0.0
            steepest.append(float(slope))
        corners = (x - half, y + half - height, x - half + width, y + half)
        sculpted = high - low > _DEEP * min(width, height) or field.mask.mean() < _WHOLE
        median = float(np.median(field.height[field.mask]))
        heights = levels[0][..., 0]
        profiles = (
            np.stack([field.texel_x_mm(), heights.min(axis=0), heights.max(axis=0)]),
            np.stack([field.texel_y_mm(), heights.min(axis=1), heights.max(axis=1)]),
        )
        return cls(low, high, median, corners, field.pitch_mm, steepest, sculpted, profiles)

    def needs(self, eye: NDArray[np.float64], pixel_angle: float, budget_px: float) -> ViewNeeds:
        """What is needed seen from a place (3,) of the canvas frame."""
        x0, y0, x1, y1 = self.corners
        x, y, z = (float(number) for number in eye)
        near = math.hypot(max(x0 - x, 0, x - x1), max(y0 - y, 0, y - y1))
        far = math.hypot(max(abs(x - x0), abs(x - x1)), max(abs(y - y0), abs(y - y1)))
        above = z - self.high
        if above <= 0 or far > _FLATTEST * above:
            return ViewNeeds(
                *(Search.EXACT, 1.0, 1.0, self.median, self.high - self.low, 0),
                *(Heading.ANYWHERE, self.corners),
            )
        # Bounds over the canvas, each by itself: nearest place, flattest ray.
        nearest = math.hypot(near, above)
        flattest = far / math.hypot(far, above)
        per_mm = flattest / (nearest * pixel_angle)
        middle = 0.5 * (self.low + self.high)
        allowed = budget_px / max(per_mm, 1e-30)
        error = max(self.high - middle, 1e-9)
        if error <= allowed:
            plane = min(max(self.median, self.high - allowed), self.low + allowed)
            return ViewNeeds(
                *(Search.PLANE, 0.0, 0.0, plane, error, 0),
                *(Heading.ANYWHERE, self._texel_centres),
            )
        if self.sculpted:
            return ViewNeeds(
                *(Search.EXACT, 1.0, 1.0, self.median, 2 * error, 0),
                *(Heading.ANYWHERE, self.corners),
            )
        plane = middle + (self.median - middle) * min(error / allowed - 1, 1.0)
        level = max(math.log2(pixel_angle * nearest / self.pitch_mm), 0.0)
        # What a coarser level smooths away must fall with the budget.
        coarser = math.log2(budget_px / BUDGET_PX) - _FINER
        slope = float(np.interp(level, np.arange(len(self.steepest)), self.steepest))
        grazing = _share(slope * far / above, _GRAZING)
        search = Search.BETWEEN if 0 < grazing < 1 else (Search.FRONT, Search.GRAZING)[int(grazing)]
        return ViewNeeds(
            search,
            grazing,
            _share(pixel_angle * nearest / self.pitch_mm, _TRIANGLES),
            plane,
            max(self.high - plane, plane - self.low),
            max(round(level + 0.5 * math.log2(nearest / above) + coarser), 0),
            self._heading(x, y),
            self._seen_on_plane(x, y, z, plane),
        )

    def _heading(self, x: float, y: float) -> Heading:
        """Half of the directions that all rays from over (x, y) to the canvas run in."""
        x0, y0, x1, y1 = self.corners
        beyond = {
            Heading.UP: y0 - y,
            Heading.DOWN: y - y1,
            Heading.LEFT: x - x1,
            Heading.RIGHT: x0 - x,
        }
        heading = max(beyond, key=lambda side: beyond[side])
        return heading if beyond[heading] >= 0 else Heading.ANYWHERE

    @property
    def _texel_centres(self) -> tuple[float, float, float, float]:
        x0, y0, x1, y1 = self.corners
        half = 0.5 * self.pitch_mm
        return x0 + half, y0 + half, x1 - half, y1 - half

    def _seen_on_plane(
        self, x: float, y: float, z: float, plane: float
    ) -> tuple[float, float, float, float]:
        """Rectangle of a plane that the surface is seen on from (x, y, z), and the plane itself."""
        ends = []
        for at, (place, *heights) in zip((x, y), self.profiles, strict=True):
            seen = [at + (place - at) * (z - plane) / (z - height) for height in heights]
            ends.append((min(np.min(seen), place.min()), max(np.max(seen), place.max())))
        (x0, x1), (y0, y1) = ends
        return float(x0), float(y0), float(x1), float(y1)


class BoundedPrimitive(PaintingPrimitive):
    """A plane on which the surface is searched for, as far as the budget asks.

    Parameters
    ----------
    copy : DigitalCopy
    material : PaintingMaterial
    budget_px : float
        Parallax that may be left.
        Views along the surface are searched exactly.

    Raises
    ------
    RenderError
        A budget that is not positive.
    """

    def __init__(
        self,
        copy: DigitalCopy,
        material: PaintingMaterial,
        *,
        budget_px: float,
    ) -> None:
        if not 0 < budget_px < math.inf:
            raise RenderError(f"the error budget must be positive, not {budget_px} px")
        material.prepare_search()
        shape = SurfaceShape.of(copy.height_field, material.height_levels)
        plane = np.array([[x, y, 0.0] for y in (0.0, 1.0) for x in (0.0, 1.0)])
        corners, faces = box(*bounds(copy))
        vertices = [plane, corners]
        triangles = [np.array([[0, 1, 3], [0, 3, 2]]), faces + len(plane)]
        self._tiles = SurfaceTiles.of(copy) if shape.sculpted else None
        if self._tiles is not None:
            vertices.append(self._tiles.vertices)
            triangles.append(self._tiles.triangles + len(plane) + len(corners))
        super().__init__(
            *(np.concatenate(vertices), np.concatenate(triangles)),
            *(material, _shaders(Search.GRAZING)),
        )
        self._shape = shape
        self._runs = [_PLANE]
        self._budget_px = float(budget_px)
        self._exact_doubles = exact_doubles(copy)

    def look(
        self,
        eye: NDArray[np.float64],
        pixel_angle: float,
        to_clip: Callable[[], NDArray[np.float64]],
        pixels: int,
    ) -> None:
        """Make ready for a view.

        Parameters
        ----------
        eye : (3,) array
            Place in the canvas frame, mm.
        pixel_angle : float
            Radians.
        to_clip : callable
            Matrix (4, 4) from the canvas frame to the view's clip space; few views need it.
        pixels : int
            Of the picture.
        """
        needs = self._shape.needs(eye, pixel_angle, self._budget_px)
        self._runs = [_PLANE]
        if needs.search is Search.EXACT:
            large = self._large_triangles(to_clip, pixels)
            if large is not None:
                self.shaders, self._culled = ("plain.vert", "mesh.frag", ""), GL.GL_BACK
                self._uniforms, self._doubles, self._runs = {}, {}, large
                return
            self._runs = [_BOX]
            self.shaders, self._culled = NEARLY_EXACT_SHADERS, GL.GL_FRONT
            self._uniforms, self._doubles = {}, self._exact_doubles
            return
        self.shaders = _shaders(needs.search, triangles=needs.triangle_share > 0)
        self._culled, self._doubles = GL.GL_BACK, {}
        if needs.search in (Search.BETWEEN, Search.GRAZING):
            self.material.prepare_cones(needs.heading, needs.level)
        self._uniforms = {
            "plane_rectangle": needs.rectangle,
            "plane_height": needs.plane_mm,
            "top": self._shape.high,
            "most_steps": _most_steps(needs, self._budget_px),
            "relaxed": _relaxed(needs, self._budget_px),
            "near_enough": _mixed(_NEAR_ENOUGH, needs.triangle_share),
            "grazing_share": needs.grazing_share,
            "triangle_share": needs.triangle_share,
            "plane_error": needs.plane_error_mm,
            "budget": self._budget_px,
        }

    def _large_triangles(
        self, to_clip: Callable[[], NDArray[np.float64]], pixels: int
    ) -> list[tuple[int, int]] | None:
        """Runs of the triangles that are seen, where they are so large that it is less work."""
        if self._tiles is None:
            return None
        runs = self._tiles.runs(self._tiles.seen(to_clip()))
        if pixels < _LARGE_PX * sum(count for _, count in runs):
            return None
        before = _BOX[0] + _BOX[1]
        return [(before + first, count) for first, count in runs]

    def _draw_triangles(self, camera: NDArray[np.float64]) -> None:
        for first, count in self._runs:
            GL.glDrawElements(
                *(GL.GL_TRIANGLES, 3 * count),
                *(GL.GL_UNSIGNED_INT, ctypes.c_void_p(12 * first)),
            )


def _most_steps(needs: ViewNeeds, budget_px: float) -> int:
    fewest = min(_STEPS * max(1.0, BUDGET_PX / budget_px), _MOST_STEPS)
    return round(_mixed((fewest, _MOST_STEPS), needs.triangle_share))


def _relaxed(needs: ViewNeeds, budget_px: float) -> float:
    """Steps that are longer than is safe pass over edges, more of them than a small budget has."""
    longest = _mixed(_RELAXED, needs.triangle_share)
    return 1 + (longest - 1) * min(budget_px / BUDGET_PX, 1.0)


def _share(value: float, ends: tuple[float, float]) -> float:
    """From 0 at the first end, and before it, to 1 at the second."""
    return min(max((value - ends[0]) / (ends[1] - ends[0]), 0.0), 1.0)


def _mixed(ends: tuple[float, float], share: float) -> float:
    return ends[0] + share * (ends[1] - ends[0])


def _shaders(search: Search, *, triangles: bool = False) -> tuple[str, str, str]:
    return "bounded.vert", "bounded.frag", f"{search} TRIANGLES" if triangles else str(search)
