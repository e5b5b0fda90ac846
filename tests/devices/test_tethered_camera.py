from __future__ import annotations

import signal
import time

import numpy as np
import pytest

from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError, FrameOrderError
from devices.gphoto2.settings import Gphoto2Settings, find

pytest.importorskip("gphoto2")
pytest.importorskip("rawpy")

import gphoto2_stand_in as stand_in
from digital_negative import digital_negative


@pytest.fixture
def body():
    return stand_in.Body()


@pytest.fixture
def open_body():
    opened = []

    def open_it(*bodies, **keys):
        camera = Gphoto2Settings(**keys).open(library=stand_in.Module(*bodies))
        opened.append(camera)
        return camera

    yield open_it
    for camera in opened:
        camera.close()


@pytest.mark.parametrize("maker", [stand_in.canon, stand_in.nikon])
def test_everything_automatic_is_switched_off_and_read_back(maker, open_body):
    body = stand_in.Body(settings=maker())
    camera = open_body(body)
    values = {name: setting.value for name, setting in body.settings.items()}
    assert values["capturetarget"] == "Internal RAM"
    assert camera.iso == values["iso"] == "100"
    if maker is stand_in.canon:
        assert (values["imageformat"], values["drivemode"]) == ("RAW", "Single")
        assert camera.aperture == "5.6"
    else:
        assert values["imagequality"] == "NEF (Raw)"
        assert (values["isoauto"], values["longexpnr"]) == ("Off", "Off")
        assert values["rawcompression"] == "Lossless"
        assert camera.aperture == "f/8"


def test_capabilities_are_those_of_a_picture(body, open_body):
    capabilities = open_body(body).capabilities
    assert capabilities.size == (stand_in.COLS, stand_in.ROWS)
    assert capabilities.saturation_level == 4095
    assert capabilities.bayer == "RGGB"
    # Bulb is no time.
    assert capabilities.exposure_range_s == pytest.approx((1 / 8000, 30.0))


def test_the_nearest_exposure_is_taken_and_told(body, open_body):
    camera = open_body(body, aperture=8.0, iso=200)
    assert (camera.aperture, camera.iso) == ("8", "200")
    assert camera.black_levels == (64, 64, 64, 64)
    for number, (asked, applied) in enumerate([(0.02, 1 / 60), (0.1, 0.1), (0.005, 1 / 250)], 1):
        began = time.monotonic()
        frame = camera.capture(asked)
        assert (frame.sequence, frame.exposure_asked_s) == (number, asked)
        assert frame.exposure_applied_s == pytest.approx(applied)
        # Sensor numbers as they are, with their black level; the second release is the first frame.
        assert frame.image.dtype == np.uint16
        assert frame.image[0, 0] == 64 + 1 + number
        assert frame.image[5, 5] == 64 + 1 + number + int(20_000 * applied)
        assert began <= frame.monotonic_s - frame.exposure_applied_s <= time.monotonic()


def test_files_are_deleted_from_the_camera_or_kept(body, open_body):
    open_body(body).capture(0.01)
    assert body.files == {}
    kept = stand_in.Body()
    open_body(kept, keep_files=True).capture(0.01)
    assert len(kept.files) == 2
    assert kept.settings["capturetarget"].value == "Memory card"


def test_files_of_others_are_neither_taken_nor_deleted(body, open_body):
    camera = open_body(body)
    name = body.add_file(stand_in.raw_picture(999, 1.0))
    assert camera.capture(0.01).image[0, 0] == 64 + 2
    assert list(body.files) == [(stand_in.FOLDER, name)]


def test_a_file_that_comes_too_soon_is_refused(body, open_body):
    camera = open_body(body)
    body.add_file(stand_in.raw_picture(999, 1.0), after_s=0.2)
    with pytest.raises(FrameOrderError, match="before its exposure can have ended"):
        camera.capture(1.0)


def test_the_late_file_of_an_exposure_that_was_given_up_is_not_the_next_one(body, open_body):
    camera = open_body(body)
    body.delay_s = 0.6
    with pytest.raises(DeviceTimeoutError, match="did not deliver its picture in time"):
        camera.capture(0.01, deadline=Deadline.after(0.2))
    body.delay_s = 0.02
    frame = camera.capture(0.01)
    # Release 1 was the trial, 2 was given up.
    assert (frame.image[0, 0], frame.sequence) == (64 + 3, 1)
    assert body.files == {}


