"""Pictures of digital copies."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.srgb import encode_srgb
from fitting.digital_copy import DigitalCopy
from render.adaptive import AdaptiveOptions
from render.bounded import BUDGET_PX
from render.errors import RenderError
from render.opengl import GL, HeadlessContext, OpenGLError, pyrender
from render.painting_maps import PaintingMaterial
from render.painting_node import Mode, painting_mesh
from render.painting_renderer import PaintingRenderer, RoomLight
from render.shader_program import Shown
from render.views import View, direction

BACKGROUND = (0.18, 0.18, 0.18)
# Colour and depth in OpenGL without a graphics card, and twice more while they are read.
_BYTES_PER_SAMPLE = 80
_MEMORY_SHARE = 0.8


@dataclass(frozen=True, kw_only=True)
class Light:
    """A point light on the canvas's middle.

    At ``distance_mm`` it gives the irradiance π · ``strength`` at the middle of the canvas for
    normal incidence, so that white paint facing it has the radiance ``strength``.

    Attributes
    ----------
    azimuth, elevation : float
        Radians, as for views.
    distance_mm : float or None
        None takes five times the larger side of the canvas.
    strength : float
    ambient : float
        Radiance of the surroundings, the same from everywhere.

    Raises
    ------
    RenderError
        A value that is not finite, a distance that is not positive, a negative strength.
    """

    azimuth: float = float(np.deg2rad(135.0))
    elevation: float = float(np.deg2rad(32.0))
    distance_mm: float | None = None
    strength: float = 1.0
    ambient: float = 0.06

    def __post_init__(self) -> None:
        if not np.isfinite([self.azimuth, self.elevation, self.strength, self.ambient]).all():
            raise RenderError(f"a light needs finite numbers: {self}")
        if self.distance_mm is not None and not 0 < self.distance_mm < np.inf:
            raise RenderError(f"a light's distance must be positive, not {self.distance_mm} mm")
        if min(self.strength, self.ambient) < 0:
            raise RenderError(f"a light's strength is not negative: {self}")


@dataclass(frozen=True)
class RenderedImage:
    """A linear picture.

    Attributes
    ----------
    radiance : (rows, cols, 3) float32 array
        Linear RGB.
    coverage : (rows, cols) float32 array
        Share of each pixel that anything of the scene covers.
    depth_mm : (rows, cols) float32 array
        Distance along the camera's axis at the sample nearest to the pixel's centre; 0 where
        nothing is.
    """

    radiance: NDArray[np.float32]
    coverage: NDArray[np.float32]
    depth_mm: NDArray[np.float32]

    def encoded(self, *, exposure: float = 1.0) -> NDArray[np.uint8]:
        """(rows, cols, 3) uint8 sRGB of the radiance times ``exposure``."""
        if not 0 < exposure < np.inf:
            raise RenderError(f"an exposure is a positive factor, not {exposure}")
        return np.asarray(np.round(255 * encode_srgb(self.radiance * exposure)), dtype=np.uint8)


class Painter:
    """Keeps an OpenGL context over many pictures; a context manager.

    The copy painted last stays on the graphics card, so that another view of it costs no more than
    its drawing.

    Parameters
    ----------
    supersampling : int
        Samples per pixel along each axis.

    Raises
    ------
    RenderError
        No usable OpenGL.
    """

    def __init__(self, *, supersampling: int = 2) -> None:
        if supersampling < 1:
            raise RenderError(f"at least one sample per pixel is needed, not {supersampling}")
        self._supersampling = supersampling
        self._context = HeadlessContext()
        self._renderer = PaintingRenderer(1, 1)
        self._material: tuple[DigitalCopy, PaintingMaterial] | None = None
        self._mesh: tuple[Mode, AdaptiveOptions | None, float, pyrender.Mesh] | None = None

    def paint(
        self,
        copy: DigitalCopy,
        view: View,
        *,
        mode: Mode = Mode.ADAPTIVE,
        width: int = 1024,
        height: int = 768,
        light: Light | None = None,
        adaptive: AdaptiveOptions | None = None,
        budget_px: float = BUDGET_PX,
        shadows: bool = False,
    ) -> RenderedImage:
        """Draw one copy on its own.

        Parameters
        ----------
        copy : DigitalCopy
        view : View
        mode : Mode
        width, height : int
            Of the picture in pixels.
        light : Light, optional
        adaptive : AdaptiveOptions, optional
            For :attr:`Mode.ADAPTIVE`.
        budget_px : float
            For :attr:`Mode.BOUNDED`: parallax that may be left, in pixels.
        shadows : bool
            Whether the relief casts shadows on itself.

        Returns
        -------
        RenderedImage

        Raises
        ------
        RenderError
            A size that OpenGL cannot draw, or a copy that the mode cannot.
        """
        self._refuse_size(width, height)
        mesh = self._kept_mesh(copy, mode, adaptive, budget_px)
        scene = painting_scene(copy, mesh, view, light or Light(), width / height)
        room_light = RoomLight() if shadows else None
        return self.paint_scene(scene, width=width, height=height, room_light=room_light)

    def paint_scene(
        self,
        scene: pyrender.Scene,
        *,
        width: int,
        height: int,
        room_light: RoomLight | None = None,
    ) -> RenderedImage:
        """Draw any pyrender scene, paintings among its nodes; units are mm.

        Parameters
        ----------
        scene : pyrender.Scene
        width, height : int
            Of the picture in pixels.
        room_light : RoomLight, optional
            None casts no shadows.

        Returns
        -------
        RenderedImage

        Raises
        ------
        RenderError
            A size or a scene that OpenGL cannot draw, or maps that give no finite radiance.
        """
        self._refuse_size(width, height)
        n = self._supersampling
        self._renderer.viewport_width, self._renderer.viewport_height = width * n, height * n
        flags = pyrender.RenderFlags.OFFSCREEN
        if room_light is not None:
            self._renderer.room_light = room_light
            flags |= pyrender.RenderFlags.SHADOWS_SPOT
        try:
            rgba, depth = self._renderer.render(scene, flags)
        except OpenGLError as error:
            raise RenderError(
                f"OpenGL cannot draw this at {width}×{height} ({error.__class__.__name__}: "
                f"{getattr(error, 'description', error)}); try a smaller picture or a smaller copy"
            ) from error
        fine = rgba.reshape(height, n, width, n, 4).mean(axis=(1, 3))
        if not np.isfinite(fine).all():
            raise RenderError("the picture has values that are not finite; check the copy's maps")
        return RenderedImage(
            fine[..., :3].astype(np.float32),
            fine[..., 3].astype(np.float32),
            np.ascontiguousarray(depth[n // 2 :: n, n // 2 :: n]),
        )

    def points(
        self,
        copy: DigitalCopy,
        view: View,
        *,
        mode: Mode,
        width: int,
        height: int,
        adaptive: AdaptiveOptions | None = None,
        budget_px: float = BUDGET_PX,
    ) -> NDArray[np.float32]:
        """Where a mode has the surface: canvas frame, mm; NaN where nothing is.

        Of a plane it is the plane's point, of a blended box the mixture.

        Returns
        -------
        (rows, cols, 3) float32 array
            At the middle of each pixel.
        """
        shown = self._shown(Shown.POINT, copy, view, mode, width, height, adaptive, budget_px)
        return np.where(shown[..., 3:] > 0, shown[..., :3], np.float32(np.nan))

    def work(
        self,
        copy: DigitalCopy,
        view: View,
        *,
        mode: Mode,
        width: int,
        height: int,
        adaptive: AdaptiveOptions | None = None,
        budget_px: float = BUDGET_PX,
    ) -> NDArray[np.float32]:
        """Steps of the searches and number of fragments in each pixel, (rows, cols, 2).

        All fragments are counted that could be drawn, the hidden ones among them.
        """
        return self._shown(Shown.WORK, copy, view, mode, width, height, adaptive, budget_px)[
            ..., :2
        ]

    def cost(
        self,
        copy: DigitalCopy,
        view: View,
        *,
        mode: Mode,
        width: int,
        height: int,
        adaptive: AdaptiveOptions | None = None,
        budget_px: float = BUDGET_PX,
    ) -> tuple[float, float]:
        """Processor seconds of drawing the painting, and of the whole picture."""
        self._renderer.painting_cpu_s = 0.0
        began = time.process_time()
        try:
            self.paint(
                copy,
                view,
                mode=mode,
                width=width,
                height=height,
                adaptive=adaptive,
                budget_px=budget_px,
            )
            return self._renderer.painting_cpu_s, time.process_time() - began
        finally:
            self._renderer.painting_cpu_s = None

    def _shown(
        self,
        shown: Shown,
        copy: DigitalCopy,
        view: View,
        mode: Mode,
        width: int,
        height: int,
        adaptive: AdaptiveOptions | None,
        budget_px: float,
    ) -> NDArray[np.float32]:
        self._refuse_size(width, height)
        mesh = self._kept_mesh(copy, mode, adaptive, budget_px)
        scene = painting_scene(copy, mesh, view, Light(), width / height)
        scene.bg_color = np.zeros(4)
        self._renderer.viewport_width, self._renderer.viewport_height = width, height
        self._renderer.shown = shown
        try:
            rgba, _ = self._renderer.render(scene, pyrender.RenderFlags.OFFSCREEN)
        finally:
            self._renderer.shown = Shown.RADIANCE
        return np.asarray(rgba)

    def _refuse_size(self, width: int, height: int) -> None:
        self._context.make_current()
        largest = int(GL.glGetIntegerv(GL.GL_MAX_RENDERBUFFER_SIZE)) // self._supersampling
        if not (0 < width <= largest and 0 < height <= largest):
            raise RenderError(
                f"a picture of {width}×{height} cannot be drawn; this OpenGL draws up to "
                f"{largest}×{largest} at {self._supersampling}×{self._supersampling} samples"
            )
        needed = width * height * self._supersampling**2 * _BYTES_PER_SAMPLE
        there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        if needed > _MEMORY_SHARE * there:
            raise RenderError(
                f"a picture of {width}×{height} cannot be drawn: it takes about "
                f"{needed / 1e9:.0f} GB of memory, and this machine has {there / 1e9:.0f} GB"
            )

    def _kept_mesh(
        self, copy: DigitalCopy, mode: Mode, adaptive: AdaptiveOptions | None, budget_px: float
    ) -> pyrender.Mesh:
        if self._material is None or self._material[0] is not copy:
            self._material = (copy, PaintingMaterial(copy))
            self._mesh = None
        if self._mesh is None or self._mesh[:3] != (mode, adaptive, budget_px):
            mesh = painting_mesh(
                copy, mode, adaptive=adaptive, material=self._material[1], budget_px=budget_px
            )
            self._mesh = (mode, adaptive, budget_px, mesh)
        return self._mesh[3]

    def close(self) -> None:
        """Free the OpenGL context."""
        self._context.make_current()
        self._renderer.delete()
        self._context.close()

    def __enter__(self) -> Painter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def painting_scene(
    copy: DigitalCopy, mesh: pyrender.Mesh, view: View, light: Light, aspect: float
) -> pyrender.Scene:
    """A scene in the canvas frame of one copy, its camera and its light.

    Parameters
    ----------
    copy : DigitalCopy
    mesh : pyrender.Mesh
        The copy in one of the modes, from :func:`render.painting_node.painting_mesh`.
    view : View
    light : Light
    aspect : float
        Width of the picture over its height.

    Returns
    -------
    pyrender.Scene
        Other nodes may be added, frames and walls for example, in mm.
    """
    scene = pyrender.Scene(bg_color=[*BACKGROUND, 0.0], ambient_light=[light.ambient] * 3)
    scene.add(mesh)
    near, far = clip_planes(copy, view.position)
    camera = pyrender.PerspectiveCamera(
        yfov=view.field_of_view, aspectRatio=aspect, znear=near, zfar=far
    )
    scene.add(camera, pose=view.pose())
    lamp, pose = lamp_of(copy, light)
    scene.add(lamp, pose=pose)
    return scene


def lamp_of(copy: DigitalCopy, light: Light) -> tuple[pyrender.PointLight, NDArray[np.float64]]:
    """A light as pyrender has it, and its pose (4, 4) in the canvas frame of a copy."""
    away = light.distance_mm
    if away is None:
        away = 5 * max(copy.height_field.size_mm)
    pose = np.eye(4)
    pose[:3, 3] = away * direction(light.azimuth, light.elevation)
    intensity = np.pi * light.strength * away**2
    return pyrender.PointLight(color=[1.0, 1.0, 1.0], intensity=intensity), pose


def clip_planes(copy: DigitalCopy, camera: NDArray[np.float64]) -> tuple[float, float]:
    """Nearest and farthest depth of what a camera at (3,) in the canvas frame can see, mm."""
    distance = float(np.linalg.norm(camera))
    width, height = copy.height_field.size_mm
    low, high = copy.height_field.height_range_mm
    x0, y0 = copy.height_field.origin_mm
    box_low = np.array([x0, y0 - height, min(low, copy.relief.delta0_mm)])
    box_high = np.array([x0 + width, y0, max(high, copy.relief.delta0_mm)])
    gap = np.maximum(0.0, np.maximum(box_low - camera, camera - box_high))
    nearest = max(1e-4 * distance, 0.2 * float(np.linalg.norm(gap)))
    return nearest, distance + float(np.hypot(width, height)) + abs(low) + abs(high)
