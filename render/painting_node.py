"""The painting as pyrender meshes: one primitive for each way of drawing it."""

from __future__ import annotations

import ctypes
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from render.adaptive import AdaptiveOptions, box_alpha
from render.opengl import GL, pyrender
from render.painting_maps import PaintingMaterial
from render.shader_program import PaintingProgram


class Mode(StrEnum):
    """How a painting is drawn."""

    MESH = "mesh"
    BUMP = "bump"
    RELIEF = "relief"
    HYBRID = "hybrid"
    ADAPTIVE = "adaptive"


class PaintingPrimitive(pyrender.Primitive):
    """Triangles drawn with the painting's own shaders.

    Parameters
    ----------
    positions : (n, 3) array
        Vertices in the canvas frame.
    indices : (m, 3) array
        Triangles.
    material : PaintingMaterial
    shaders : (str, str)
        Vertex and fragment shader files.
    uniforms : dict
        Beside the material's.
    culled : int or None
        Faces left out: ``GL_FRONT`` for boxes whose inside is searched, ``GL_BACK`` for a surface
        that is nothing from behind.
    """

    def __init__(
        self,
        positions: NDArray[Any],
        indices: NDArray[Any],
        material: PaintingMaterial,
        shaders: tuple[str, str],
        *,
        uniforms: dict[str, Any] | None = None,
        culled: int | None = None,
    ) -> None:
        super().__init__(positions=positions, material=material)
        self._triangles = np.ascontiguousarray(indices, dtype=np.uint32)
        self.shaders = shaders
        self._uniforms = uniforms or {}
        self._culled = culled

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

    def draw(self, program: PaintingProgram, camera: NDArray[np.float64]) -> None:
        """Draw with the program bound; ``camera`` is its position in the canvas frame, mm."""
        for name, value in self._uniforms.items():
            program.set_uniform(name, value)
        self._bind()
        self._set_state()
        self._draw_triangles(camera)
        GL.glCullFace(GL.GL_BACK)
        self._unbind()

    def _set_state(self) -> None:
        GL.glPolygonMode(GL.GL_FRONT_AND_BACK, GL.GL_FILL)
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
        corners, faces = _box(low, high)
        shaders = ("boxes.vert", "relief.frag")
        super().__init__(corners, faces, material, shaders, uniforms=uniforms, culled=GL.GL_FRONT)
        field, boxes = copy.height_field, copy.relief.boxes
        left = field.origin_mm[0] + (boxes.corner[:, 1] - 0.5) * field.pitch_mm
        bottom = field.origin_mm[1] - (boxes.corner[:, 0] + boxes.size[:, 0] - 0.5) * field.pitch_mm
        size = boxes.size[:, ::-1] * field.pitch_mm
        self._rectangles = np.column_stack([left, bottom, size]).astype(np.float32)
        self._copy = copy
        self._adaptive = adaptive
        self.drawn = (0, 0)

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
        middle = self._rectangles[:, :2] + 0.5 * self._rectangles[:, 2:]
        distance = np.linalg.norm(middle - camera[:2], axis=1)
        blended = blended[np.argsort(-distance[blended])]
        self.drawn = (len(opaque), len(blended))
        self._draw_instances(opaque, alpha)
        GL.glEnable(GL.GL_BLEND)
        GL.glBlendFuncSeparate(
            GL.GL_SRC_ALPHA, GL.GL_ONE_MINUS_SRC_ALPHA, GL.GL_ONE, GL.GL_ONE_MINUS_SRC_ALPHA
        )
        self._draw_instances(blended, alpha)
        GL.glDisable(GL.GL_BLEND)

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


def painting_mesh(
    copy: DigitalCopy, mode: Mode, *, adaptive: AdaptiveOptions | None = None
) -> pyrender.Mesh:
    """The painting as a pyrender mesh, ready to be added to a scene.

    Vertices are in the canvas frame in mm; the node's pose must be rigid.

    Parameters
    ----------
    copy : DigitalCopy
    mode : Mode
    adaptive : AdaptiveOptions, optional
        For :attr:`Mode.ADAPTIVE`.

    Returns
    -------
    pyrender.Mesh
    """
    material = PaintingMaterial(copy)
    search: dict[str, Any] = {"linear_steps": 512, "binary_steps": 10}
    if mode is Mode.MESH:
        vertices, triangles = surface_triangles(copy)
        shaders = ("plain.vert", "mesh.frag")
        parts = [PaintingPrimitive(vertices, triangles, material, shaders, culled=GL.GL_BACK)]
    elif mode is Mode.RELIEF:
        low, high = _bounds(copy)
        corners, faces = _box(low, high)
        search |= {"bounds_low": low, "bounds_high": high, "solid_sides": False}
        shaders = ("plain.vert", "relief.frag")
        parts = [
            PaintingPrimitive(
                corners, faces, material, shaders, uniforms=search, culled=GL.GL_FRONT
            )
        ]
    else:
        parts = [_plane(copy, material)]
        if mode is not Mode.BUMP and len(copy.relief.boxes):
            chosen = (adaptive or AdaptiveOptions()) if mode is Mode.ADAPTIVE else None
            search |= {"solid_sides": True}
            parts.append(BoxesPrimitive(copy, material, uniforms=search, adaptive=chosen))
    return pyrender.Mesh(primitives=parts)


def surface_triangles(
    copy: DigitalCopy,
) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Triangles between measured texels.

    Returns
    -------
    vertices : (n, 3) float32 array
        Texel centres in the canvas frame, mm.
    triangles : (m, 3) uint32 array
        Two per square of four measured texels, one per square of three.
    """
    field = copy.height_field
    mask = field.mask
    x, y = np.meshgrid(field.texel_x_mm(), field.texel_y_mm())
    vertices = np.stack([x[mask], y[mask], field.height[mask]], axis=1).astype(np.float32)
    number = np.full(mask.shape, -1, np.int64)
    number[mask] = np.arange(len(vertices))
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    have = [corner >= 0 for corner in (a, b, c, d)]
    whole = have[1] & have[2]
    choices = [
        (np.stack([a, c, b], axis=1), whole & have[0]),
        (np.stack([b, c, d], axis=1), whole & have[3]),
        (np.stack([a, d, b], axis=1), have[0] & have[1] & have[3] & ~have[2]),
        (np.stack([a, c, d], axis=1), have[0] & have[2] & have[3] & ~have[1]),
    ]
    return vertices, np.concatenate([t[keep] for t, keep in choices]).astype(np.uint32)


def _bounds(copy: DigitalCopy) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    field = copy.height_field
    half = 0.5 * field.pitch_mm
    left, top = field.origin_mm[0] - half, field.origin_mm[1] + half
    width, height = field.size_mm
    low, high = field.height_range_mm
    # A flat copy still needs a box with an inside.
    thin = 1e-3 * field.pitch_mm
    return np.array([left, top - height, low - thin]), np.array([left + width, top, high + thin])


def _plane(copy: DigitalCopy, material: PaintingMaterial) -> PaintingPrimitive:
    low, high = _bounds(copy)
    z = copy.relief.delta0_mm
    corners = np.array(
        [[low[0], low[1], z], [high[0], low[1], z], [high[0], high[1], z], [low[0], high[1], z]]
    )
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return PaintingPrimitive(corners, faces, material, ("plain.vert", "bump.frag"))


def _box(
    low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Corners and outward faces of a box."""
    corners = np.array(
        [[x, y, z] for z in (low[2], high[2]) for y in (low[1], high[1]) for x in (low[0], high[0])]
    )
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [triangle for q in quads for triangle in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]
    return corners, np.array(faces)
