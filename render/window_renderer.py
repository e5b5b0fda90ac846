"""The painting's renderer in a window: drawn into floats, shown as sRGB."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.opengl import GL, pyrender
from render.painting_renderer import PaintingRenderer

_SHADERS = Path(__file__).with_name("shaders")


class WindowRenderer(PaintingRenderer):
    """Draws a scene at several samples a pixel, and shows their mean in the current window.

    Parameters
    ----------
    width, height : int
        Of the window in pixels.
    """

    def __init__(self, width: int, height: int) -> None:
        super().__init__(width, height)
        self._texture: int | None = None
        self._caption: int | None = None
        self._vertices: int | None = None

    def set_caption(self, picture: NDArray[np.uint8] | None) -> None:
        """Lay a picture of the window's size, (rows, cols, 4) with opacity, over all to come."""
        if self._caption is not None:
            GL.glDeleteTextures([self._caption])
            self._caption = None
        if picture is None:
            return
        rows, cols = picture.shape[:2]
        self._caption = GL.glGenTextures(1)
        GL.glBindTexture(GL.GL_TEXTURE_2D, self._caption)
        GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 4)
        pixels = np.ascontiguousarray(picture)
        GL.glTexImage2D(
            *(GL.GL_TEXTURE_2D, 0, GL.GL_RGBA8, cols, rows, 0),
            *(GL.GL_RGBA, GL.GL_UNSIGNED_BYTE, pixels),
        )
        _read_texels_alone()
        GL.glBindTexture(GL.GL_TEXTURE_2D, 0)

    def show(
        self,
        scene: pyrender.Scene,
        *,
        size: tuple[int, int],
        samples: int,
        exposure: float,
        shadows: bool,
    ) -> None:
        """Draw a scene into the window's back buffer.

        Parameters
        ----------
        scene : pyrender.Scene
        size : (int, int)
            Width and height of the window in pixels.
        samples : int
            Along each axis of a pixel.
        exposure : float
            Factor on the radiance.
        shadows : bool
            Whether paintings' reliefs cast shadows on themselves.
        """
        flags = pyrender.RenderFlags.OFFSCREEN
        if shadows:
            flags |= pyrender.RenderFlags.SHADOWS_SPOT
        self.viewport_width, self.viewport_height = size[0] * samples, size[1] * samples
        self.render(scene, flags)
        self.viewport_width, self.viewport_height = size
        self._present(samples, exposure)

    def _read_main_framebuffer(self, scene: Any, flags: int) -> Any:
        """Keep the picture on the graphics card, as a texture."""
        if self._texture is None:
            self._texture = GL.glGenTextures(1)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
        GL.glBindTexture(GL.GL_TEXTURE_2D, self._texture)
        GL.glCopyTexImage2D(GL.GL_TEXTURE_2D, 0, GL.GL_RGBA32F, 0, 0, *self._main_fb_dims, 0)
        _read_texels_alone()
        GL.glBindTexture(GL.GL_TEXTURE_2D, 0)

    def _present(self, samples: int, exposure: float) -> None:
        names = {kind: str(_SHADERS / f"window.{kind}") for kind in ("vert", "frag")}
        program = self._program_cache.get_program(names["vert"], names["frag"])
        if not program._in_context():
            program._add_to_context()
        if self._vertices is None:
            self._vertices = GL.glGenVertexArrays(1)
        self._configure_forward_pass_viewport(pyrender.RenderFlags.NONE)
        for state in (GL.GL_DEPTH_TEST, GL.GL_BLEND, GL.GL_CULL_FACE):
            GL.glDisable(state)
        program._bind()
        for unit, texture in ((1, self._caption), (0, self._texture)):
            if texture is not None:
                GL.glActiveTexture(GL.GL_TEXTURE0 + unit)
                GL.glBindTexture(GL.GL_TEXTURE_2D, texture)
        for name, value in (
            *(("radiance", 0), ("samples", samples), ("exposure", float(exposure))),
            *(("caption", 1), ("has_caption", self._caption is not None)),
        ):
            program.set_uniform(name, value)
        GL.glBindVertexArray(self._vertices)
        GL.glDrawArrays(GL.GL_TRIANGLES, 0, 3)
        GL.glBindVertexArray(0)
        program._unbind()

    def delete(self) -> None:
        """Free everything in the OpenGL context."""
        self.set_caption(None)
        if self._texture is not None:
            GL.glDeleteTextures([self._texture])
        if self._vertices is not None:
            GL.glDeleteVertexArrays(1, [self._vertices])
        self._texture = self._vertices = None
        super().delete()


def _read_texels_alone() -> None:
    """Let the bound texture be read texel by texel, without levels."""
    for name in (GL.GL_TEXTURE_MIN_FILTER, GL.GL_TEXTURE_MAG_FILTER):
        GL.glTexParameteri(GL.GL_TEXTURE_2D, name, GL.GL_NEAREST)
