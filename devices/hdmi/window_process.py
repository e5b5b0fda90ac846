"""The process that owns a projector's window; run by :mod:`devices.hdmi.window_link`.

It shows pictures pixel by pixel: the fragment shader fetches one texel per pixel of the screen,
without coordinates that could be scaled or a filter. It ends, and the window with it, when the pipe
from its parent closes or brings no sign of life.
"""

from __future__ import annotations

import ctypes
import errno
import itertools
import json
import mmap
import os
import select
import signal
import socket
import statistics
import sys
import time
from typing import Any

from devices.errors import DeviceError, DeviceLostError, ImpastoError
from devices.hdmi.screens import Screen, as_fields, load_pyglet, mode_size, read_screens

_COMMANDS_FD = 0
# A driver may queue two frames before a flip waits; when the third has returned the first is out.
_FLIPS = 3
_TIMED_FLIPS = 15
_USUAL_REFRESH_HZ = 60.0
_SCREEN_SAVER_S = 30.0
_VERTEX = """#version 330 core
void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(corner, 0.0, 1.0);
}
"""
_FRAGMENT = """#version 330 core
uniform sampler2D picture;
out vec4 color;
void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    int row = textureSize(picture, 0).y - 1 - pixel.y;
    color = vec4(texelFetch(picture, ivec2(pixel.x, row), 0).rrr, 1.0);
}
"""


class _Pipe:
    """Commands from the parent and answers to it, on descriptors that nothing else prints to."""

    def __init__(self) -> None:
        self._answers = os.dup(1)
        os.dup2(2, 1)
        self._pending = b""
        self.closed = False

    def answer(self, **fields: Any) -> None:
        os.write(self._answers, json.dumps(fields).encode() + b"\n")

    def commands(self) -> list[str]:
        """Whole lines that have come; a closed pipe is remembered."""
        if select.select([_COMMANDS_FD], [], [], 0)[0]:
            part = os.read(_COMMANDS_FD, 4096)
            self.closed = not part
            self._pending += part
        *lines, self._pending = self._pending.split(b"\n")
        return [line.decode() for line in lines]


