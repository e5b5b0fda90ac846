"""The maps of a digital copy as textures, and the material that holds them."""

from __future__ import annotations

from enum import Enum
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from fitting.digital_copy import DigitalCopy
from render.errors import RenderError
from render.height_pyramid import Heading, cone_slopes, heights_with_gaps, min_max_pyramid
from render.opengl import GL, pyrender

LARGEST_SIDE = 16384
_GIVEN = {1: GL.GL_RED, 2: GL.GL_RG, 3: GL.GL_RGB, 4: GL.GL_RGBA}
_SINGLE = {1: GL.GL_R32F, 2: GL.GL_RG32F, 3: GL.GL_RGB32F, 4: GL.GL_RGBA32F}
_HALF = {1: GL.GL_R16F, 2: GL.GL_RG16F, 3: GL.GL_RGB16F, 4: GL.GL_RGBA16F}


class Sampling(Enum):
    """How a texture is read between its texels and its levels."""

    TEXELS = (GL.GL_NEAREST_MIPMAP_NEAREST, GL.GL_NEAREST)
    ONE_LEVEL = (GL.GL_LINEAR, GL.GL_LINEAR)
    SMOOTH = (GL.GL_LINEAR_MIPMAP_LINEAR, GL.GL_LINEAR)


class FloatTexture(pyrender.Texture):
    """A texture of floats with its levels; pyrender's own wraps floats into bytes.

    Parameters
    ----------
    name : str
    levels : list of (rows, cols, channels) arrays
        Each half as large as the one before, rounded down.
    half : bool
        Whether it is kept in half precision.
    sampling : Sampling

    Attributes
    ----------
    level : int
        The finest level that is read; of :attr:`Sampling.ONE_LEVEL` the only one.
    """

    def __init__(
        self,
        name: str,
        levels: list[NDArray[np.float32]],
        *,
        half: bool = False,
        sampling: Sampling = Sampling.SMOOTH,
    ) -> None:
        super().__init__(name=name, source_channels="RGBA", width=1, height=1)
        self._levels = [np.ascontiguousarray(level, dtype=np.float32) for level in levels]
        self._half = half
        self._sampling = sampling
        self.level = 0

    def _add_to_context(self) -> None:
        rows, cols, channels = self._levels[0].shape
        largest = min(LARGEST_SIDE, int(GL.glGetIntegerv(GL.GL_MAX_TEXTURE_SIZE)))
        if max(rows, cols) > largest:
            raise RenderError(
                f"the copy has {cols} × {rows} texels, this OpenGL draws at most {largest} a side; "
                "process the session with a coarser --pitch"
            )
        # PyOpenGL 3.1.0 cannot hand over half floats; the driver converts.
        stored = (_HALF if self._half else _SINGLE)[channels]
        self._texid = GL.glGenTextures(1)
        GL.glBindTexture(GL.GL_TEXTURE_2D, self._texid)
        GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 4)
        for number, level in enumerate(self._levels):
            height, width = level.shape[:2]
            GL.glTexImage2D(
                GL.GL_TEXTURE_2D,
                number,
                stored,
                width,
                height,
                0,
                _GIVEN[channels],
                GL.GL_FLOAT,
                level,
            )
        smaller, larger = self._sampling.value
        for parameter, value in (
            (GL.GL_TEXTURE_MAX_LEVEL, len(self._levels) - 1),
            (GL.GL_TEXTURE_MIN_FILTER, smaller),
            (GL.GL_TEXTURE_MAG_FILTER, larger),
            (GL.GL_TEXTURE_WRAP_S, GL.GL_CLAMP_TO_EDGE),
            (GL.GL_TEXTURE_WRAP_T, GL.GL_CLAMP_TO_EDGE),
        ):
            GL.glTexParameteri(GL.GL_TEXTURE_2D, parameter, value)

    def _bind(self) -> None:
        super()._bind()
        if self._sampling is Sampling.ONE_LEVEL:
            GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_BASE_LEVEL, self.level)


