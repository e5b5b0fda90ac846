from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquisition.decoding import decode
from acquisition.errors import SessionError
from acquisition.patterns import Axis, Gray, PhaseShift, pattern_image
from acquisition.scan import plan_scan, scan
from acquisition.scan_plan import plan_structured_light
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceTimeoutError, FrameOrderError
from devices.interfaces import Projection
from devices.rig import Rig
from devices.simulated.rig import demo_rig


@pytest.fixture(scope="module")
def rig():
    return demo_rig(seed=3, camera_width=120)


def devices(rig):
    return Rig(rig.camera, rig.projector)


class Wrapped:
    """A device with one habit changed."""

    def __init__(self, device):
        self._device = device

    def __getattr__(self, name):
        return getattr(self._device, name)


class Lagging(Wrapped):
    """A camera whose driver hands out the frame before, properly counted."""

    def __init__(self, camera):
        super().__init__(camera)
        self._held = camera.capture(0.03)

    def capture(self, exposure_s, *, deadline=None):
        given, self._held = self._held, self._device.capture(exposure_s, deadline=deadline)
        return given


class Frozen(Wrapped):
    """A camera that counts on but shows its first picture for ever."""

    first = None

    def capture(self, exposure_s, *, deadline=None):
        frame = self._device.capture(exposure_s, deadline=deadline)
        self.first = frame.image if self.first is None else self.first
        return replace(frame, image=self.first)


class Failing(Wrapped):
    """A camera that is unplugged after some frames."""

    def __init__(self, camera, *, captures=5):
        super().__init__(camera)
        self._left = captures

    def capture(self, exposure_s, *, deadline=None):
        self._left -= 1
        if self._left < 0:
            raise KeyboardInterrupt
        return self._device.capture(exposure_s, deadline=deadline)


class OneLate(Wrapped):
    """A projector that shows the picture before the one it is given."""

    last = Projection("dark", np.zeros((570, 912), np.uint8))

    def show(self, projection, *, deadline=None):
        self.last, shown = projection, self.last
        return self._device.show(shown, deadline=deadline)


class Altered(Wrapped):
    """A device that says something else of itself."""

    def __init__(self, device, **changed):
        super().__init__(device)
        self.capabilities = replace(device.capabilities, **changed)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rig: (Lagging(rig.camera), rig.projector), "0000 white is stale"),
        (lambda rig: (Frozen(rig.camera), rig.projector), "is that of 0000 white over"),
        (
            lambda rig: (rig.camera, Altered(rig.projector, width=640, height=400)),
            "912×570 pixels, this one has 640×400",
        ),
        (
            lambda rig: (Altered(rig.camera, saturation_level=4095), rig.projector),
            "saturates at 1023, this one does at 40",
        ),
    ],
)
def test_a_scan_that_would_record_other_than_planned_is_refused(rig, tmp_path, change, message):
    plan = plan_scan(devices(rig), exposure_s=0.03)
    changed = Rig(*change(rig))
    with (
        pytest.raises(DeviceError, match=message),
        SessionWriter.create(tmp_path / "s", plan) as writer,
    ):
        scan(writer, changed)


def test_a_proof_leaves_the_frame_that_was_taken_first(rig):
    """So that the same frame is recorded by a scan and by one that is resumed with it."""
    taken = []

    class Watched(Wrapped):
        def capture(self, exposure_s, *, deadline=None):
            taken.append(self._device.capture(exposure_s, deadline=deadline))
            return taken[-1]

    watched = Rig(Watched(rig.camera), rig.projector)
    watched.show(Projection("white", np.full((570, 912), 255, np.uint8)))
    frame = watched.capture(0.03)
    assert len(taken) == 4
    assert frame.image is taken[0].image


@pytest.mark.parametrize("exposure_s", [0.03, 0.0003])
def test_white_must_be_brighter_than_black(rig, tmp_path, exposure_s):
    plan = plan_scan(devices(rig), exposure_s=exposure_s)
    trusting = Rig(rig.camera, OneLate(rig.projector), prove_light=False)
    with (
        pytest.raises(FrameOrderError, match=r"0000 \(white\) is darker than frame 0001 \(black\)"),
        SessionWriter.create(tmp_path / "s", plan) as writer,
    ):
        scan(writer, trusting)
    assert "0001" in writer.missing


def test_a_scan_with_hardly_any_light_is_recorded(rig, tmp_path):
    plan = plan_scan(devices(rig), exposure_s=1e-6, steps=3, axes=(Axis.ROW,))
    with SessionWriter.create(tmp_path / "s", plan) as writer:
        scan(writer, devices(rig))
    assert len(Session.open(tmp_path / "s").recorded) == len(plan.frames)


def test_an_interrupted_scan_leaves_the_projector_dark_and_can_go_on(rig, tmp_path):
    plan = plan_scan(devices(rig), exposure_s=0.03)
    with (
        pytest.raises(KeyboardInterrupt),
        SessionWriter.create(tmp_path / "s", plan) as writer,
    ):
        scan(writer, Rig(Failing(rig.camera), rig.projector))
    bright = rig.electrons(0.03).max()
    rig.projector.show(Projection("white", np.full((570, 912), 255, np.uint8)))
    assert bright < 0.01 * rig.electrons(0.03).max()
    with SessionWriter.resume(tmp_path / "s") as writer:
        # Three of the five went into the proof of the first light.
        assert writer.missing[0] == "0002"
        scan(writer, devices(rig))
    assert len(Session.open(tmp_path / "s").recorded) == len(plan.frames)