class _Window:
    """A black window that fills a screen, and the picture on it."""

    def __init__(self, pyglet: Any, screen: Screen, pyglet_screen: Any, memory: int) -> None:
        self._gl = gl = pyglet.gl
        self._xlib = pyglet.libs.x11.xlib
        self._screen = screen
        self._pyglet_screen = pyglet_screen
        self.gone = False
        self._exposed = False
        self._blank = True
        self._window = _leave_mouse_alone(pyglet.window.Window)(
            screen=pyglet_screen,
            fullscreen=True,
            vsync=True,
            caption="Impasto projector",
            config=gl.Config(
                double_buffer=True, red_size=8, green_size=8, blue_size=8, sample_buffers=0
            ),
        )
        self._window.set_mouse_visible(False)
        # Neither the Escape key nor the close button takes the light from a recording.
        self._window.on_key_press = lambda *_: None
        self._window.on_close = self._mark_gone
        self._window.on_hide = self._mark_gone
        self._window.on_expose = self._mark_exposed
        size = screen.mode_width * screen.mode_height
        self._memory = mmap.mmap(memory, size)
        self._picture = (ctypes.c_ubyte * size).from_buffer(self._memory)
        self._prepare(pyglet)
        self.present()
        self.check()

    @property
    def fileno(self) -> int:
        """Descriptor on which the X server's events arrive."""
        return int(self._window.display.fileno())

    def load(self) -> None:
        """Take the picture from shared memory; it is what the next frames show."""
        gl, screen = self._gl, self._screen
        gl.glTexSubImage2D(
            gl.GL_TEXTURE_2D, 0, 0, 0, screen.mode_width, screen.mode_height,
            gl.GL_RED, gl.GL_UNSIGNED_BYTE, self._picture,
        )  # fmt: skip
        self._blank = False

    def darken(self) -> None:
        """Show black from the next frame on."""
        self._blank = True

    def present(self) -> float:
        """Draw and flip until the frame is certainly on the screen; returns that moment."""
        for _ in range(_FLIPS):
            self._draw()
            self._window.flip()
            self._gl.glFinish()
        # Without direct rendering the frame goes through the X server, which may lag behind.
        self._xlib.XSync(self._window.display._display, False)
        self._exposed = False
        return time.monotonic()

    def dispatch_events(self) -> None:
        """Obey the window system, and draw again what it has overdrawn."""
        self._window.dispatch_events()
        if self._exposed:
            self.present()

    def keep_awake(self) -> None:
        """Put off the screen saver, and the screen's standby with it."""
        self._xlib.XResetScreenSaver(self._window.display._display)

    def check(self) -> None:
        """Refuse a window that is not, pixel by pixel, the whole screen.

        Raises
        ------
        DeviceError
            The window system has moved, resized, hidden or closed it.
        """
        if self.gone:
            raise DeviceLostError("the projector's window was closed or hidden")
        screen = self._screen
        if mode_size(self._pyglet_screen) != (screen.mode_width, screen.mode_height):
            raise DeviceError(
                f"screen {screen.name} was switched off, unplugged, or set to another mode; look "
                "at its cable and open the projector again"
            )
        size, place = self._window.get_framebuffer_size(), self._window.get_location()
        if size != (screen.width, screen.height) or place != (screen.x, screen.y):
            raise DeviceError(
                f"the projector's window is {size[0]}×{size[1]} at {place} and its screen "
                f"{screen.width}×{screen.height} at {(screen.x, screen.y)}; something else on the "
                "desktop (a panel, a tiling window manager) moves windows on that screen"
            )

    def check_pixels(self) -> None:
        """Draw a pattern of single pixels and read it back, level by level.

        Raises
        ------
        DeviceError
            The graphics driver changes pictures.
        """
        gl, (width, height) = self._gl, (self._screen.mode_width, self._screen.mode_height)
        ramp = bytes(level * 7 % 256 for level in range(256)) * (width // 256 + 2)
        rows = [ramp[row * 131 % 256 :][:width] for row in range(height)]
        self._memory[:] = b"".join(rows)
        self.load()
        self._draw()
        shown = (ctypes.c_ubyte * (width * height))()
        gl.glReadPixels(0, 0, width, height, gl.GL_GREEN, gl.GL_UNSIGNED_BYTE, shown)
        self._blank = True
        if bytes(shown) != b"".join(reversed(rows)):
            raise DeviceError(
                "the graphics driver does not draw pictures pixel by pixel as they are; switch "
                "off its sharpening, dithering and scaling"
            )

    def time_flips(self) -> float:
        """Median time from one flip to the next, seconds."""
        moments = []
        for _ in range(_TIMED_FLIPS + 1):
            self._draw()
            self._window.flip()
            self._gl.glFinish()
            moments.append(time.monotonic())
        return statistics.median(b - a for a, b in itertools.pairwise(moments))

    def close(self) -> None:
        """Black, then gone."""
        self._blank = True
        self.present()
        self._window.close()

    def _prepare(self, pyglet: Any) -> None:
        gl, screen = self._gl, self._screen
        self._window.switch_to()
        shader = pyglet.graphics.shader
        self._program = shader.ShaderProgram(
            shader.Shader(_VERTEX, "vertex"), shader.Shader(_FRAGMENT, "fragment")
        )
        arrays = gl.GLuint()
        gl.glGenVertexArrays(1, arrays)
        gl.glBindVertexArray(arrays)
        texture = gl.GLuint()
        gl.glGenTextures(1, texture)
        gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
        for parameter in (gl.GL_TEXTURE_MIN_FILTER, gl.GL_TEXTURE_MAG_FILTER):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, parameter, gl.GL_NEAREST)
        gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
        gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
        gl.glTexImage2D(
            gl.GL_TEXTURE_2D, 0, gl.GL_R8, screen.mode_width, screen.mode_height, 0,
            gl.GL_RED, gl.GL_UNSIGNED_BYTE, None,
        )  # fmt: skip
        for capability in (gl.GL_DITHER, gl.GL_BLEND, gl.GL_FRAMEBUFFER_SRGB):
            gl.glDisable(capability)
        gl.glViewport(0, 0, screen.mode_width, screen.mode_height)
        gl.glClearColor(0.0, 0.0, 0.0, 1.0)
        self._program.use()

    def _draw(self) -> None:
        if self._blank:
            self._gl.glClear(self._gl.GL_COLOR_BUFFER_BIT)
        else:
            self._gl.glDrawArrays(self._gl.GL_TRIANGLES, 0, 3)

    def _mark_gone(self, *_: Any) -> None:
        self.gone = True

    def _mark_exposed(self, *_: Any) -> None:
        self._exposed = True