def test_an_interrupt_gets_through_and_leaves_no_stale_frame(body, open_body):
    def interrupt(*_):
        raise KeyboardInterrupt

    camera = open_body(body)
    signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        camera.capture(1.0)
    assert time.monotonic() - began < 0.9
    assert camera.capture(0.01).image[0, 0] == 64 + 3


@pytest.mark.parametrize(
    ("name", "setting", "message"),
    [
        ("autoexposuremode", stand_in.Setting("AV", ("AV",), readonly=True), "mode dial to M"),
        ("mirrorlock", stand_in.Setting("On", ("On",)), "only lift the mirror"),
        ("drivemode", stand_in.Setting("Timer", ("Timer",)), "set the drive dial to single"),
        ("imageformat", stand_in.Setting("sRAW", ("sRAW", "L")), "no full raw file without JPEG"),
        ("batterylevel", stand_in.Setting("5%"), "battery is at 5%; charge it"),
        ("batterylevel", stand_in.Setting("Low"), "battery is at Low"),
        ("iso", stand_in.Setting("400", ("400", "800"), True), "iso cannot be 100|iso stays"),
        (
            "imagestabilization",
            stand_in.Setting("On", ("On", "Off"), takes=lambda _: "On"),
            "imagestabilization is 'On' and cannot be changed",
        ),
        ("shutterspeed", stand_in.Setting("bulb", ("bulb",)), "none of the camera's exposure"),
    ],
)
def test_what_cannot_be_fixed_is_refused_by_name(body, open_body, name, setting, message):
    body.settings[name] = setting
    keys = {"iso": 100} if name == "iso" else {}
    with pytest.raises(DeviceError, match=message):
        open_body(body, **keys)
    # It was let go.
    assert not body.is_open
    assert body.releases == 0


def test_a_camera_without_exposure_times_is_refused(body, open_body):
    del body.settings["shutterspeed"]
    with pytest.raises(DeviceError, match="cannot be set from here; turn its mode dial to M"):
        open_body(body)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"aperture": 2.0}, "aperture cannot be 2; it offers 4, 5.6, 8, 11"),
        ({"iso": 125}, "iso cannot be 125; it offers 50, 100, 200, 6400"),
    ],
)
def test_what_is_not_offered_is_refused_with_what_is(body, open_body, keys, message):
    with pytest.raises(DeviceError, match=message):
        open_body(body, **keys)


def test_an_exposure_time_that_is_not_taken_is_refused(body, open_body):
    camera = open_body(body)
    body.settings["shutterspeed"].takes = lambda value: "1/250"
    with pytest.raises(DeviceError, match=r"shutterspeed stays '1/250' where '0.3' was set"):
        camera.capture(0.3)


def test_a_full_card_is_named(body, open_body):
    camera = open_body(body)
    body.card_full = True
    with pytest.raises(DeviceError, match="card is full: empty it"):
        camera.capture(0.01)
    body.card_full = False
    # Nothing was released, so no late file is waited for.
    began = time.monotonic()
    assert camera.capture(0.01).sequence == 1
    assert time.monotonic() - began < 2


def test_what_the_library_logs_is_passed_on(body, open_body):
    camera = open_body(body)
    body.settings["mirrorlock"].value = 1
    with pytest.raises(DeviceError, match=r"did not release.*mirror is up.*without mirror lock-up"):
        camera.capture(0.01)


def test_a_busy_camera_is_waited_for(body, open_body):
    camera = open_body(body)
    body.busy_until = time.monotonic() + 0.3
    frame = camera.capture(0.01)
    assert frame.monotonic_s - frame.exposure_applied_s >= body.busy_until
    assert body.releases == 2


def test_a_camera_that_stays_busy_is_given_up_at_the_deadline(body, open_body):
    camera = open_body(body)
    body.busy_until = time.monotonic() + 60
    began = time.monotonic()
    with pytest.raises(DeviceTimeoutError, match=r"stayed busy|in time"):
        camera.capture(0.01, deadline=Deadline.after(0.3))
    assert time.monotonic() - began < 1
    assert body.releases == 1


def test_an_unplugged_camera_is_lost(body, open_body):
    camera = open_body(body)
    signal.signal(signal.SIGALRM, lambda *_: setattr(body, "unplugged", True))
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    with pytest.raises(DeviceLostError, match="cable"):
        camera.capture(10.0)
    with pytest.raises(DeviceLostError, match="plug it in"):
        camera.capture(0.01)


