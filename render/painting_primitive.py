"""What a painting is drawn of: triangles with the painting's own shaders."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.opengl import GL, pyrender
from render.painting_maps import PaintingMaterial
from render.shader_program import PaintingProgram


class PaintingPrimitive(pyrender.Primitive):
    """Triangles drawn with the painting's own shaders.

    Parameters
    ----------
    positions : (n, 3) array
        Vertices in the canvas frame.
    indices : (m, 3) array
        Triangles.
    material : PaintingMaterial
    shaders : (str, str, str)
        Vertex and fragment shader files, and names that are defined in both.
    uniforms, doubles : dict
        Beside the material's; the second in double precision.
    culled : int or None
        Faces left out: ``GL_FRONT`` for boxes whose inside is searched, ``GL_BACK`` for a surface
        that is nothing from behind.
    """

    def __init__(
        self,
        positions: NDArray[Any],
        indices: NDArray[Any],
        material: PaintingMaterial,
        shaders: tuple[str, str, str],
        *,
        uniforms: dict[str, Any] | None = None,
        doubles: dict[str, NDArray[np.float64]] | None = None,
        culled: int | None = None,
    ) -> None:
        super().__init__(positions=positions, material=material)
        self._triangles = np.ascontiguousarray(indices, dtype=np.uint32)
        self.shaders = shaders
        self._uniforms = uniforms or {}
        self._doubles = doubles or {}
        self._culled = culled
        self._counted = False

    def _add_to_context(self) -> None:
        self._vaid = GL.glGenVertexArrays(1)
        GL.glBindVertexArray(self._vaid)
        vertices, triangles = GL.glGenBuffers(2)
        self._buffers = [vertices, triangles]
        GL.glBindBuffer(GL.GL_ARRAY_BUFFER, vertices)
        data = np.ascontiguousarray(self.positions, dtype=np.float32)
        GL.glBufferData(GL.GL_ARRAY_BUFFER, data.nbytes, data, GL.GL_STATIC_DRAW)
        GL.glVertexAttribPointer(0, 3, GL.GL_FLOAT, GL.GL_FALSE, 0, ctypes.c_void_p(0))
        GL.glEnableVertexAttribArray(0)
        # pyrender keeps indices as 32-bit floats, which are wrong above 2**24 vertices.
        GL.glBindBuffer(GL.GL_ELEMENT_ARRAY_BUFFER, triangles)
        GL.glBufferData(
            GL.GL_ELEMENT_ARRAY_BUFFER, self._triangles.nbytes, self._triangles, GL.GL_STATIC_DRAW
        )
        GL.glBindVertexArray(0)

    def draw(
        self, program: PaintingProgram, camera: NDArray[np.float64], *, counted: bool = False
    ) -> None:
        """Draw with the program bound; ``camera`` is its position in the canvas frame, mm.

        ``counted`` adds up all fragments, the hidden ones too.
        """
        self._counted = counted
        for name, value in self._uniforms.items():
            program.set_uniform(name, value)
        for name, value in self._doubles.items():
            program.set_double(name, value)
        self._bind()
        self._set_state()
        self._draw_triangles(camera)
        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glDisable(GL.GL_BLEND)
        GL.glCullFace(GL.GL_BACK)
        self._unbind()

    def draw_outline(self) -> None:
        """Draw four vertices that the bound program places itself."""
        self._bind()
        GL.glDisable(GL.GL_CULL_FACE)
        GL.glDisable(GL.GL_BLEND)
        GL.glDrawArrays(GL.GL_TRIANGLE_STRIP, 0, 4)
        self._unbind()

    def _set_state(self) -> None:
        GL.glPolygonMode(GL.GL_FRONT_AND_BACK, GL.GL_FILL)
        if self._counted:
            GL.glDisable(GL.GL_DEPTH_TEST)
            GL.glEnable(GL.GL_BLEND)
            GL.glBlendFunc(GL.GL_ONE, GL.GL_ONE)
        else:
            GL.glDisable(GL.GL_BLEND)
        if self._culled is None:
            GL.glDisable(GL.GL_CULL_FACE)
        else:
            GL.glEnable(GL.GL_CULL_FACE)
            GL.glCullFace(self._culled)

    def _draw_triangles(self, camera: NDArray[np.float64]) -> None:
        GL.glDrawElements(
            GL.GL_TRIANGLES, self._triangles.size, GL.GL_UNSIGNED_INT, ctypes.c_void_p(0)
        )
