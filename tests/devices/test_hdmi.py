from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import psutil
import pytest
from virtual_display import VirtualDisplay, virtual_display

from devices.deadline import Deadline
from devices.dlpc350.settings import Dlpc350Settings
from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError, MissingPackageError
from devices.hdmi.projector import HdmiProjector
from devices.hdmi.screens import Screen
from devices.hdmi.settings import HdmiSettings, find
from devices.interfaces import Projection
from devices.simulated.dlpc350_backend import SimulatedUsbBackend

WIDTH, HEIGHT = 1024, 768


class Display(VirtualDisplay):
    """A screen in memory, held against pictures."""

    def shows(self, image: np.ndarray) -> bool:
        return bool((self.picture() == image[..., None]).all())

    def is_black(self) -> bool:
        """Whether nothing is lit; without a window, nothing but the mouse pointer's few pixels."""
        return np.count_nonzero(self.picture()) < 500


@pytest.fixture(scope="module")
def display(tmp_path_factory) -> Iterator[Display]:
    with virtual_display(tmp_path_factory.mktemp("screen"), WIDTH, HEIGHT) as screen:
        yield Display(screen.name, screen.file)


def settings(display: Display | None, **changes) -> HdmiSettings:
    table = {
        "screen": "screen",
        "width": WIDTH,
        "height": HEIGHT,
        "latency_s": 0.0,
        "require_vsync": False,
        "timeout_s": 30.0,
        "display": display.name if display else None,
    }
    return HdmiSettings.model_validate(table | changes)


@pytest.fixture
def projector(display) -> Iterator[HdmiProjector]:
    projector = HdmiProjector(settings(display))
    yield projector
    projector.close()


def random_picture(seed: int) -> Projection:
    random = np.random.default_rng(seed)
    return Projection(f"noise {seed}", random.integers(0, 256, (HEIGHT, WIDTH), np.uint8))


