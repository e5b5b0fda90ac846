from __future__ import annotations

import signal
import threading
import time

import pytest

from devices.blocking_calls import BlockingCalls
from devices.deadline import Deadline
from devices.errors import DeviceTimeoutError

LATE = "the camera did not answer"


@pytest.fixture
def calls():
    made = BlockingCalls("the camera")
    yield made
    made.end(lambda: None, within_s=1)


def test_results_and_errors_come_back(calls):
    assert calls.call(lambda: 7, deadline=Deadline.after(1), late=LATE) == 7
    with pytest.raises(ZeroDivisionError):
        calls.call(lambda: 1 / 0, deadline=Deadline.after(1), late=LATE)
    threads = {
        calls.call(threading.get_ident, deadline=Deadline.after(1), late=LATE) for _ in range(5)
    }
    assert len(threads) == 1
    assert threading.get_ident() not in threads


def test_a_call_is_given_up_at_its_deadline_and_the_next_one_waits_for_it(calls):
    release, made = threading.Event(), []
    began = time.monotonic()
    with pytest.raises(DeviceTimeoutError, match="the camera did not answer in time"):
        calls.call(release.wait, deadline=Deadline.after(0.12), late=LATE)
    assert 0.12 <= time.monotonic() - began < 1
    assert calls.busy
    with pytest.raises(DeviceTimeoutError, match="still busy with a call that was given up"):
        calls.call(lambda: made.append(1), deadline=Deadline.after(0.1), late=LATE)
    release.set()
    assert calls.call(lambda: 3, deadline=Deadline.after(1), late=LATE) == 3
    # What could not begin in time was not made later.
    assert made == []


def test_interrupts_get_through(calls):
    def interrupt(*_):
        raise KeyboardInterrupt

    release = threading.Event()
    signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.1)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        calls.call(release.wait, deadline=Deadline.after(5), late=LATE)
    assert time.monotonic() - began < 1
    release.set()


def test_the_last_call_comes_after_all_others():
    calls, order, release = BlockingCalls("the camera"), [], threading.Event()
    with pytest.raises(DeviceTimeoutError):
        calls.call(
            lambda: (release.wait(), order.append("first")),
            deadline=Deadline.after(0.05),
            late=LATE,
        )
    calls.end(lambda: order.append("last"), within_s=0.05)
    assert order == []
    release.set()
    until = Deadline.after(2)
    while len(order) < 2 and not until.passed:
        time.sleep(0.01)
    assert order == ["first", "last"]
