from __future__ import annotations

import itertools
import time
from collections import Counter

import numpy as np
import pytest

from acquisition.patterns import Axis, describe, pattern_image
from acquisition.scan import plan_scan, scan
from acquisition.session_writer import SessionWriter
from devices.errors import (
    DeviceError,
    DeviceLostError,
    DeviceTimeoutError,
    FrameOrderError,
)
from devices.interfaces import ArmPose, Projection
from devices.rig import Rig
from devices.simulated.fault_script import (
    CameraUnplugged,
    ClockJump,
    DroppedFrame,
    LampFailure,
    LateFrame,
    Latency,
    OneLate,
    PreviousPicture,
    ProjectorDark,
    ProjectorUnplugged,
    RepeatedFrame,
    StaleFrame,
    Stamp,
    SwappedFrames,
    TruncatedFrame,
)
from devices.simulated.faults import FaultyArm, FaultyCamera, FaultyProjector
from devices.simulated.oil_painting import paint_small_oil
from devices.simulated.optics import PanelResponse, SimulatedLens
from devices.simulated.rig import SimulatedRig, demo_rig
from devices.simulated.sensor import Sensor
from devices.simulated.truth import truth_of

EXPOSURE_S = 0.03
# Captures of the proof of the first light; what they show is not recorded.
PROOF = (1, 2, 3)


@pytest.fixture(scope="module")
def scene():
    return demo_rig(seed=3, camera_width=120)


@pytest.fixture(scope="module")
def narrow_scene():
    """A camera that sees a small part of the panel: several Gray bits are flat there."""
    camera = SimulatedLens.looking_at(
        width=96,
        height=72,
        focal_px=2600.0,
        position=(-25.0, 12.0, 450.0),
        target=(20.0, 10.0, 0.0),
        distortion=(0.0, 0.0, 0.0, 0.0, 0.0),
    )
    wide = demo_rig(seed=8, camera_width=40)
    return SimulatedRig.before(paint_small_oil(seed=8), camera, wide.projector_lens, seed=8)


def planned(rig, exposures=(EXPOSURE_S,), **options):
    """Frames to take: projections and exposures."""
    options = {"steps": 4, "period_px": 24.0, "exposure_s": 1.0, **options}
    plan = plan_scan(rig, **options)
    panel = rig.projector.capabilities
    for frame in plan.frames:
        image = pattern_image(frame.pattern, width=panel.width, height=panel.height)
        projection = Projection(f"{frame.id} {describe(frame.pattern)}", image)
        for exposure_s in exposures:
            yield projection, exposure_s


def record(scene, *, camera=None, projector=None, shots=None, rig=None, taken=None):
    """Take a whole scan, keeping the frames in memory."""
    rig = rig or Rig(camera or scene.camera, projector or scene.projector)
    rig.begin_recording()
    rig.blank()
    taken, showing = [] if taken is None else taken, None
    try:
        for projection, exposure_s in shots or planned(rig):
            if projection is not showing:
                rig.show(projection)
                showing = projection
            taken.append((projection, exposure_s, rig.capture(exposure_s)))
    finally:
        rig.blank()
    return taken


def foreign_frames(scene, taken):
    """Names of frames that are not the picture of their projection, by the scene's truth."""
    sensor, wrong = scene.scene.sensor, []
    for projection, exposure_s, frame in taken:
        scene.scene.show(projection.image)
        electrons = scene.electrons(exposure_s)
        gain = sensor.numbers_per_electron
        expected = np.clip(electrons * gain + sensor.black_level, 0, sensor.ceiling)
        caught = np.minimum(electrons, sensor.full_well_e)
        pattern = (sensor.prnu * caught) ** 2 + sensor.dsnu_e**2
        sigma = gain * np.sqrt(caught + sensor.read_noise_e**2 + pattern)
        error = (frame.image - expected) / np.hypot(sigma, 0.3)
        if np.mean(error**2) > 1.5:
            wrong.append(projection.name)
    return wrong


