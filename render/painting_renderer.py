"""A pyrender renderer that knows paintings, and draws into floating point."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.bounded import BoundedPrimitive
from render.errors import RenderError
from render.opengl import GL, pyrender
from render.painting_primitive import PaintingPrimitive
from render.shader_program import SHADOWS, LinearProgramCache, PaintingProgram, Shown

_OUTLINE = ("outline.vert", "outline.frag", "", Shown.RADIANCE)
_MOST_LIGHTS = 4  # of a kind on one mesh, with the shadow maps that texture units are there for


@dataclass(frozen=True, kw_only=True)
class RoomLight:
    """What light does in a room: shadows, and more of it from one side than from another.

    Relief shades itself from every light. A spot light also casts the shadows of paintings and of
    the scene's other meshes on each other; of a painting, that of its outline.

    Attributes
    ----------
    lamp_radius_mm : float
        Of spot lights, which are discs: half shadows are as wide as that makes them.
    ambient_slope : (float, float, float)
        Ambient light on a surface is multiplied by 1 plus the product of this and its normal, in
        the scene's axes.

    Raises
    ------
    RenderError
        A radius that is negative, or a slope longer than 1.
    """

    lamp_radius_mm: float = 0.0
    ambient_slope: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not 0 <= self.lamp_radius_mm < np.inf:
            raise RenderError(f"a lamp's radius is not negative: {self.lamp_radius_mm} mm")
        if not np.linalg.norm(self.ambient_slope) <= 1:
            raise RenderError(f"ambient light would be negative somewhere: {self.ambient_slope}")


class PaintingRenderer(pyrender.renderer.Renderer):
    """pyrender's renderer with a linear float framebuffer and the painting's own programs.

    Anything else in the scene is drawn by pyrender's own shaders, into the same depth buffer and
    linear too. It needs its context current, also when it is deleted.

    Attributes
    ----------
    shown : Shown
        What paintings are drawn as.
    room_light : RoomLight
        Of pictures with shadows: those with the flag ``SHADOWS_SPOT``.
    painting_cpu_s : float or None
        Where it is a number, the processor time of drawing paintings is added to it, of what a
        view needs made ready too, and every draw is waited for.
    """

    _main_fb: Any
    _main_fb_dims: Any

    def __init__(self, viewport_width: int, viewport_height: int) -> None:
        super().__init__(viewport_width, viewport_height)
        self._program_cache = LinearProgramCache()
        self._painting_programs: dict[tuple[str, str, str, Shown], PaintingProgram] = {}
        self.shown = Shown.RADIANCE
        self.room_light = RoomLight()
        self.painting_cpu_s: float | None = None

    def delete(self) -> None:
        """Free everything in the OpenGL context."""
        for program in self._painting_programs.values():
            program.delete()
        self._painting_programs = {}
        super().delete()

    def __del__(self) -> None:
        """Free nothing: whenever this is called, another context may be the current one."""

    def _get_primitive_program(self, primitive: Any, flags: int, program_flags: int) -> Any:
        if not isinstance(primitive, PaintingPrimitive):
            return super()._get_primitive_program(primitive, flags, program_flags)
        if program_flags == pyrender.constants.ProgramFlags.NONE:
            key = _OUTLINE
        else:
            vertex, fragment, variant = primitive.shaders
            if flags & pyrender.RenderFlags.SHADOWS_SPOT:
                variant = f"{variant} {SHADOWS}"
            key = (vertex, fragment, variant, self.shown)
        if key not in self._painting_programs:
            self._painting_programs[key] = PaintingProgram(*key)
        return self._painting_programs[key]

    def _update_context(self, scene: Any, flags: int) -> None:
        if flags & pyrender.RenderFlags.SHADOWS_SPOT:
            for mesh in scene.meshes:
                for primitive in mesh.primitives:
                    if isinstance(primitive, PaintingPrimitive):
                        primitive.material.prepare_search()
        super()._update_context(scene, flags)

    def _compute_max_n_lights(self, flags: int) -> list[int]:
        return [_MOST_LIGHTS] * 3

    def _sorted_mesh_nodes(self, scene: Any) -> Iterator[Any]:
        # A mesh may hang from several nodes: it is made ready for each just before it is drawn.
        for node in super()._sorted_mesh_nodes(scene):
            for primitive in node.mesh.primitives:
                if isinstance(primitive, BoundedPrimitive):
                    self._look(primitive, scene, scene.get_pose(node))
            yield node

    def _look(self, primitive: BoundedPrimitive, scene: Any, pose: NDArray[np.float64]) -> None:
        # Only this thread's: others may still be at work on what was drawn before.
        began = time.thread_time()
        camera = scene.main_camera_node
        projection = camera.camera.get_projection_matrix(self.viewport_width, self.viewport_height)
        camera_pose = scene.get_pose(camera)

        def to_clip() -> NDArray[np.float64]:
            clipped: NDArray[np.float64] = projection @ _rigid_inverse(camera_pose) @ pose
            return clipped

        primitive.look(
            (camera_pose[:3, 3] - pose[:3, 3]) @ pose[:3, :3],
            2 / (projection[1, 1] * self.viewport_height),
            to_clip,
            self.viewport_width * self.viewport_height,
        )
        # A view may need maps that none before it did.
        for texture in primitive.material.textures - self._mesh_textures:
            texture._add_to_context()
            self._mesh_textures.add(texture)
        if self.painting_cpu_s is not None:
            self.painting_cpu_s += time.thread_time() - began

    def _bind_lighting(self, scene: Any, program: Any, node: Any, flags: int) -> None:
        self._camera_pose = scene.get_pose(scene.main_camera_node)
        size = (self.viewport_width, self.viewport_height)
        self._projection = scene.main_camera_node.camera.get_projection_matrix(*size)
        super()._bind_lighting(scene, program, node, flags)
        if flags & pyrender.RenderFlags.SHADOWS_SPOT:
            program.set_uniform("lamp_radius_mm", self.room_light.lamp_radius_mm)
            program.set_uniform("ambient_slope", np.array(self.room_light.ambient_slope))

    def _bind_and_draw_primitive(self, primitive: Any, pose: Any, program: Any, flags: int) -> None:
        if not isinstance(primitive, PaintingPrimitive):
            super()._bind_and_draw_primitive(primitive, pose, program, flags)
            return
        if not np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-6):
            raise RenderError(
                "a painting's node is scaled or sheared; a scene with paintings is in mm, and its "
                "poses only turn and move"
            )
        if flags & pyrender.RenderFlags.DEPTH_ONLY:
            self._cast_outline(primitive, pose, program)
            return
        if self.painting_cpu_s is None:
            self._draw_painting(primitive, pose, program)
            return
        GL.glFinish()
        began = time.process_time()
        self._draw_painting(primitive, pose, program)
        GL.glFinish()
        self.painting_cpu_s += time.process_time() - began

    def _cast_outline(
        self, primitive: PaintingPrimitive, pose: NDArray[np.float64], program: PaintingProgram
    ) -> None:
        """Draw a painting into a shadow map."""
        self._bind_material(primitive, pose, program)
        primitive.draw_outline()

    def _bind_material(
        self, primitive: PaintingPrimitive, pose: NDArray[np.float64], program: PaintingProgram
    ) -> None:
        program.set_uniform("M", pose)
        for name, value in primitive.material.uniforms.items():
            program.set_uniform(name, value)
        for name, texture in primitive.material.maps.items():
            if program.uses(name):
                self._bind_texture(texture, name, program)

    def _draw_painting(
        self, primitive: PaintingPrimitive, pose: NDArray[np.float64], program: PaintingProgram
    ) -> None:
        self._bind_material(primitive, pose, program)
        program.set_uniform("pixel_angle", 2 / (self._projection[1, 1] * self.viewport_height))
        to_canvas = _rigid_inverse(pose) @ self._camera_pose
        if program.uses("depth_row"):
            to_clip = self._projection @ _rigid_inverse(to_canvas)
            program.set_uniform("depth_row", to_clip[2])
            program.set_uniform("w_row", to_clip[3])
        if program.uses("eye"):
            self._set_rays(program, to_canvas)
        primitive.draw(program, to_canvas[:3, 3], counted=self.shown is Shown.WORK)

    def _set_rays(self, program: PaintingProgram, to_canvas: NDArray[np.float64]) -> None:
        """Viewing rays as functions of the pixel, in double precision."""
        across = 1 / self._projection[0, 0] * to_canvas[:3, 0]
        up = 1 / self._projection[1, 1] * to_canvas[:3, 1]
        # Pictures off the camera's axis have a third column.
        forward = -to_canvas[:3, 2] + self._projection[0, 2] * across + self._projection[1, 2] * up
        program.set_double("eye", to_canvas[:3, 3])
        program.set_double("ray_corner", forward - across - up)
        program.set_double("ray_dx", 2 / self.viewport_width * across)
        program.set_double("ray_dy", 2 / self.viewport_height * up)

    def _configure_main_framebuffer(self) -> None:
        size = (self.viewport_width, self.viewport_height)
        if self._main_fb is not None and self._main_fb_dims == size:
            return
        self._delete_main_framebuffer()
        self._main_fb = GL.glGenFramebuffers(1)
        self._main_cb, self._main_db = GL.glGenRenderbuffers(2)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._main_fb)
        for buffer, stored, attachment in (
            (self._main_cb, GL.GL_RGBA32F, GL.GL_COLOR_ATTACHMENT0),
            (self._main_db, GL.GL_DEPTH_COMPONENT32F, GL.GL_DEPTH_ATTACHMENT),
        ):
            GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
            GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, stored, *size)
            GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, attachment, GL.GL_RENDERBUFFER, buffer)
        if GL.glCheckFramebufferStatus(GL.GL_FRAMEBUFFER) != GL.GL_FRAMEBUFFER_COMPLETE:
            raise RenderError(f"this OpenGL cannot draw into {size[0]}×{size[1]} floats")
        # The forward pass draws into what it takes for the multisampled buffer.
        self._main_fb_ms = self._main_fb
        self._main_fb_dims = size

    def _delete_main_framebuffer(self) -> None:
        if self._main_fb is not None:
            GL.glDeleteFramebuffers(1, [self._main_fb])
            GL.glDeleteRenderbuffers(2, [self._main_cb, self._main_db])
        self._main_fb = self._main_fb_ms = self._main_cb = self._main_db = None
        self._main_fb_dims = (None, None)

    def _read_main_framebuffer(
        self, scene: Any, flags: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Linear RGBA (rows, cols, 4), and depth in scene units (rows, cols), 0 where empty."""
        width, height = self._main_fb_dims
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
        GL.glPixelStorei(GL.GL_PACK_ALIGNMENT, 4)
        color = GL.glReadPixels(0, 0, width, height, GL.GL_RGBA, GL.GL_FLOAT)
        stored = GL.glReadPixels(0, 0, width, height, GL.GL_DEPTH_COMPONENT, GL.GL_FLOAT)
        rgba = np.frombuffer(color, np.float32).reshape(height, width, 4)[::-1]
        z = np.frombuffer(stored, np.float32).reshape(height, width)[::-1].astype(np.float64)
        camera = scene.main_camera_node.camera
        near, far = camera.znear, camera.zfar
        depth = near * far / (far - z * (far - near))
        return rgba.copy(), np.where(z < 1.0, depth, 0.0).astype(np.float32)


def _rigid_inverse(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of a pose (4, 4) that only turns and moves; a general inverse costs a millisecond of BLAS."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse
