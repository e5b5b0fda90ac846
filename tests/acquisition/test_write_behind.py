from __future__ import annotations

import threading
import time

import pytest

from acquisition.write_behind import WriteBehind


def test_writing_happens_beside_and_in_order():
    done = []
    go_on = threading.Event()

    def first():
        assert go_on.wait(10)
        done.append(1)

    with WriteBehind() as disk:
        disk.submit(first)
        assert done == []
        go_on.set()
        for number in (2, 3, 4):
            disk.submit(lambda number=number: done.append(number))
            assert done[: number - 1] == list(range(1, number))
        disk.settle()
        assert done == [1, 2, 3, 4]


def failing():
    raise OSError("disk fell off")


def test_an_error_stops_what_comes_after_it():
    with pytest.raises(OSError, match="fell off"), WriteBehind() as disk:
        disk.submit(failing)
        disk.submit(lambda: pytest.fail("written after a failure"))


def test_an_error_of_the_last_piece_is_raised_on_leaving():
    with pytest.raises(OSError, match="fell off"), WriteBehind() as disk:
        disk.submit(failing)


def test_what_went_wrong_first_is_what_is_told_and_writing_has_ended_by_then():
    done = []
    with pytest.raises(KeyboardInterrupt), WriteBehind() as disk:
        disk.submit(lambda: (time.sleep(0.05), done.append(1)))
        raise KeyboardInterrupt
    assert done == [1]
    with pytest.raises(ValueError, match="camera"), WriteBehind() as disk:
        disk.submit(failing)
        raise ValueError("camera")