@pytest.fixture(scope="module")
def shots(scene):
    return list(planned(Rig(scene.camera, scene.projector)))


MIXED_UP = [
    (fault, stamp) for stamp in Stamp for fault in (StaleFrame, RepeatedFrame, SwappedFrames)
]


def test_all_of_a_hundred_stale_repeated_and_swapped_frames_are_caught(scene, shots):
    """At captures that are recorded; those of the proof of the first light come next."""
    positions, missed = Counter(), []
    for seed in range(100):
        kind, stamp = MIXED_UP[seed % len(MIXED_UP)]
        first = 1 if kind is RepeatedFrame else 0
        recorded = [at for at in range(first, len(shots) + len(PROOF) - 1) if at not in PROOF]
        fault = kind(int(np.random.default_rng(seed).choice(recorded)), stamp)
        positions[fault.at] += 1
        try:
            record(scene, camera=FaultyCamera(scene.camera, fault), shots=shots)
        except FrameOrderError:
            continue
        missed.append(fault)
    assert missed == []
    assert len(positions) > 15


@pytest.mark.parametrize("at", PROOF)
@pytest.mark.parametrize(("kind", "stamp"), MIXED_UP)
def test_a_fault_in_the_proof_is_caught_or_harmless(scene, shots, kind, stamp, at):
    camera = FaultyCamera(scene.camera, kind(at, stamp))
    try:
        taken = record(scene, camera=camera, shots=shots[:6])
    except FrameOrderError:
        return
    assert foreign_frames(scene, taken) == []


@pytest.mark.parametrize("at", [0, 1, 2, 3, 4, 11, 20])
@pytest.mark.parametrize("rows", [1, 40])
def test_truncated_frames_are_refused(scene, shots, at, rows):
    with pytest.raises(FrameOrderError, match=f"of 120×{90 - rows}, and simulated camera takes"):
        record(scene, camera=FaultyCamera(scene.camera, TruncatedFrame(at, rows)), shots=shots)


@pytest.mark.parametrize("at", [1, 3, 12])
def test_a_dropped_frame_is_missed_in_the_count(scene, shots, at):
    with pytest.raises(FrameOrderError, match="a frame was lost"):
        record(scene, camera=FaultyCamera(scene.camera, DroppedFrame(at)), shots=shots)


class Waiting:
    """A simulated camera whose exposures take the time that they say."""

    def __init__(self, scene):
        self._camera = SimulatedRig.before(
            scene.painting, scene.camera_lens, scene.projector_lens
        ).camera

    def __getattr__(self, name):
        return getattr(self._camera, name)

    def capture(self, exposure_s, *, deadline=None):
        frame = self._camera.capture(exposure_s, deadline=deadline)
        time.sleep(max(0.0, frame.monotonic_s - time.monotonic()))
        return frame


@pytest.mark.parametrize("fault", [StaleFrame(4), StaleFrame(4, Stamp.RENUMBERED), LateFrame(4)])
def test_time_alone_tells_a_stale_frame(scene, shots, fault):
    """No picture is held against another: the light is not proven."""
    rig = Rig(FaultyCamera(Waiting(scene), fault), scene.projector, prove_light=False)
    shots = [(projection, 0.004) for projection, _ in shots]
    if isinstance(fault, LateFrame):
        with pytest.raises(DeviceTimeoutError, match="in time"):
            record(scene, rig=rig, shots=shots)
        rig.show(shots[4][0])
        with pytest.raises(FrameOrderError, match="is stale"):
            rig.capture(0.004)
    else:
        with pytest.raises(FrameOrderError, match="is stale"):
            record(scene, rig=rig, shots=shots)


def test_what_is_unplugged_is_said_to_be_gone(scene, shots):
    for rig in (
        Rig(FaultyCamera(scene.camera, CameraUnplugged(7)), scene.projector),
        Rig(scene.camera, FaultyProjector(scene.projector, ProjectorUnplugged(4))),
    ):
        with pytest.raises(DeviceLostError, match="unplugged"):
            record(scene, rig=rig, shots=shots)


