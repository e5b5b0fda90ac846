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
        relief = np.concatenate(
            [
                heights_without_cliffs(copy)[..., np.newaxis],
                copy.normal_xy,
                field.mask[..., np.newaxis].astype(np.float32),
            ],
            axis=2,
        )
        self.maps = {"relief_map": FloatTexture("relief", relief)}
        if copy.reflectance is not None:
            self.maps |= {
                "diffuse_map": FloatTexture("diffuse", copy.reflectance.diffuse),
                "specular_map": FloatTexture("specular", copy.reflectance.specular),
                "lobe_map": FloatTexture("lobe", copy.reflectance.lobe),
            }
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


def heights_without_cliffs(copy: DigitalCopy) -> NDArray[np.float32]:
    """Heights with each gap at the height of the nearest measured texel, (rows, cols) mm.

    Interpolation next to a gap then meets no cliff that is not there.
    """
    field = copy.height_field
    if field.mask.all():
        return field.height
    _, labels = cv2.distanceTransformWithLabels(
        (~field.mask).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_label = np.zeros(int(labels.max()) + 1, np.float32)
    by_label[labels[field.mask]] = field.height[field.mask]
    return np.asarray(by_label[labels], dtype=np.float32)
