"""GLSL programs composed of the pieces in ``render/shaders``."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.errors import RenderError
from render.opengl import GL, pyrender

_VERSION = "#version 410 core\n"
_SHADERS = Path(__file__).with_name("shaders")
# The last line of pyrender 0.1.45's mesh.frag, and what a linear float framebuffer needs instead.
_ENCODED = (
    "frag_color = clamp(vec4(pow(color.xyz, vec3(1.0/2.2)), color.a * base_color.a), 0.0, 1.0);"
)
_LINEAR = "frag_color = vec4(color.xyz, color.a * base_color.a);"
# Its shadow and its ambient light, and where ours come in.
_SHADOW = "float shadow_calc(mat4 light_matrix, sampler2D shadow_map, float nl)\n{\n"
_SOFT_SHADOW = """
    return 1.0 - soft_light(light_matrix, shadow_map, frag_position, normalize(get_normal()));
"""
_AMBIENT = "color.xyz += base_color.xyz * ambient_light;"
_SLOPING = "color.xyz += base_color.xyz * ambient_light * (1.0 + dot(n, ambient_slope));"
SHADOWS = "SHADOWS"
"""Variant of every fragment shader: with shadows, and ambient light that has a direction."""


class Shown(IntEnum):
    """What the painting's shaders write."""

    RADIANCE = 0
    POINT = 1
    """Where the surface was hit (mm, canvas frame); of a plane, the plane's point."""
    WORK = 2
    """Steps of the search and one per fragment, summed over all fragments of a pixel."""


class PaintingProgram:
    """A program of the painting, with the interface that pyrender's renderer expects.

    Parameters
    ----------
    vertex, fragment : str
        File names; the fragment shader is preceded by what it shares with others.
    shown : Shown
        What the fragment shader writes.
    variant : str
        Names to be defined, separated by spaces.

    Raises
    ------
    RenderError
        The driver refuses a shader.
    """

    def __init__(
        self, vertex: str, fragment: str, variant: str = "", shown: Shown = Shown.RADIANCE
    ) -> None:
        shared = _shared_by(fragment, variant)
        parts = (
            (GL.GL_VERTEX_SHADER, vertex, _source(vertex)),
            (GL.GL_FRAGMENT_SHADER, fragment, "".join(map(_source, [*shared, fragment]))),
        )
        defined = "".join(f"#define {name}\n" for name in variant.split())
        opening = f"{_VERSION}#define SHOWN {shown}\n{defined}"
        self._program = GL.glCreateProgram()
        for kind, name, text in parts:
            shader = GL.glCreateShader(kind)
            GL.glShaderSource(shader, opening + text)
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
        location = self._location(name)
        if location < 0:
            return
        array = np.asarray(value)
        if array.dtype.kind in "biu":
            if array.ndim == 0:
                GL.glUniform1i(location, int(array))
            else:
                GL.glUniform2i(location, *(int(number) for number in array))
        elif array.ndim == 0:
            GL.glUniform1f(location, float(array))
        elif array.ndim == 1:
            # Single numbers: PyOpenGL takes several times as long over an array.
            setter = {2: GL.glUniform2f, 3: GL.glUniform3f, 4: GL.glUniform4f}[len(array)]
            setter(location, *(float(number) for number in array))
        else:
            matrix = np.ascontiguousarray(array, np.float32)
            GL.glUniformMatrix4fv(location, 1, GL.GL_TRUE, matrix)

    def set_double(self, name: str, value: NDArray[np.float64]) -> None:
        """Set a uniform of one, two or three doubles."""
        location = self._location(name)
        if location >= 0:
            setter = {1: GL.glUniform1d, 2: GL.glUniform2d, 3: GL.glUniform3d}[value.size]
            setter(location, *(float(number) for number in value.flat))

    def uses(self, name: str) -> bool:
        """Whether the shaders read a uniform."""
        return self._location(name) >= 0

    def _location(self, name: str) -> int:
        if name not in self._locations:
            self._locations[name] = GL.glGetUniformLocation(self._program, name)
        return self._locations[name]

    def _bind(self) -> None:
        GL.glUseProgram(self._program)

    def _unbind(self) -> None:
        GL.glUseProgram(0)

    def delete(self) -> None:
        """Free the program."""
        GL.glDeleteProgram(self._program)


def _shared_by(fragment: str, variant: str) -> list[str]:
    """What a fragment shader is preceded by."""
    shadows = SHADOWS in variant.split()
    shared = ["surface.glsl"]
    if shadows or fragment == "exact.frag":
        shared.append("triangles.glsl")
    return [*shared, "shadows.glsl", "soft_shadow.glsl"] if shadows else shared


def _source(name: str) -> str:
    return (_SHADERS / name).read_text()


class LinearProgram(pyrender.shader_program.ShaderProgram):
    """A program of pyrender's own that leaves radiance linear and unclamped.

    Its shadows are those of a lamp that is no point, and its ambient light may have a direction.

    Raises
    ------
    RenderError
        Another pyrender, whose shader ends otherwise.
    """

    def _load(self, shader_filename: str) -> str:
        text: str = super()._load(shader_filename)
        if Path(shader_filename).name != "mesh.frag":
            return text
        for theirs, ours in (
            (_ENCODED, _LINEAR),
            (_SHADOW, _source("soft_shadow.glsl") + _SHADOW + _SOFT_SHADOW),
            (_AMBIENT, _SLOPING),
            ("uniform vec3 ambient_light;", "uniform vec3 ambient_light, ambient_slope;"),
        ):
            if theirs not in text:
                raise RenderError("this pyrender's mesh.frag is not that of 0.1.45; install 0.1.45")
            text = text.replace(theirs, ours)
        return text


class LinearProgramCache(pyrender.shader_program.ShaderProgramCache):
    """pyrender's cache of programs, of :class:`LinearProgram`; one per OpenGL context."""

    def get_program(
        self,
        vertex_shader: str,
        fragment_shader: str,
        geometry_shader: str | None = None,
        defines: dict[str, Any] | None = None,
    ) -> LinearProgram:
        """A program by its shader files and definitions, made where it is new."""
        names = (vertex_shader, fragment_shader, geometry_shader)
        key = (*names, *sorted((defines or {}).items()))
        if key not in self._program_cache:
            paths = [None if name is None else str(Path(self.shader_dir) / name) for name in names]
            self._program_cache[key] = LinearProgram(*paths, defines=defines)
        return self._program_cache[key]