@pytest.mark.parametrize("wall_s", [-86_400.0, 3600.0])
def test_the_wall_clock_may_jump(scene, shots, wall_s):
    taken = record(
        scene, camera=FaultyCamera(scene.camera, ClockJump(6, wall_s=wall_s)), shots=shots
    )
    times = [frame.wall_time for _, _, frame in taken]
    assert max(abs(b - a) for a, b in itertools.pairwise(times)) > 3000
    assert foreign_frames(scene, taken) == []


@pytest.mark.parametrize(("device_s", "message"), [(-0.5, "is stale"), (30.0, "clock")])
def test_a_jump_of_the_camera_s_clock_is_refused(scene, shots, device_s, message):
    camera = FaultyCamera(scene.camera, ClockJump(6, device_s=device_s))
    with pytest.raises(FrameOrderError, match=message):
        record(scene, camera=camera, shots=shots)


@pytest.mark.parametrize("stamp", Stamp)
def test_brackets_are_guarded_too(scene, stamp):
    shots = list(planned(Rig(scene.camera, scene.projector), (0.005, 0.02, 0.08)))
    for at in (0, 4, 5, 6, 7, 8, 18, 31):
        camera = FaultyCamera(scene.camera, StaleFrame(at, stamp))
        try:
            taken = record(scene, camera=camera, shots=shots)
        except FrameOrderError:
            continue
        # Two exposures of one pattern apart: the camera's word is all there is.
        assert stamp is Stamp.RESTAMPED
        assert at not in (0, 6, 18)
        assert len(foreign_frames(scene, taken)) <= 1


PROJECTOR_FAULTS = [
    *(PreviousPicture(at) for at in (0, 4, 5, 10, 16)),
    *(OneLate(at) for at in (0, 1, 4, 8)),
    *(ProjectorDark(at) for at in (0, 4, 13, 17)),
    Latency(0.3, declared=False),
]


@pytest.mark.parametrize("fault", PROJECTOR_FAULTS, ids=str)
@pytest.mark.parametrize("skipped", [0, 5], ids=["whole", "resumed"])
def test_a_projector_that_does_not_follow_is_caught(scene, shots, fault, skipped):
    projector = FaultyProjector(scene.projector, fault)
    with pytest.raises(FrameOrderError, match=r"showed the light before it|stays as it is"):
        record(scene, projector=projector, shots=shots[skipped:])


@pytest.mark.parametrize("kind", [PreviousPicture, OneLate, ProjectorDark])
@pytest.mark.parametrize("skipped", [0, 5], ids=["whole", "resumed"])
def test_a_projector_that_fails_in_the_middle_leaves_no_foreign_frame(scene, shots, kind, skipped):
    """Of those recorded until it was caught; a resumed scan would keep them."""
    calls_of_proof = 3
    last = len(shots) - skipped + calls_of_proof - 1
    for at in (*range(1 + calls_of_proof, last, 4), last):
        projector = FaultyProjector(scene.projector, kind(at))
        taken = []
        with pytest.raises(FrameOrderError):
            record(scene, projector=projector, shots=shots[skipped:], taken=taken)
        assert foreign_frames(scene, taken) == []


@pytest.mark.parametrize(
    "fault", [f(at) for f in (PreviousPicture, OneLate) for at in (2, 3)], ids=str
)
def test_a_projector_fault_in_the_proof_is_caught_or_harmless(scene, shots, fault):
    projector = FaultyProjector(scene.projector, fault)
    try:
        taken = record(scene, projector=projector, shots=shots[:6])
    except FrameOrderError:
        return
    assert foreign_frames(scene, taken) == []


def test_a_declared_latency_is_waited_for(scene, shots):
    projector = FaultyProjector(scene.projector, Latency(0.02))
    assert foreign_frames(scene, record(scene, projector=projector, shots=shots[:6])) == []


