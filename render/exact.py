"""The exact mode: a box in which rays are followed to the triangles of the mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from render.opengl import GL
from render.painting_maps import PaintingMaterial
from render.painting_primitive import PaintingPrimitive
from render.surface_shapes import bounds, box, cell_bounds

EXACT_SHADERS = ("plain.vert", "exact.frag", "PRECISE")
NEARLY_EXACT_SHADERS = ("plain.vert", "exact.frag", "")
"""The same in single precision: now and then a ray along a silhouette takes its other side."""


def exact_primitive(copy: DigitalCopy, material: PaintingMaterial) -> PaintingPrimitive:
    """The box around a copy, whose fragments walk the pyramid of its heights."""
    material.prepare_search()
    return PaintingPrimitive(
        *box(*bounds(copy)),
        material,
        EXACT_SHADERS,
        doubles=exact_doubles(copy),
        culled=GL.GL_FRONT,
    )


def exact_doubles(copy: DigitalCopy) -> dict[str, NDArray[np.float64]]:
    """What the exact search needs in double precision: the box of the cells, origin and pitch."""
    low, high = cell_bounds(copy)
    return {
        "cells_low": low,
        "cells_high": high,
        "first_texel": np.array(copy.height_field.origin_mm),
        "pitch": np.array(copy.height_field.pitch_mm),
    }