class PaintingMaterial(pyrender.Material):
    """The maps of a copy, and what else its shaders need.

    Heights and normals are kept in single precision, reflectance in half: as it is on disk.
    """

    def __init__(self, copy: DigitalCopy) -> None:
        super().__init__(name="painting", doubleSided=True)
        self._copy = copy
        field = copy.height_field
        surface = np.dstack([field.height, copy.normal_xy])
        maps = {"relief_map": surface}
        if copy.reflectance is not None:
            maps |= {
                "diffuse_map": copy.reflectance.diffuse,
                "specular_map": copy.reflectance.specular,
                "lobe_map": copy.reflectance.lobe,
            }
        maps = gaps_from_nearest(maps, field.mask)
        maps["relief_map"] = np.dstack([maps["relief_map"], field.mask.astype(np.float32)])
        self._shading_maps = {
            name: FloatTexture(name, mipmaps(values), half=name != "relief_map")
            for name, values in maps.items()
        }
        self._searched: dict[str, FloatTexture] = {}
        self._cones: dict[Heading, FloatTexture] = {}
        half = 0.5 * field.pitch_mm
        self.uniforms: dict[str, Any] = {
            "has_reflectance": copy.reflectance is not None,
            "grid_corner": (field.origin_mm[0] - half, field.origin_mm[1] + half),
            "grid_size": field.size_mm,
            "height_range": field.height_range_mm,
            "delta0": copy.relief.delta0_mm,
            "texel": field.pitch_mm,
            "shadow_lift": shadow_lift_mm(copy),
        }

    @cached_property
    def height_levels(self) -> list[NDArray[np.float32]]:
        """Heights (rows, cols, 1) in mm at ever lower resolution, gaps filled."""
        field = self._copy.height_field
        filled = gaps_from_nearest({"height": field.height[..., np.newaxis]}, field.mask)
        return mipmaps(filled["height"])

    def prepare_search(self) -> None:
        """Make the maps that rays are searched through, unless they are there."""
        if self._searched:
            return
        height = heights_with_gaps(self._copy.height_field)
        pyramid = min_max_pyramid(height)
        cells = np.array([max(side - 1, 1) for side in height.shape[::-1]], np.int32)
        self.uniforms |= {
            "cells": cells,
            "pyramid_cells": cells,
            "pyramid_top": len(pyramid) - 1,
        }
        heights = FloatTexture("height_map", [height[..., np.newaxis]])
        self._searched = {
            "height_map": heights,
            "pyramid_heights": heights,
            "pyramid": FloatTexture("pyramid", pyramid, sampling=Sampling.TEXELS),
        }

    def prepare_cones(self, heading: Heading, level: int) -> None:
        """Have rays of one heading be searched by cones, at one level of the heights."""
        if not self._cones:
            # Half floats are finest about zero: there the most heights are to be.
            field = self._copy.height_field
            self.uniforms["search_origin"] = float(np.median(field.height[field.mask]))
        if heading not in self._cones:
            self._cones[heading] = self._cone_texture(heading)
        self._searched["search_map"] = self._cones[heading]
        self._cones[heading].level = min(level, len(self.height_levels) - 1)

    def _cone_texture(self, heading: Heading) -> FloatTexture:
        origin = np.float32(self.uniforms["search_origin"])
        levels = []
        for number, level in enumerate(self.height_levels):
            pitch_mm = self._copy.height_field.pitch_mm * 2**number
            slopes = cone_slopes(level[..., 0], pitch_mm, heading)
            steepest = np.float32(np.finfo(np.float16).max)
            levels.append(np.dstack([level[..., 0] - origin, np.minimum(slopes, steepest)]))
        return FloatTexture("search_map", levels, half=True, sampling=Sampling.ONE_LEVEL)

    @property
    def maps(self) -> dict[str, FloatTexture]:
        """Every texture by the name it has in the shaders."""
        return self._shading_maps | self._searched

    @property
    def textures(self) -> set[FloatTexture]:
        """Every texture, for pyrender to keep in its context."""
        return set(self.maps.values()) | set(self._cones.values())

    @property
    def is_transparent(self) -> bool:
        """Never: gaps are cut out, not blended."""
        return False


def shadow_lift_mm(copy: DigitalCopy) -> float:
    """Height over the surface from which light is looked for: noise of the scan casts no shadow.

    Three standard deviations of a height, the median over the copy, and a hair for rounding, mm.
    """
    field = copy.height_field
    sigma = float(np.sqrt(np.median(field.variance[field.mask])))
    return 3 * sigma + 1e-3 * field.pitch_mm


def mipmaps(values: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Levels of a map (rows, cols, channels): each the mean over areas of the one before."""
    levels = [np.ascontiguousarray(values, dtype=np.float32)]
    while max(levels[-1].shape[:2]) > 1:
        rows, cols, channels = levels[-1].shape
        size = (max(cols // 2, 1), max(rows // 2, 1))
        smaller = cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA)
        levels.append(smaller.astype(np.float32).reshape(size[1], size[0], channels))
    return levels


def gaps_from_nearest(
    maps: dict[str, NDArray[np.float32]], mask: NDArray[np.bool_]
) -> dict[str, NDArray[np.float32]]:
    """Maps whose gaps have the values of the nearest measured texel.

    Interpolation next to a gap then meets no cliff, no edge and no value that was never measured.

    Parameters
    ----------
    maps : dict of (rows, cols, channels) arrays
    mask : (rows, cols) bool array
        True where texels were measured; at least one is.

    Returns
    -------
    dict of (rows, cols, channels) float32 arrays
    """
    if mask.all():
        return dict(maps)
    row, col = distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return {name: values[row, col] for name, values in maps.items()}
