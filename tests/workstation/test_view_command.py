from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from impasto_command import IMPASTO
from synthetic_copy import make_copy, strokes
from virtual_display import VirtualDisplay, virtual_display

from fitting.copy_files import write_copy

WIDTH, HEIGHT = 360, 270
# Rows between the bands of the caption.
PICTURE, TOP = np.s_[40:210], np.s_[:28]
KEYS = {"Left": 0xFF51, "Up": 0xFF52, "plus": 0x2B, "minus": 0x2D}


class Screen:
    """Keys and mouse of an X display in memory, and what it shows."""

    def __init__(self, shown: VirtualDisplay) -> None:
        xlib = pytest.importorskip("pyglet.libs.x11.xlib")
        self.name, self._shown, self._xlib = shown.name, shown, xlib
        self._display = xlib.XOpenDisplay(shown.name.encode())

    def picture(self) -> np.ndarray:
        """The top left of what a person would see, (HEIGHT, WIDTH, 3)."""
        return self._shown.picture()[:HEIGHT, :WIDTH].copy()

    def settled(self, unlike: np.ndarray | None = None, *, rows: slice = PICTURE) -> np.ndarray:
        """What is shown when it does not change any more, and is not what it was."""
        until = time.monotonic() + 60
        before = self.picture()
        while time.monotonic() < until:
            time.sleep(0.6)
            now = self.picture()
            changed = now.any() if unlike is None else (now[rows] != unlike[rows]).any()
            if changed and np.array_equal(now, before):
                return now
            before = now
        raise AssertionError("the window does not change")

    def press(self, key: str) -> None:
        code = self._xlib.XKeysymToKeycode(self._display, KEYS.get(key, ord(key[0].lower())))
        for kind in (2, 3):  # KeyPress, KeyRelease
            event = self._xlib.XEvent(type=kind)
            event.xkey.keycode = code
            event.xkey.state = 0
            self._send(event, view=False)

    def drag(self, x: int, y: int) -> None:
        for kind, state, place in ((4, 0, (0, 0)), (6, 256, (x, y)), (5, 256, (x, y))):
            event = self._xlib.XEvent(type=kind)
            event.xbutton.x, event.xbutton.y = WIDTH // 2 + place[0], HEIGHT // 2 + place[1]
            event.xbutton.state = state
            if kind != 6:
                event.xbutton.button = 1
            self._send(event, view=True)

    def _send(self, event: ctypes.Structure, *, view: bool) -> None:
        root = self._xlib.XDefaultRootWindow(self._display)
        window = self._children(root)[-1]
        if view:
            window = self._children(window)[-1]
        event.xany.display, event.xany.window = self._display, window
        self._xlib.XSendEvent(self._display, window, 0, 0, ctypes.byref(event))
        self._xlib.XSync(self._display, 0)

    def _children(self, window: int) -> list[int]:
        xlib = self._xlib
        root, parent = xlib.Window(), xlib.Window()
        children, count = ctypes.POINTER(xlib.Window)(), ctypes.c_uint()
        xlib.XQueryTree(
            *(self._display, window, ctypes.byref(root), ctypes.byref(parent)),
            *(ctypes.byref(children), ctypes.byref(count)),
        )
        return [int(children[i]) for i in range(count.value)]


@pytest.fixture(scope="module")
def screen(tmp_path_factory) -> Iterator[Screen]:
    with virtual_display(tmp_path_factory.mktemp("screen"), 400, 300) as display:
        yield Screen(display)


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("copy") / "copy"
    write_copy(make_copy(strokes(60, 80, 1.0), pitch=1.0), folder)
    return folder


def environment(display: str | None) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    for name in ("PYOPENGL_PLATFORM", "PYGLET_HEADLESS"):
        kept.pop(name, None)
    return kept | ({"DISPLAY": display} if display else {})


@contextmanager
def window(screen: Screen, copy: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    size = ("--size", f"{WIDTH}x{HEIGHT}")
    running = subprocess.Popen(
        [str(IMPASTO), "view", str(copy), *size, *options],
        env=environment(screen.name),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield running
    finally:
        running.kill()
        running.communicate()


def test_keys_and_mouse_change_the_picture_and_q_closes_it(screen, copy, tmp_path):
    figures = tmp_path / "shown.json"
    with window(screen, copy, "--view=-90,25,110", "--json", str(figures)) as running:
        shown = screen.settled()
        assert shown[PICTURE].std() > 10
        steps = [("2", PICTURE), ("7", PICTURE), ("Left", PICTURE), ("Up", PICTURE)]
        steps += [("s", PICTURE), ("minus", TOP), ("v", PICTURE), ("c", TOP)]
        for key, rows in steps:
            screen.press(key)
            shown = screen.settled(shown, rows=rows)
        # Without the caption there is no shade at the top.
        assert shown[TOP].min() > 30
        screen.drag(40, 25)
        screen.settled(shown)
        screen.press("q")
        output, messages = running.communicate(timeout=30)
        assert (running.returncode, output, messages) == (0, "", "")
    shown_last = json.loads(figures.read_text())
    assert shown_last["mode"] == "bounded"
    assert shown_last["budget_px"] == pytest.approx(0.25 / np.sqrt(2))
    assert shown_last["light"][:2] == pytest.approx([140, 37])
    assert shown_last["shadows"] is True


def test_ctrl_c_closes_the_window(screen, copy):
    with window(screen, copy) as running:
        screen.settled()
        running.send_signal(signal.SIGINT)
        _, messages = running.communicate(timeout=30)
        assert running.returncode == 130
        assert "interrupted" in messages
        assert "Traceback" not in messages


@pytest.mark.parametrize("display", [None, ":7999"])
def test_without_a_display_the_error_says_what_to_use(copy, display):
    done = subprocess.run(
        [str(IMPASTO), "view", str(copy)],
        env=environment(display),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 3
    assert "needs a display" in done.stderr
    assert "use impasto render" in done.stderr
    assert "Traceback" not in done.stderr