def test_a_scan_stops_at_a_fault_and_says_so_in_its_journal(scene, tmp_path):
    rig = Rig(FaultyCamera(scene.camera, StaleFrame(9)), scene.projector)
    plan = plan_scan(rig, exposure_s=EXPOSURE_S, steps=3)
    with (
        pytest.raises(FrameOrderError, match="frame of 0006"),
        SessionWriter.create(tmp_path / "s", plan) as writer,
    ):
        scan(writer, rig)
    assert (
        '"reason":"failed","why":"frame of 0006' in (tmp_path / "s" / "journal.jsonl").read_text()
    )
    assert scene.electrons(EXPOSURE_S).max() < 200
    with SessionWriter.resume(tmp_path / "s") as writer:
        scan(writer, Rig(scene.camera, scene.projector))


CLEAN = {
    "plain": {},
    "fine fringes": {"period_px": 9.0},
    "several frequencies": {"coarser_periods_px": (110.0, 1200.0), "period_px": 14.0},
    "one axis": {"axes": (Axis.ROW,)},
}


@pytest.mark.parametrize("options", CLEAN.values(), ids=CLEAN.keys())
@pytest.mark.parametrize("exposures", [(0.0005,), (0.03,), (1.0,), (0.0002, 0.02, 2.0)], ids=str)
def test_clean_scans_raise_no_alarm(scene, narrow_scene, options, exposures):
    """Dim and saturated, brackets, and a camera that sees a part of the panel."""
    for rig_scene in (scene, narrow_scene):
        rig = Rig(rig_scene.camera, rig_scene.projector)
        taken = record(rig_scene, rig=rig, shots=list(planned(rig, exposures, **options)))
        assert foreign_frames(rig_scene, taken) == []


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("bits", [8, 12])
def test_clean_scans_of_other_paintings_and_sensors_raise_no_alarm(scene, seed, bits):
    sensor = Sensor(
        bits=bits, read_noise_e=(3.0, 40.0)[seed % 2], black_level=(0.0, 20.0)[seed // 2]
    )
    other = SimulatedRig.before(
        paint_small_oil(seed=seed, pitch_mm=0.5),
        scene.camera_lens,
        scene.projector_lens,
        sensor=sensor,
        seed=seed,
        panel=PanelResponse(gamma=1.0 + 0.4 * seed),
    )
    rig = Rig(other.camera, other.projector)
    taken = record(other, rig=rig, shots=list(planned(rig, (0.004, 0.06))))
    assert foreign_frames(other, taken) == []


def test_gray_bits_that_look_alike_are_proven_and_not_refused(narrow_scene):
    rig = Rig(narrow_scene.camera, narrow_scene.projector)
    shots = list(planned(rig))
    panel = truth_of(narrow_scene.scene).panel
    low, high = panel.reshape(-1, 2).min(axis=0), panel.reshape(-1, 2).max(axis=0)
    assert ((high - low) < 250).all()
    before = narrow_scene.camera.capture(EXPOSURE_S).sequence
    taken = record(narrow_scene, rig=rig, shots=shots)
    frames = narrow_scene.camera.capture(EXPOSURE_S).sequence - before - 1
    # One proof for the first light, and some more for bits that are flat in this picture.
    assert len(taken) + 2 < frames < len(taken) + 2 * 8
    # And where the projector sticks there, that is harmless or caught.
    for at, (projection, _) in enumerate(shots):
        if "Gray" not in projection.name:
            continue
        stuck = FaultyProjector(narrow_scene.projector, PreviousPicture(at + 2))
        try:
            taken = record(narrow_scene, projector=stuck, shots=shots[at - 1 : at + 3])
        except FrameOrderError:
            continue
        assert foreign_frames(narrow_scene, taken) == []


class StoredOnly:
    """A projector that shows only the pictures it holds."""

    def __init__(self, projector, digests):
        self._projector, self._digests = projector, digests

    def __getattr__(self, name):
        return getattr(self._projector, name)

    def show(self, projection, *, deadline=None):
        if projection.digest not in self._digests:
            raise DeviceError(f"{projection.name} is not in flash")
        return self._projector.show(projection, deadline=deadline)


def test_a_projector_that_shows_only_what_it_holds_is_proven_with_that(narrow_scene):
    shots = list(planned(Rig(narrow_scene.camera, narrow_scene.projector)))
    held = {projection.digest for projection, _ in shots}
    projector = StoredOnly(narrow_scene.projector, held)
    taken = record(narrow_scene, projector=projector, shots=shots)
    assert foreign_frames(narrow_scene, taken) == []
    with pytest.raises(FrameOrderError):
        record(
            narrow_scene,
            projector=FaultyProjector(projector, ProjectorDark(0)),
            shots=shots,
        )


# The arm's lamp.

POSES = [ArmPose(np.radians(az), np.radians(el)) for az in (20, 60, 200, 203) for el in (30, 70)]


def photograph(scene, arm, exposures=(0.01,), *, poses=POSES):
    """Dark and lit frames at every pose."""
    rig = Rig(scene.camera, scene.projector, arm)
    rig.begin_recording()
    if arm.pose is None:
        rig.arm.home()
    taken = []
    for pose in poses:
        rig.move_light(pose)
        for lit in (False, True):
            rig.switch_lamp(lit)
            taken += [rig.capture(exposure_s) for exposure_s in exposures]
    rig.switch_lamp(False)
    return taken


@pytest.mark.parametrize("exposures", [(0.01,), (0.0001,), (0.0003, 0.01, 0.3)], ids=str)
def test_photographs_under_the_lamp_raise_no_alarm(scene, exposures):
    taken = photograph(scene, scene.arm, exposures)
    assert len(taken) == 2 * len(POSES) * len(exposures)
    for frame in taken:
        other_lit = not frame.subject.lamp_on
        assert frame.subject.arm_pose in POSES
        twins = [
            f
            for f in taken
            if f.subject.arm_pose == frame.subject.arm_pose
            and f.subject.lamp_on == other_lit
            and f.exposure_asked_s == frame.exposure_asked_s
        ]
        brighter = frame.image.mean() > twins[0].image.mean()
        assert frame.exposure_asked_s < 0.001 or brighter == frame.subject.lamp_on


@pytest.mark.parametrize("exposures", [(0.01,), (0.0003, 0.01)], ids=str)
@pytest.mark.parametrize("at", [0, 1, 4])
def test_a_lamp_that_fails_is_caught(scene, exposures, at):
    with pytest.raises(FrameOrderError, match=r"lamp on at .* stays as it is when the light"):
        photograph(scene, FaultyArm(scene.arm, LampFailure(at)), exposures, poses=POSES[:6])
    assert not scene.arm.lamp_on


def test_photographs_without_dark_frames_between_raise_no_alarm_either(scene):
    """Neighbouring poses light a painting nearly alike."""
    rig = Rig(scene.camera, scene.projector, scene.arm)
    rig.begin_recording()
    for degrees in np.arange(40, 42, 0.25):
        rig.move_light(ArmPose(1.0, np.radians(degrees)))
        rig.switch_lamp(True)
        assert rig.capture(0.01).image.mean() > 20
    rig.switch_lamp(False)


def test_a_lamp_that_stays_on_is_caught(scene):
    class Sticking(FaultyArm):
        """Its lamp says that it is out."""

        @property
        def lamp_on(self):
            return self.said

        def switch_lamp(self, on):
            self.said = on
            return self._arm.switch_lamp(True)

        said = False

    rig = Rig(scene.camera, scene.projector, Sticking(scene.arm))
    rig.begin_recording()
    rig.switch_lamp(True)
    with pytest.raises(FrameOrderError):
        rig.capture(0.01)
    scene.arm.switch_lamp(False)
