"""The maps of a digital copy as textures, and the material that holds them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from render.errors import RenderError
from render.opengl import GL, pyrender

LARGEST_SIDE = 16384
_BY_CHANNELS = {3: (GL.GL_RGB32F, GL.GL_RGB), 4: (GL.GL_RGBA32F, GL.GL_RGBA)}


class FloatTexture(pyrender.Texture):
    """A texture of 32-bit floats; pyrender's own wraps floats into bytes."""

    def __init__(self, name: str, values: NDArray[np.float32]) -> None:
        super().__init__(name=name, source_channels="RGBA", width=1, height=1)
        self._values = np.ascontiguousarray(values, dtype=np.float32)

    def _add_to_context(self) -> None:
        rows, cols, channels = self._values.shape
        largest = min(LARGEST_SIDE, int(GL.glGetIntegerv(GL.GL_MAX_TEXTURE_SIZE)))
        if max(rows, cols) > largest:
            raise RenderError(
                f"the copy has {cols} × {rows} texels, this OpenGL draws at most {largest} a side; "
                "process the session with a coarser --pitch"
            )
        stored, given = _BY_CHANNELS[channels]
        self._texid = GL.glGenTextures(1)
        GL.glBindTexture(GL.GL_TEXTURE_2D, self._texid)
        GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 4)
        GL.glTexImage2D(
            GL.GL_TEXTURE_2D, 0, stored, cols, rows, 0, given, GL.GL_FLOAT, self._values
        )
        for parameter, value in (
            (GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR),
            (GL.GL_TEXTURE_MAG_FILTER, GL.GL_LINEAR),
            (GL.GL_TEXTURE_WRAP_S, GL.GL_CLAMP_TO_EDGE),
            (GL.GL_TEXTURE_WRAP_T, GL.GL_CLAMP_TO_EDGE),
        ):
            GL.glTexParameteri(GL.GL_TEXTURE_2D, parameter, value)


class PaintingMaterial(pyrender.Material):
    """The maps of a copy, and what else its shaders need."""

    def __init__(self, copy: DigitalCopy) -> None:
        super().__init__(name="painting", doubleSided=True)
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
        self.maps = {name: FloatTexture(name, values) for name, values in maps.items()}
        half = 0.5 * field.pitch_mm
        self.uniforms: dict[str, Any] = {
            "has_reflectance": copy.reflectance is not None,
            "grid_corner": (field.origin_mm[0] - half, field.origin_mm[1] + half),
            "grid_size": field.size_mm,
            "height_range": field.height_range_mm,
            "delta0": copy.relief.delta0_mm,
            "texel": field.pitch_mm,
        }

    @property
    def textures(self) -> set[FloatTexture]:
        """Every texture, for pyrender to keep in its context."""
        return set(self.maps.values())

    @property
    def is_transparent(self) -> bool:
        """Never: gaps are cut out, not blended."""
        return False


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
    _, labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    texel_of_label = np.zeros(int(labels.max()) + 1, np.int64)
    texel_of_label[labels[mask]] = np.flatnonzero(mask)
    nearest = texel_of_label[labels]
    return {name: values.reshape(mask.size, -1)[nearest] for name, values in maps.items()}
