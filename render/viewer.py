"""A window in which a copy is looked at: pyrender's viewer with the painting's renderer.

Call :func:`render.windows.draw_in_windows` before this is imported.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import OpenGL
import pyglet
from numpy.typing import NDArray
from pyglet.window import key

from fitting.digital_copy import DigitalCopy
from render.captions import caption_picture
from render.errors import RenderError
from render.opengl import pyrender
from render.painter import clip_planes, lamp_of, painting_scene
from render.painting_maps import PaintingMaterial
from render.painting_node import Mode, painting_mesh
from render.viewer_state import ViewerState
from render.views import NamedView, View, named_view
from render.window_renderer import WindowRenderer
from render.windows import in_windows, no_display

_RATE = 60.0  # at which the window looks for something to do, Hz
_REST_S = 0.25  # without a change, after which the picture is drawn once more, finely
_FINE = 2  # samples along each axis of a pixel, at rest
_TURN = np.deg2rad(5.0)
_FARTHER = 1.25
_LARGER = np.sqrt(2.0)
_HELP = (
    "1-7, M: mode   arrows, comma, period: light   +, -: budget   S: shadows   [, ]: exposure",
    "mouse: drag to turn, shift-drag to move, wheel to zoom   V: view   R: back   "
    "F: full screen   C: caption   Q: quit",
)


_CHANGES: dict[int, Callable[[ViewerState], ViewerState]] = {
    key.LEFT: lambda shown: shown.with_light(turn=_TURN),
    key.RIGHT: lambda shown: shown.with_light(turn=-_TURN),
    key.UP: lambda shown: shown.with_light(rise=_TURN),
    key.DOWN: lambda shown: shown.with_light(rise=-_TURN),
    key.COMMA: lambda shown: shown.with_light(away=1 / _FARTHER),
    key.PERIOD: lambda shown: shown.with_light(away=_FARTHER),
    key.PLUS: lambda shown: shown.with_budget(_LARGER),
    key.EQUAL: lambda shown: shown.with_budget(_LARGER),
    key.NUM_ADD: lambda shown: shown.with_budget(_LARGER),
    key.MINUS: lambda shown: shown.with_budget(1 / _LARGER),
    key.NUM_SUBTRACT: lambda shown: shown.with_budget(1 / _LARGER),
    key.S: lambda shown: replace(shown, shadows=not shown.shadows),
    key.C: lambda shown: replace(shown, caption=not shown.caption),
    key.M: lambda shown: shown.with_mode(1),
    key.BRACKETLEFT: lambda shown: replace(shown, exposure=shown.exposure / _FARTHER),
    key.BRACKETRIGHT: lambda shown: replace(shown, exposure=shown.exposure * _FARTHER),
}
_MODES = {key._1 + number: mode for number, mode in enumerate(Mode)}


class PaintingViewer(pyrender.Viewer):
    """A window that shows a copy; a context manager.

    Parameters
    ----------
    copy : DigitalCopy
    view : View
        At the beginning.
    shown : ViewerState
        At the beginning; a light without a distance is put at its usual one.
    width, height : int
        Of the window in pixels.
    title : str
    between_frames : callable
        Called many times a second; what it raises ends :meth:`run`.

    Raises
    ------
    RenderError
        No display, no OpenGL 4.1 on it, or a copy that the mode cannot draw.
    """

    _viewport_size: tuple[int, int]
    _renderer: WindowRenderer | None

    def __init__(
        self,
        copy: DigitalCopy,
        view: View,
        shown: ViewerState,
        *,
        width: int = 1024,
        height: int = 768,
        title: str = "Impasto",
        between_frames: Callable[[], None] = lambda: None,
    ) -> None:
        if not in_windows():
            raise RenderError("call render.windows.draw_in_windows() before anything is drawn")
        self._copy = copy
        self._material = PaintingMaterial(copy)
        self._between_frames = between_frames
        if shown.light.distance_mm is None:
            usual = 5 * max(copy.height_field.size_mm)
            shown = replace(shown, light=replace(shown.light, distance_mm=usual))
        self.shown = shown
        self._first_view = view
        self._named = -1
        self._changed_at = time.monotonic()
        self._drawn, self._fine = False, False
        self._complaint = ""
        scene = painting_scene(copy, self._mesh(shown), view, shown.light, width / height)
        try:
            super().__init__(
                scene,
                viewport_size=(width, height),
                viewer_flags={"window_title": title, "view_center": np.zeros(3)},
            )
        except RenderError:
            raise
        except Exception as error:  # pyglet has a dozen types of its own
            raise no_display(f"{type(error).__name__}: {error}") from error

    def _mesh(self, shown: ViewerState) -> pyrender.Mesh:
        return painting_mesh(
            self._copy, shown.mode, material=self._material, budget_px=shown.budget_px
        )

    def _init_and_start_app(self) -> None:
        """Open the window; :meth:`run` starts it."""
        width, height = self._viewport_size
        kind: Any = pyglet.gl.Config
        config = kind(double_buffer=True, major_version=4, minor_version=1)
        try:
            # Past pyrender's own constructor, which this is called from.
            super(pyrender.Viewer, self).__init__(
                config=config, resizable=True, width=width, height=height, vsync=False
            )
        except (pyglet.window.NoSuchConfigException, pyglet.gl.ContextException) as error:
            raise RenderError(
                f"the display has no OpenGL 4.1 ({error}); update its driver, or use impasto render"
            ) from error
        self.switch_to()
        self._renderer = WindowRenderer(width, height)
        self.set_caption(self.viewer_flags["window_title"])

    def figures(self) -> dict[str, Any]:
        """What is shown, and was last: mode, light in degrees and mm, camera to canvas (4, 4)."""
        shown = self.shown
        azimuth, elevation = np.rad2deg([shown.light.azimuth, shown.light.elevation])
        return {
            "mode": str(shown.mode),
            "budget_px": shown.budget_px,
            "light": [float(azimuth), float(elevation), shown.light.distance_mm],
            "shadows": shown.shadows,
            "exposure": shown.exposure,
            "camera_pose": self._trackball.pose.tolist(),
        }

    def run(self) -> None:
        """Show the window until it is closed."""
        pyglet.clock.schedule_interval(self._tick, 1 / _RATE)
        try:
            pyglet.app.run(interval=None)
        finally:
            pyglet.clock.unschedule(self._tick)
            self.on_close()

    def _tick(self, dt: float) -> None:
        self._between_frames()
        resting = time.monotonic() - self._changed_at > _REST_S
        if self._renderer is not None and (not self._drawn or (resting and not self._fine)):
            self._fine = resting
            self.draw(dt)

    def _change(self) -> None:
        self._changed_at = time.monotonic()
        self._drawn = self._fine = False

    def on_draw(self) -> None:
        """Draw the scene, and what it is a picture of."""
        if self._renderer is None:
            return
        pose = self._trackball.pose
        self._camera_node.matrix = pose.copy()
        camera = self._camera_node.camera
        camera.znear, camera.zfar = clip_planes(self._copy, pose[:3, 3])
        camera.aspectRatio = self._viewport_size[0] / self._viewport_size[1]
        if not self._drawn:
            self._renderer.set_caption(self._caption_picture())
        self._renderer.show(
            self.scene,
            size=self._viewport_size,
            samples=_FINE if self._fine else 1,
            exposure=self.shown.exposure,
            shadows=self.shown.shadows,
        )
        self._drawn = True

    def _caption_picture(self) -> NDArray[np.uint8] | None:
        if not self.shown.caption:
            return None
        width, height = self._viewport_size
        top = [self.shown.describe()] + ([self._complaint] if self._complaint else [])
        return caption_picture(top, list(_HELP), width=width, height=height)

    def on_key_press(self, symbol: int, modifiers: int) -> None:
        """Change what is shown; see the last lines of the caption."""
        if symbol in (key.Q, key.ESCAPE):
            self.on_close()
        elif symbol == key.F:
            self.set_fullscreen(not self.fullscreen)
        elif symbol in (key.R, key.V):
            self._named = -1 if symbol == key.R else (self._named + 1) % len(NamedView)
            self._look_from(self._named)
        elif symbol in _MODES:
            self._show(replace(self.shown, mode=_MODES[symbol]))
        elif symbol == key.M and modifiers & key.MOD_SHIFT:
            self._show(self.shown.with_mode(-1))
        elif symbol in _CHANGES:
            self._show(_CHANGES[symbol](self.shown))
        else:
            return
        self._change()

    def _look_from(self, named: int) -> None:
        view = self._first_view
        if named >= 0:
            width, height = self._viewport_size
            name = list(NamedView)[named]
            view = named_view(
                self._copy, name, aspect=width / height, field_of_view=view.field_of_view
            )
        self._default_camera_pose = view.pose()
        self._reset_view()

    def _show(self, shown: ViewerState) -> None:
        """Change what is shown; a mode that cannot draw the copy is passed over."""
        self._complaint = ""
        drawn_alike = (shown.mode, shown.budget_px) == (self.shown.mode, self.shown.budget_px)
        if not drawn_alike:
            try:
                mesh = self._mesh(shown)
            except RenderError as error:
                self._complaint = str(error)
                return
            (node,) = self.scene.mesh_nodes
            self.scene.remove_node(node)
            self.scene.add(mesh)
        lamp, pose = lamp_of(self._copy, shown.light)
        (node,) = self.scene.point_light_nodes
        node.light.intensity = lamp.intensity
        self.scene.set_pose(node, pose)
        self.shown = shown

    def on_expose(self) -> None:
        """Draw what was hidden."""
        self._change()

    def on_resize(self, width: int, height: int) -> None:
        """Draw as large as the window is."""
        if self._renderer is None or min(width, height) < 1:
            return
        self._viewport_size = (width, height)
        self._trackball.resize(self._viewport_size)
        self._change()

    def on_mouse_drag(self, *event: Any) -> None:
        """Turn or move the view."""
        super().on_mouse_drag(*event)
        self._change()

    def on_mouse_scroll(self, *event: Any) -> None:
        """Go nearer or farther."""
        super().on_mouse_scroll(*event)
        self._change()

    def on_close(self) -> None:
        """Free the context and close the window; a second time does nothing."""
        if self._renderer is None:
            return
        self.switch_to()
        self._renderer.delete()
        self._renderer = None
        OpenGL.contextdata.cleanupContext()
        self.close()
        self._is_active = False
        pyglet.app.exit()

    def __enter__(self) -> PaintingViewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.on_close()
