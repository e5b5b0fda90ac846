"""The relief boxes (paper sections 5.2 and 5.3), all in one instanced draw."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from render.adaptive import AdaptiveOptions, box_alpha
from render.opengl import GL
from render.painting_maps import PaintingMaterial
from render.painting_primitive import PaintingPrimitive
from render.surface_shapes import box


class BoxesPrimitive(PaintingPrimitive):
    """All relief boxes in one instanced draw, chosen and blended by α_box where asked.

    Parameters
    ----------
    copy : DigitalCopy
    material : PaintingMaterial
    uniforms : dict
        Of the search.
    adaptive : AdaptiveOptions or None
        None draws every box opaque.
    """

    def __init__(
        self,
        copy: DigitalCopy,
        material: PaintingMaterial,
        *,
        uniforms: dict[str, Any],
        adaptive: AdaptiveOptions | None,
    ) -> None:
        low, high = np.zeros(3), np.ones(3)
        corners, faces = box(low, high)
        shaders = ("boxes.vert", "relief.frag", "")
        super().__init__(corners, faces, material, shaders, uniforms=uniforms, culled=GL.GL_FRONT)
        field, boxes = copy.height_field, copy.relief.boxes
        left = field.origin_mm[0] + (boxes.corner[:, 1] - 0.5) * field.pitch_mm
        bottom = field.origin_mm[1] - (boxes.corner[:, 0] + boxes.size[:, 0] - 0.5) * field.pitch_mm
        size = boxes.size[:, ::-1] * field.pitch_mm
        self._rectangles = np.column_stack([left, bottom, size]).astype(np.float32)
        # Of the whole cell, also where the canvas's edge cuts it: on a grid of equal squares the
        # distance of the middles is an order from front to back for every camera.
        self._middles = np.column_stack(
            [
                field.origin_mm[0]
                + (boxes.corner[:, 1] + 0.5 * copy.relief.cell - 0.5) * field.pitch_mm,
                field.origin_mm[1]
                - (boxes.corner[:, 0] + 0.5 * copy.relief.cell - 0.5) * field.pitch_mm,
            ]
        )
        self._copy = copy
        self._adaptive = adaptive

    def _add_to_context(self) -> None:
        super()._add_to_context()
        GL.glBindVertexArray(self._vaid)
        instances = GL.glGenBuffers(1)
        self._buffers.append(instances)
        GL.glBindBuffer(GL.GL_ARRAY_BUFFER, instances)
        for location, count, offset in ((1, 4, 0), (2, 1, 16)):
            GL.glVertexAttribPointer(
                location, count, GL.GL_FLOAT, GL.GL_FALSE, 20, ctypes.c_void_p(offset)
            )
            GL.glEnableVertexAttribArray(location)
            GL.glVertexAttribDivisor(location, 1)
        GL.glBindVertexArray(0)

    def _draw_triangles(self, camera: NDArray[np.float64]) -> None:
        count = len(self._rectangles)
        if self._adaptive is None:
            alpha = np.ones(count)
        else:
            alpha = box_alpha(self._copy, camera, self._adaptive)
        opaque = np.flatnonzero(alpha >= 1)
        blended = np.flatnonzero((alpha > 0) & (alpha < 1))
        # Front to back: depth then keeps what the ray meets first alone, and the picture is the
        # plane's and the boxes' mixed by α; back to front, hidden relief would shine through.
        distance = np.linalg.norm(self._middles - camera[:2], axis=1)
        blended = blended[np.argsort(distance[blended], kind="stable")]
        self._draw_instances(opaque, alpha)
        if not self._counted:
            GL.glEnable(GL.GL_BLEND)
            GL.glBlendFuncSeparate(
                GL.GL_SRC_ALPHA, GL.GL_ONE_MINUS_SRC_ALPHA, GL.GL_ONE, GL.GL_ONE_MINUS_SRC_ALPHA
            )
        self._draw_instances(blended, alpha)

    def _draw_instances(self, which: NDArray[np.int64], alpha: NDArray[np.float64]) -> None:
        if not len(which):
            return
        data = np.column_stack([self._rectangles[which], alpha[which]]).astype(np.float32)
        GL.glBindBuffer(GL.GL_ARRAY_BUFFER, self._buffers[-1])
        GL.glBufferData(GL.GL_ARRAY_BUFFER, data.nbytes, data, GL.GL_STREAM_DRAW)
        GL.glDrawElementsInstanced(
            GL.GL_TRIANGLES,
            self._triangles.size,
            GL.GL_UNSIGNED_INT,
            ctypes.c_void_p(0),
            len(which),
        )
