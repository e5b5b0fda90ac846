"""Every call by which a recording changes the disk, counted, and made to fail or to be the last."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# What atomic files, journals and folders are made with; pathlib, tempfile and shutil call these.
CALLS = ("open", "write", "fsync", "ftruncate", "replace", "rename", "mkdir", "unlink", "chmod")
# Those that a full or broken disk refuses.
WRITES = ("open", "write", "fsync", "replace", "rename", "mkdir", "ftruncate")


@contextmanager
def watched(before: Callable[[int, str, tuple], None], names: tuple[str, ...]) -> Iterator[None]:
    """Call ``before`` with number, name and arguments of every system call in the block."""
    real = {name: getattr(os, name) for name in names}
    count = 0

    def wrapped(name: str) -> Callable:
        def call(*arguments, **keywords):
            nonlocal count
            number, count = count, count + 1
            before(number, name, arguments)
            return real[name](*arguments, **keywords)

        return call

    for name in names:
        setattr(os, name, wrapped(name))
    try:
        yield
    finally:
        for name in names:
            setattr(os, name, real[name])


def killed_at(fatal: int, step: Callable[[], None], *, torn: bool = False) -> bool:
    """Run ``step`` in a child that dies at its ``fatal``-th system call; whether it came so far.

    With ``torn``, a write that is the fatal call has got half of its bytes to the disk.
    """
    child = os.fork()
    if child == 0:
        real_write = os.write

        def die(number: int, name: str, arguments: tuple) -> None:
            if number == fatal:
                if torn and name == "write":
                    descriptor, content = arguments
                    real_write(descriptor, bytes(content)[: len(content) // 2])
                os._exit(9)

        try:
            with watched(die, CALLS):
                step()
        finally:
            os._exit(0)  # whatever happens, this copy of the tests goes no further
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


@contextmanager
def failing_at(fatal: int, number_of_error: int, *, for_ever: bool) -> Iterator[Callable[[], bool]]:
    """Have the ``fatal``-th write of the block fail, alone or with all after it.

    Yields a function that says whether one has failed.
    """
    failed = False

    def fail(number: int, name: str, arguments: tuple) -> None:
        nonlocal failed
        if number == fatal or (for_ever and number > fatal):
            failed = True
            raise OSError(number_of_error, os.strerror(number_of_error))

    with watched(fail, WRITES):
        yield lambda: failed