def test_cut_off_behind_the_proof_of_its_first_light_a_scan_ends_alike(tmp_path):
    def afresh():
        return demo_rig(seed=3, camera_width=60)

    plan = plan_scan(devices(afresh()), exposure_s=0.03, steps=3, axes=(Axis.ROW,))
    with SessionWriter.create(tmp_path / "whole", plan) as writer:
        scan(writer, devices(afresh()))
    rig = afresh()
    with (
        pytest.raises(KeyboardInterrupt),
        SessionWriter.create(tmp_path / "cut", plan) as writer,
    ):
        scan(writer, Rig(Failing(rig.camera, captures=4), rig.projector))
    with SessionWriter.resume(tmp_path / "cut") as writer:
        assert writer.missing[0] == "0001"
        scan(writer, devices(afresh()))
    assert Session.open(tmp_path / "cut").digest == Session.open(tmp_path / "whole").digest


def test_a_missed_deadline_is_a_device_error(rig):
    with pytest.raises(DeviceTimeoutError, match="in time"):
        rig.camera.capture(0.03, deadline=Deadline.after(-1))


def test_the_deadline_of_a_frame_holds_for_the_proof_of_its_light_too(rig):
    given = []

    class Camera(Wrapped):
        def capture(self, exposure_s, *, deadline=None):
            given.append(deadline)
            return self._device.capture(exposure_s)

    one = Rig(Camera(rig.camera), rig.projector)
    one.show(Projection("white", np.full((570, 912), 255, np.uint8)))
    deadline = Deadline.after(600)
    one.capture(0.03, deadline=deadline)
    assert len(given) > 2
    assert set(given) == {deadline}


def test_devices_refuse_to_work_once_closed():
    rig = demo_rig(seed=3, camera_width=40)
    rig.camera.close()
    rig.projector.close()
    rig.projector.blank()
    with pytest.raises(DeviceError, match="camera is closed"):
        rig.camera.capture(0.03)
    with pytest.raises(DeviceError, match="projector is closed"):
        rig.projector.show(Projection("black", np.zeros((570, 912), np.uint8)))


def _plan(**changed):
    return plan_structured_light(
        **{
            "camera_size": (80, 60),
            "projector_size": (912, 570),
            "saturation_level": 1023,
            "exposure_s": 0.03,
            **changed,
        }
    )


@pytest.mark.parametrize("periods", [(24.0,), (96.0, 19.0), (912.0, 151.0, 25.0), (7.5,)])
@pytest.mark.parametrize("axes", [(Axis.COLUMN,), (Axis.COLUMN, Axis.ROW)])
def test_every_panel_pixel_comes_back_from_the_patterns_of_a_plan(periods, axes):
    """A camera that is the panel itself: coordinates are known."""
    width, height = 912, 12
    plan = _plan(
        camera_size=(width, height), projector_size=(width, 570), periods_px=periods, axes=axes
    )
    frames = {
        f.id: pattern_image(f.pattern, width=width, height=570)[200 : 200 + height].astype("u2")
        for f in plan.frames
    }
    found = decode(plan, frames.__getitem__)
    truth = {
        Axis.COLUMN: np.broadcast_to(np.arange(width), (height, width)),
        Axis.ROW: np.broadcast_to(np.arange(200, 200 + height)[:, None], (height, width)),
    }
    assert set(found.axes) == set(axes)
    for axis, decoded in found.axes.items():
        error = np.abs(decoded.coordinate - truth[axis])[:, 1:-1]
        # Grey levels of the pattern are rounded: 0.29/127.5·√(2/8) rad, five times over.
        assert np.nanmax(error) < 5 * 0.0012 * min(periods) / (2 * np.pi)
        assert np.isfinite(error).mean() > 0.99


def test_gray_code_is_planned_only_where_no_fringe_covers_the_panel():
    mixed = _plan(periods_px=(24.0, 600.0))
    gray = {f.pattern.axis for f in mixed.frames if isinstance(f.pattern, Gray)}
    assert gray == {Axis.COLUMN}
    fringes = [f.pattern for f in mixed.frames if isinstance(f.pattern, PhaseShift)]
    assert len(fringes) == 2 * 2 * 8
    assert len({f.id for f in mixed.frames}) == len(mixed.frames)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"steps": 2}, "three or more"),
        ({"exposure_s": 0.0}, "positive"),
        ({"exposure_s": float("nan")}, "positive"),
        ({"axes": ()}, "each axis once"),
        ({"axes": (Axis.ROW, Axis.ROW)}, "each axis once"),
        ({"periods_px": ()}, "fringe period"),
        ({"periods_px": (24.0, 24.0)}, "only once"),
        ({"periods_px": (1.5,)}, "cannot be shown"),
        ({"periods_px": (float("inf"),)}, "cannot be shown"),
    ],
)
def test_what_cannot_be_shown_or_decoded_is_not_planned(changed, message):
    with pytest.raises(SessionError, match=message):
        _plan(**changed)
