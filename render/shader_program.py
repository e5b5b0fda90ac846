"""GLSL programs composed of the pieces in ``render/shaders``."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import numpy as np

from render.errors import RenderError
from render.opengl import GL

_VERSION = "#version 410 core\n"


class PaintingProgram:
    """A program of the painting, with the interface that pyrender's renderer expects.

    Parameters
    ----------
    vertex, fragment : str
        File names; the fragment shader is preceded by ``surface.glsl``.

    Raises
    ------
    RenderError
        The driver refuses a shader.
    """

    def __init__(self, vertex: str, fragment: str) -> None:
        source = files("render") / "shaders"
        shared = (source / "surface.glsl").read_text()
        parts = (
            (GL.GL_VERTEX_SHADER, vertex, (source / vertex).read_text()),
            (GL.GL_FRAGMENT_SHADER, fragment, shared + (source / fragment).read_text()),
        )
        self._program = GL.glCreateProgram()
        for kind, name, text in parts:
            shader = GL.glCreateShader(kind)
            GL.glShaderSource(shader, _VERSION + text)
            GL.glCompileShader(shader)
            if not GL.glGetShaderiv(shader, GL.GL_COMPILE_STATUS):
                log = GL.glGetShaderInfoLog(shader).decode(errors="replace")
                raise RenderError(f"the OpenGL driver refuses {name}: {log}")
            GL.glAttachShader(self._program, shader)
            GL.glDeleteShader(shader)
        GL.glLinkProgram(self._program)
        if not GL.glGetProgramiv(self._program, GL.GL_LINK_STATUS):
            log = GL.glGetProgramInfoLog(self._program).decode(errors="replace")
            raise RenderError(f"the OpenGL driver cannot link {vertex} and {fragment}: {log}")
        self._locations: dict[str, int] = {}

    def set_uniform(self, name: str, value: Any) -> None:
        """Set a uniform; names that the shaders do not use are passed over, as GL does."""
        if name not in self._locations:
            self._locations[name] = GL.glGetUniformLocation(self._program, name)
        location = self._locations[name]
        if location < 0:
            return
        array = np.asarray(value)
        if array.ndim == 0 and array.dtype.kind in "biu":
            GL.glUniform1i(location, int(array))
        elif array.ndim == 0:
            GL.glUniform1f(location, float(array))
        elif array.ndim == 1:
            setter = {2: GL.glUniform2fv, 3: GL.glUniform3fv, 4: GL.glUniform4fv}[len(array)]
            setter(location, 1, np.ascontiguousarray(array, np.float32))
        else:
            matrix = np.ascontiguousarray(array, np.float32)
            GL.glUniformMatrix4fv(location, 1, GL.GL_TRUE, matrix)

    def _bind(self) -> None:
        GL.glUseProgram(self._program)

    def _unbind(self) -> None:
        GL.glUseProgram(0)

    def delete(self) -> None:
        """Free the program."""
        GL.glDeleteProgram(self._program)