def test_a_library_that_hangs_is_given_up_at_the_deadline(body, open_body):
    camera = open_body(body)
    body.hangs_for = 1.5
    began = time.monotonic()
    with pytest.raises(DeviceTimeoutError):
        camera.capture(0.01, deadline=Deadline.after(0.2))
    assert time.monotonic() - began < 1
    body.hangs_for = 0.0
    assert camera.capture(0.01).sequence == 1


def test_a_file_that_arrives_cut_off_is_read_again(body, open_body):
    camera = open_body(body)
    body.cut_downloads = 2
    assert camera.capture(0.01).image[0, 0] == 64 + 2
    body.cut_downloads = 100
    with pytest.raises(DeviceError, match=r"arrived with \d+ bytes of \d+, 3 times"):
        camera.capture(0.01)
    assert len(body.files) == 1


def test_a_file_that_cannot_be_decoded_stays_on_the_camera(body, open_body):
    camera = open_body(body)
    body.picture = lambda release, exposed_s: stand_in.raw_picture(release, exposed_s)[:500]
    with pytest.raises(DeviceError, match=r"IMG_0002.CR2 \(500 bytes\) cannot be decoded"):
        camera.capture(0.01)
    assert len(body.files) == 1


def test_a_jpeg_beside_the_raw_file_is_passed_over(body, open_body):
    camera = open_body(body)
    release = body.release

    def release_both():
        body.add_file(stand_in.JPEG, suffix="JPG", after_s=0.02)
        release()

    body.release = release_both
    assert camera.capture(0.01).image[0, 0] == 64 + 2
    assert body.files == {}


def test_a_camera_that_delivers_only_jpeg_is_refused(body, open_body):
    camera = open_body(body)
    body.picture = lambda release, exposed_s: stand_in.JPEG
    with pytest.raises(DeviceError, match="only a JPEG"):
        camera.capture(0.01, deadline=Deadline.after(0.3))


@pytest.mark.parametrize(
    "other",
    [
        digital_negative(np.zeros((46, 64), np.uint16)),
        digital_negative(np.zeros((48, 64), np.uint16), white=16383),
        digital_negative(np.zeros((48, 64), np.uint16), pattern="GRBG"),
        digital_negative(np.zeros((48, 64), np.uint16), black=0),
    ],
    ids=["size", "white level", "mosaic", "black level"],
)
def test_pictures_that_change_their_kind_are_refused(body, open_body, other):
    camera = open_body(body)
    body.picture = lambda release, exposed_s: other
    with pytest.raises(DeviceError, match="other pictures than when it was opened"):
        camera.capture(0.01)


def test_cameras_are_found_with_what_is_wrong(body):
    claimed = stand_in.Body(model="Nikon DSC Z9", claimed=True)
    disk = stand_in.Body(model="Mass Storage Camera", can_release=False)
    found = find(library=stand_in.Module(body, claimed, disk))
    assert [(one.model, one.address) for one in found] == [
        ("Canon EOS Stand-in", "usb:001,001"),
        ("Nikon DSC Z9", "usb:001,002"),
        ("Mass Storage Camera", "usb:001,003"),
    ]
    assert found[0].problem is None
    assert "gio mount -s gphoto2" in found[1].problem
    assert "cannot be released from a computer" in found[2].problem
    assert not body.is_open


def test_one_of_several_cameras_is_chosen_by_port_or_model(body, open_body):
    other = stand_in.Body(model="Nikon DSC Z9", settings=stand_in.nikon())
    with pytest.raises(DeviceError, match=r"several cameras \(Canon .* at usb:001,001, Nikon"):
        open_body(body, other)
    for name in ("nikon dsc z9", "usb:001,002"):
        assert open_body(body, other, camera=name).capabilities.model == "Nikon DSC Z9"
    with pytest.raises(DeviceError, match="no camera called Leica is plugged in"):
        open_body(body, other, camera="Leica")


def test_a_claimed_camera_is_named(body, open_body):
    body.claimed = True
    with pytest.raises(DeviceError, match="claimed the camera"):
        open_body(body)


def test_a_closed_camera_says_so(body, open_body):
    camera = open_body(body)
    camera.close()
    camera.close()
    assert not body.is_open
    with pytest.raises(DeviceError, match="closed"):
        camera.capture(0.01)
    with pytest.raises(DeviceError, match="outside what"):
        open_body(body).capture(31.0)
