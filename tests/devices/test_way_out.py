from __future__ import annotations

import itertools

import numpy as np
import pytest

from devices.errors import DeviceError, FrameOrderError
from devices.interfaces import CameraCapabilities, Projection
from devices.rig import Rig
from devices.way_out import afterwards, do_all


class Device:
    """Fills every place of a rig, writes down what it is told, and fails as it is told to."""

    capabilities = CameraCapabilities("any", 4, 4, 255, (1e-3, 1.0))
    pose = None
    lamp_on = False

    def __init__(self, name, told, failure=None):
        self._name, self._told, self._failure = name, told, failure

    def _do(self, order):
        self._told.append(f"{order} {self._name}")
        if self._failure is not None:
            raise self._failure

    def stop(self):
        self._do("stop")

    def blank(self):
        self._do("blank")

    def close(self):
        self._do("close")


# Made anew for every test: notes stay on an error.
FAILURES = [
    None,
    lambda: DeviceError("does not answer"),
    lambda: OSError("gone"),
    KeyboardInterrupt,
]
REASONS = [None, lambda: FrameOrderError("stale"), KeyboardInterrupt]


@pytest.mark.parametrize("makers", list(itertools.product(FAILURES, FAILURES, FAILURES)))
@pytest.mark.parametrize("maker", REASONS)
def test_every_device_is_told_and_the_reason_comes_first(makers, maker):
    arm, projector, camera = (make and make() for make in makers)
    reason = maker and maker()
    told = []
    rig = Rig(
        Device("camera", told, camera),
        Device("projector", told, projector),
        Device("arm", told, arm),
    )
    raised = None
    try:
        with rig:
            if reason is not None:
                raise reason
    except BaseException as error:
        raised = error
    every = ["stop arm", "blank projector", "close arm", "close projector", "close camera"]
    assert list(dict.fromkeys(told)) == every
    failures = [failure for failure in (reason, arm, projector, camera) if failure is not None]
    interruptions = [f for f in failures if isinstance(f, KeyboardInterrupt)]
    if not failures:
        assert raised is None
    elif interruptions:
        assert isinstance(raised, KeyboardInterrupt)
    else:
        assert raised is failures[0]


def test_what_fails_on_the_way_out_is_noted():
    told = []
    rig = Rig(Device("camera", told), arm=Device("arm", told, DeviceError("lamp does not answer")))
    with pytest.raises(FrameOrderError, match="stale") as caught, rig:
        raise FrameOrderError("stale")
    assert any("lamp does not answer" in note for note in caught.value.__notes__)


def test_an_interrupted_action_is_done_again_and_no_other_is_left_out():
    done = []

    def interrupted_once():
        done.append("begun")
        if len(done) == 1:
            raise KeyboardInterrupt
        done.append("ended")

    with pytest.raises(KeyboardInterrupt):
        do_all(interrupted_once, lambda: done.append("next"))
    assert done == ["begun", "begun", "ended", "next"]


def test_a_block_without_an_error_raises_that_of_its_way_out():
    def fail():
        raise DeviceError("no answer")

    with pytest.raises(DeviceError, match="no answer"), afterwards(fail):
        pass


def test_a_rig_that_could_not_be_made_safe_does_not_claim_to_show_what_it_showed():
    class Projector(Device):
        def show(self, projection, *, deadline=None):
            return 0.0

    told = []
    rig = Rig(
        projector=Projector("projector", told), arm=Device("arm", told, DeviceError("no answer"))
    )
    rig.show(Projection("white", np.full((4, 4), 255, np.uint8)))
    with pytest.raises(DeviceError, match="no answer"):
        rig.make_safe()
    assert rig.subject.projection is None
