"""The painting as a pyrender mesh: one way of drawing it per mode."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from fitting.digital_copy import DigitalCopy
from render.adaptive import AdaptiveOptions
from render.bounded import BUDGET_PX, BoundedPrimitive
from render.errors import RenderError
from render.exact import exact_primitive
from render.opengl import GL, pyrender
from render.painting_maps import PaintingMaterial
from render.painting_primitive import PaintingPrimitive
from render.relief_boxes import BoxesPrimitive
from render.surface_shapes import bounds, box, has_triangle, plane, surface_triangles


class Mode(StrEnum):
    """How a painting is drawn."""

    MESH = "mesh"
    BUMP = "bump"
    RELIEF = "relief"
    HYBRID = "hybrid"
    ADAPTIVE = "adaptive"
    EXACT = "exact"
    BOUNDED = "bounded"


def painting_mesh(
    copy: DigitalCopy,
    mode: Mode,
    *,
    adaptive: AdaptiveOptions | None = None,
    material: PaintingMaterial | None = None,
    budget_px: float = BUDGET_PX,
) -> pyrender.Mesh:
    """The painting as a pyrender mesh, ready to be added to a scene.

    Vertices are in the canvas frame in mm; the node's pose must be rigid.

    Parameters
    ----------
    copy : DigitalCopy
    mode : Mode
    adaptive : AdaptiveOptions, optional
        For :attr:`Mode.ADAPTIVE`.
    material : PaintingMaterial, optional
        Of the same copy, to share its textures between meshes.
    budget_px : float
        For :attr:`Mode.BOUNDED`: parallax that may be left, in pixels.

    Returns
    -------
    pyrender.Mesh

    Raises
    ------
    RenderError
        :attr:`Mode.MESH`, :attr:`Mode.EXACT` or :attr:`Mode.BOUNDED` of a copy without three texels
        that make a triangle.
    """
    material = material or PaintingMaterial(copy)
    search: dict[str, Any] = {"linear_steps": 512, "binary_steps": 10}
    if mode is Mode.MESH:
        vertices, triangles = surface_triangles(copy)
        if not len(triangles):
            raise _no_triangle(copy, mode)
        shaders = ("plain.vert", "mesh.frag", "")
        parts = [PaintingPrimitive(vertices, triangles, material, shaders, culled=GL.GL_BACK)]
    elif mode in (Mode.EXACT, Mode.BOUNDED):
        if not has_triangle(copy.height_field.mask):
            raise _no_triangle(copy, mode)
        exact = mode is Mode.EXACT
        parts = [
            exact_primitive(copy, material)
            if exact
            else BoundedPrimitive(copy, material, budget_px=budget_px)
        ]
    elif mode is Mode.RELIEF:
        low, high = bounds(copy)
        corners, faces = box(low, high)
        search |= {"bounds_low": low, "bounds_high": high, "solid_sides": False}
        shaders = ("plain.vert", "relief.frag", "")
        parts = [
            PaintingPrimitive(
                corners, faces, material, shaders, uniforms=search, culled=GL.GL_FRONT
            )
        ]
    else:
        parts = [PaintingPrimitive(*plane(copy), material, ("plain.vert", "bump.frag", ""))]
        if mode is not Mode.BUMP and len(copy.relief.boxes):
            chosen = (adaptive or AdaptiveOptions()) if mode is Mode.ADAPTIVE else None
            search |= {"solid_sides": True}
            parts.append(BoxesPrimitive(copy, material, uniforms=search, adaptive=chosen))
    return pyrender.Mesh(primitives=parts)


def _no_triangle(copy: DigitalCopy, mode: Mode) -> RenderError:
    return RenderError(
        f"the copy's {int(copy.height_field.mask.sum())} measured texels make no triangle; "
        f"draw it in another mode than {mode}"
    )