def _leave_mouse_alone(window: Any) -> Any:
    """The class of window, but for pyglet's habit of keeping the mouse inside a full screen.

    The operator's mouse is needed on the other screen.
    """

    class Window(window):
        def _update_exclusivity(self) -> None:
            self._applied_mouse_exclusive = False

    return Window


def _open_window(pyglet: Any, request: dict[str, Any]) -> tuple[_Window, Screen]:
    screens = read_screens(pyglet)
    for screen, pyglet_screen in screens:
        if screen.name == request["screen"]:
            screen.check_native(request["width"], request["height"])
            return _Window(pyglet, screen, pyglet_screen, request["memory"]), screen
    names = ", ".join(f"{screen.name} ({screen.description})" for screen, _ in screens)
    raise DeviceError(f"no screen {request['screen']!r}; there are: {names or 'none'}")


def _take_screen(name: str) -> socket.socket:
    """Hold a screen for as long as this process lives: a second window would cover the first.

    Raises
    ------
    DeviceError
        Another program of this computer projects on it.
    """
    held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        # A name without a file, which the system takes back however the process ends.
        held.bind(f"\0impasto projects on {os.environ.get('DISPLAY')} {name}"[:100])
    except OSError as error:
        held.close()
        if error.errno != errno.EADDRINUSE:
            raise
        raise DeviceError(
            f"another program projects on screen {name}; end it, or close its projector, first"
        ) from None
    return held


def _frame_period(window: _Window, screen: Screen) -> tuple[float, bool]:
    """Time of a frame, seconds, and whether flips wait for it."""
    measured = window.time_flips()
    if screen.refresh_hz > 0:
        return 1 / screen.refresh_hz, measured > 0.8 / screen.refresh_hz
    # A screen that does not tell its refresh gives nothing to hold flips against.
    return 1 / _USUAL_REFRESH_HZ, False


def _obey(command: str, window: _Window, pipe: _Pipe) -> None:
    word, _, number = command.partition(" ")
    if word == "alive":
        return
    if word == "show":
        window.load()
    elif word == "blank":
        window.darken()
    else:
        raise DeviceError(f"the projector's window does not know the command {command!r}")
    moment = window.present()
    window.check()
    pipe.answer(done=int(number), monotonic_s=moment)


def _serve(window: _Window, pipe: _Pipe, stall_s: float) -> None:
    """Obey commands until the pipe closes, the parent stalls or says so, or the window is gone."""
    heard = awake = time.monotonic()
    while not window.gone:
        # Events may wait inside Xlib already, where select does not see them.
        window.dispatch_events()
        select.select([_COMMANDS_FD, window.fileno], [], [], min(0.5, stall_s / 10))
        for command in pipe.commands():
            heard = time.monotonic()
            if command == "close":
                return
            _obey(command, window, pipe)
        if pipe.closed or time.monotonic() - heard > stall_s:
            return
        if time.monotonic() - awake > _SCREEN_SAVER_S:
            awake = time.monotonic()
            window.keep_awake()
    raise DeviceLostError("the projector's window was closed or hidden")


def _run(request: dict[str, Any], pipe: _Pipe) -> None:
    pyglet = load_pyglet()
    if request.get("list"):
        pipe.answer(screens=[as_fields(screen) for screen, _ in read_screens(pyglet)])
        return
    with _take_screen(request["screen"]):
        _project(pyglet, request, pipe)


def _project(pyglet: Any, request: dict[str, Any], pipe: _Pipe) -> None:
    window, screen = _open_window(pyglet, request)
    try:
        window.check_pixels()
        frame_period_s, synchronised = _frame_period(window, screen)
        pipe.answer(ready=as_fields(screen), frame_period_s=frame_period_s, vsync=synchronised)
        _serve(window, pipe, request["stall_s"])
    finally:
        window.close()


def main() -> None:
    """Do what the first argument asks for, in JSON."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe = _Pipe()
    try:
        _run(json.loads(sys.argv[1]), pipe)
    except ImpastoError as error:
        try:
            pipe.answer(error=str(error), kind=type(error).__name__)
        except BrokenPipeError:
            sys.exit(1)


if __name__ == "__main__":
    main()