def until(condition: Callable[[], bool], within_s: float = 15.0) -> bool:
    end = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def ended(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


# What is on the screen.


def test_a_picture_is_on_the_screen_pixel_by_pixel_when_show_returns(projector, display):
    assert display.is_black()
    for seed in range(3):
        shown = random_picture(seed)
        since = projector.show(shown)
        assert display.shows(shown.image)
        assert since <= time.monotonic()


def test_every_level_arrives_as_it_is(projector, display):
    ramp = np.broadcast_to(np.arange(WIDTH) // 4, (HEIGHT, WIDTH)).astype(np.uint8)
    projector.show(Projection("ramp", ramp))
    assert display.shows(ramp)
    checkerboard = (np.indices((HEIGHT, WIDTH)).sum(axis=0) % 2 * 255).astype(np.uint8)
    projector.show(Projection("checkerboard", checkerboard))
    assert display.shows(checkerboard)


def test_a_view_into_a_larger_array_is_shown_as_it_looks(projector, display):
    wide = random_picture(5).image
    flipped = wide[::-1, ::-1]
    projector.show(Projection("flipped", flipped))
    assert display.shows(flipped)


def test_blank_is_black_and_a_closed_projector_leaves_black(display):
    projector = HdmiProjector(settings(display))
    projector.show(random_picture(0))
    projector.blank()
    assert display.is_black()
    projector.show(random_picture(0))
    projector.close()
    assert display.is_black()
    projector.close()
    projector.blank()
    with pytest.raises(DeviceError, match="closed"):
        projector.show(random_picture(0))


def test_latency_and_a_missing_refresh_are_waited_for(display):
    projector = HdmiProjector(settings(display, latency_s=0.2))
    before = time.monotonic()
    since = projector.show(random_picture(0))
    # The simulated screen tells no refresh, so a frame of 60 Hz is allowed for.
    assert since >= before + 0.2 + 1 / 60
    assert time.monotonic() >= since
    assert not projector.vsync
    assert projector.capabilities.frame_period_s == pytest.approx(1 / 60)
    with pytest.raises(DeviceTimeoutError):
        projector.show(random_picture(0), deadline=Deadline.after(0.15))
    assert display.is_black()
    projector.close()


def test_what_covers_the_window_for_a_while_is_painted_over(projector, display):
    shown = random_picture(7)
    projector.show(shown)
    x11 = ctypes.CDLL("libX11.so.6")
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XDefaultRootWindow.restype = x11.XCreateSimpleWindow.restype = ctypes.c_ulong
    connection = ctypes.c_void_p(x11.XOpenDisplay(display.name.encode()))
    root = ctypes.c_ulong(x11.XDefaultRootWindow(connection))
    white = ctypes.c_ulong(0xFFFFFF)
    window = ctypes.c_ulong(
        x11.XCreateSimpleWindow(connection, root, 100, 100, 300, 200, 0, white, white)
    )
    x11.XMapRaised(connection, window)
    x11.XSync(connection, 0)
    assert until(lambda: bool((display.picture()[150:250, 150:350] == 255).all()))
    x11.XDestroyWindow(connection, window)
    x11.XSync(connection, 0)
    assert until(lambda: display.shows(shown.image))
    x11.XCloseDisplay(connection)


def test_an_answer_left_by_an_interrupt_is_not_taken_for_the_next_one(projector, display):
    projector.show(random_picture(0))
    projector._link.send("blank 0")
    shown = random_picture(1)
    projector.show(shown)
    assert display.shows(shown.image)


def test_a_dlpc350_shows_its_pictures_on_the_screen_at_its_video_input(display):
    backend = SimulatedUsbBackend()
    backend.board.video_signal = (WIDTH, HEIGHT)
    board_settings = Dlpc350Settings(source="video", screen=settings(display))
    with closing(board_settings.open(backend=backend)) as projector:
        assert not backend.board.lit
        shown = random_picture(0)
        projector.show(shown)
        assert display.shows(shown.image)
        assert backend.board.lit
        projector.blank()
        assert display.is_black()
    assert not backend.board.lit
    assert backend.kernel_driver


# Refused.


def test_the_mouse_stays_where_the_operator_has_it(display):
    x11 = ctypes.CDLL("libX11.so.6")
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XDefaultRootWindow.restype = ctypes.c_ulong
    connection = ctypes.c_void_p(x11.XOpenDisplay(display.name.encode()))
    root = ctypes.c_ulong(x11.XDefaultRootWindow(connection))

    def pointer() -> tuple[int, int]:
        numbers = [ctypes.c_ulong() for _ in range(2)] + [ctypes.c_int() for _ in range(5)]
        x11.XQueryPointer(connection, root, *(ctypes.byref(number) for number in numbers))
        return numbers[2].value, numbers[3].value

    x11.XWarpPointer(connection, 0, root, 0, 0, 0, 0, 300, 200)
    x11.XSync(connection, 0)
    with closing(HdmiProjector(settings(display))) as projector:
        projector.show(random_picture(0))
        assert pointer() == (300, 200)
        assert x11.XGrabPointer(connection, root, 0, 0, 1, 1, 0, 0, 0) == 0
        x11.XUngrabPointer(connection, 0)
    x11.XCloseDisplay(connection)


def test_another_size_than_the_panels_is_refused(projector, display):
    projector.show(random_picture(0))
    with pytest.raises(DeviceError, match="1024×768"):
        projector.show(Projection("small", np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)))
    assert display.is_black()


def test_a_screen_that_would_scale_is_refused_with_what_to_set(display):
    with pytest.raises(DeviceError, match="--output screen --mode 912x1140 --scale 1x1"):
        HdmiProjector(settings(display, width=912, height=1140))


def test_an_unknown_screen_is_refused_with_those_there_are(display):
    with pytest.raises(DeviceError, match=r"no screen 'HDMI-1'; there are: screen \(1024×768"):
        HdmiProjector(settings(display, screen="HDMI-1"))


def test_flips_that_wait_for_nothing_are_refused_where_vsync_is_required(display):
    with pytest.raises(DeviceError, match="require_vsync = false"):
        HdmiProjector(settings(display, require_vsync=True))
    assert display.is_black()


def test_a_screen_that_is_projected_on_already_is_refused_until_it_is_let_go(projector, display):
    picture = random_picture(3)
    projector.show(picture)
    with pytest.raises(DeviceError, match="another program projects on screen"):
        HdmiProjector(settings(display))
    assert np.array_equal(display.picture()[..., 1], picture.image)
    projector.close()
    HdmiProjector(settings(display)).close()


def test_without_a_display_the_message_says_what_to_set(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(DeviceError, match="no DISPLAY is set"):
        HdmiProjector(settings(None))
    with pytest.raises(DeviceError, match="':4711' does not answer"):
        HdmiProjector(settings(Display(":4711", Path())))
    (found,) = find()
    assert "no DISPLAY" in (found.problem or "")


def test_a_missing_pyglet_is_named(monkeypatch, tmp_path, display):
    (tmp_path / "pyglet.py").write_text("raise ImportError('not here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(MissingPackageError, match="pip install 'pyglet"):
        HdmiProjector(settings(display))


def test_rendering_without_a_window_in_this_process_does_not_matter(monkeypatch, display):
    monkeypatch.setenv("PYGLET_HEADLESS", "true")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    HdmiProjector(settings(display)).close()


def test_find_lists_screens_with_their_resolution(display):
    (found,) = find(display=display.name)
    assert (found.driver, found.address, found.problem) == ("hdmi", "screen", None)
    assert found.model.startswith("1024×768")


def make_screen(**changes) -> Screen:
    fields = {
        "name": "HDMI-1", "x": 0, "y": 0, "width": 1920, "height": 1080, "mode_width": 1920,
        "mode_height": 1080, "refresh_hz": 60.0, "dpi_scale": 1.0, "primary": False,
    }  # fmt: skip
    return Screen(**(fields | changes))


@pytest.mark.parametrize(
    ("changes", "remedy"),
    [
        ({"mode_width": 1280, "mode_height": 720}, "--mode 1920x1080"),
        ({"width": 3840, "height": 2160}, "--scale 1x1"),
        ({"width": 1080, "height": 1920}, "--rotate normal"),
        ({"dpi_scale": 1.5}, "scale to 100 %"),
    ],
)
def test_every_way_of_scaling_is_refused_with_its_remedy(changes, remedy):
    make_screen().check_native(1920, 1080)
    with pytest.raises(DeviceError, match=remedy):
        make_screen(**changes).check_native(1920, 1080)


# Lives and deaths.


def switch_off(display: Display) -> None:
    """Switch the display's output off, as a desktop does when the cable is pulled."""
    x11, xrandr = ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXrandr.so.2")
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XDefaultRootWindow.restype = ctypes.c_ulong

    class Resources(ctypes.Structure):
        _fields_ = (
            ("timestamp", ctypes.c_ulong),
            ("config", ctypes.c_ulong),
            ("ncrtc", ctypes.c_int),
            ("crtcs", ctypes.POINTER(ctypes.c_ulong)),
        )

    xrandr.XRRGetScreenResourcesCurrent.restype = ctypes.POINTER(Resources)
    connection = ctypes.c_void_p(x11.XOpenDisplay(display.name.encode()))
    root = ctypes.c_ulong(x11.XDefaultRootWindow(connection))
    resources = xrandr.XRRGetScreenResourcesCurrent(connection, root)
    controller = ctypes.c_ulong(resources.contents.crtcs[0])
    none = ctypes.c_ulong(0)
    status = xrandr.XRRSetCrtcConfig(
        connection, resources, controller, none, 0, 0, none, ctypes.c_ushort(1), None, 0
    )
    assert status == 0
    x11.XCloseDisplay(connection)


def test_a_screen_that_goes_off_is_noticed_by_the_next_picture(tmp_path):
    with (
        virtual_display(tmp_path, WIDTH, HEIGHT) as screen,
        closing(HdmiProjector(settings(display := Display(screen.name, screen.file)))) as projector,
    ):
        projector.show(random_picture(0))
        switch_off(display)
        with pytest.raises(DeviceError, match="screen screen was switched off, unplugged"):
            projector.show(random_picture(1))
        assert display.is_black()
        assert find(display=display.name) == []


PARENT = """
import sys, time
import numpy as np
from devices.hdmi.projector import HdmiProjector
from devices.hdmi.settings import HdmiSettings
from devices.interfaces import Projection
projector = HdmiProjector(HdmiSettings(
    screen="screen", width=1024, height=768, latency_s=0.0, require_vsync=False,
    display=sys.argv[1], stall_s=float(sys.argv[2])))
projector.show(Projection("white", np.full((768, 1024), 255, np.uint8)))
print(projector._link.pid, flush=True)
time.sleep(120)
"""


@pytest.fixture
def parent(display) -> Iterator[Callable[[float], tuple[subprocess.Popen, int]]]:
    parents = []

    def start(stall_s: float) -> tuple[subprocess.Popen, int]:
        process = subprocess.Popen(
            [sys.executable, "-c", PARENT, display.name, str(stall_s)],
            stdout=subprocess.PIPE,
            text=True,
        )
        parents.append(process)
        child = int(process.stdout.readline())
        assert display.picture().all()
        return process, child

    yield start
    for process in parents:
        process.kill()
        process.wait()
        process.stdout.close()


def test_a_killed_parent_takes_window_and_process_with_it(parent, display):
    process, child = parent(60.0)
    process.send_signal(signal.SIGKILL)
    assert until(lambda: ended(child))
    assert display.is_black()


def test_a_stalled_parent_loses_the_window(parent, display):
    process, child = parent(1.0)
    process.send_signal(signal.SIGSTOP)
    assert until(lambda: ended(child))
    assert display.is_black()
    process.send_signal(signal.SIGCONT)


def test_an_interrupted_parent_closes_the_window(parent, display):
    process, child = parent(60.0)
    process.send_signal(signal.SIGINT)
    assert until(lambda: ended(child))
    assert display.is_black()


def test_a_quiet_but_living_parent_keeps_the_window(display):
    projector = HdmiProjector(settings(display, stall_s=1.0))
    shown = random_picture(0)
    projector.show(shown)
    time.sleep(2.5)
    assert display.shows(shown.image)
    projector.close()


def test_an_interrupt_from_the_keyboard_does_not_reach_the_window(projector, display):
    child = projector._link.pid
    assert os.getsid(child) != os.getsid(0)
    os.kill(child, signal.SIGINT)
    shown = random_picture(0)
    projector.show(shown)
    assert display.shows(shown.image)


def test_a_window_whose_process_dies_is_a_loss_by_name(projector, display):
    projector.show(random_picture(0))
    os.kill(projector._link.pid, signal.SIGKILL)
    with pytest.raises(DeviceLostError, match="window is gone"):
        projector.show(random_picture(1))
    projector.blank()
    assert until(display.is_black)


def test_a_window_that_hangs_is_ended(projector, display):
    child = projector._link.pid
    projector.show(random_picture(0))
    os.kill(child, signal.SIGSTOP)
    with pytest.raises(DeviceTimeoutError, match="did not answer in time"):
        projector.show(random_picture(1), deadline=Deadline.after(0.3))
    assert until(lambda: ended(child))
    assert until(display.is_black)


def test_nothing_is_left_when_opening_fails(display):
    before = {child.pid for child in psutil.Process().children()}
    with pytest.raises(DeviceError):
        HdmiProjector(settings(display, width=100, height=100))
    assert {child.pid for child in psutil.Process().children()} == before
