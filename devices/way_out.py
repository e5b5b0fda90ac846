"""What is done on the way out: all of it, whatever fails or interrupts, and the first error told.

Lights that stay on matter more than the order of tracebacks, and the reason why work ended more
than what the clearing up after it met: that is noted on the error, and printed below it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


def do_all(*actions: Callable[[], None]) -> None:
    """Do every action, whatever those before it raise.

    Parameters
    ----------
    actions : callable
        Done in this order. What an interruption may have cut short is done once more, so each must
        be harmless when it is repeated.

    Raises
    ------
    BaseException
        The first interruption, else the first error; later errors are notes on it.
    """
    raised: list[BaseException] = []
    undone = list(actions)
    while undone:
        try:
            while undone:
                undone[0]()
                del undone[0]
        except Exception as error:
            raised.append(error)
            del undone[0]
        except BaseException as interruption:
            if any(map(_interrupts, raised)):
                del undone[:1]
            raised.append(interruption)
    if raised:
        told = next(filter(_interrupts, raised), raised[0])
        for other in raised:
            if other is not told:
                _note(told, other)
        raise told


@contextmanager
def afterwards(*actions: Callable[[], None]) -> Iterator[None]:
    """Do actions on every way out of a block; see :func:`do_all`.

    Raises
    ------
    BaseException
        That of the block, with errors of the actions as notes; theirs if the block raised none, and
        an interruption of them always.
    """
    try:
        yield
    except BaseException as error:
        try:
            do_all(*actions)
        except Exception as failed:
            _note(error, failed)
        raise
    do_all(*actions)


def _interrupts(error: BaseException) -> bool:
    return not isinstance(error, Exception)


def _note(told: BaseException, other: BaseException) -> None:
    if not _interrupts(other):
        told.add_note("; ".join((f"on the way out: {other}", *getattr(other, "__notes__", ()))))
