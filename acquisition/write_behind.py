"""Writing a frame while the next one is exposed: one at a time, in order, and none forgotten."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType


class WriteBehind:
    """Does one piece of writing at a time in a thread of its own; a context manager.

    At most one is under way: the next waits for it. An error is raised by whatever is called next,
    or on leaving, unless something else went wrong there; either way all writing has ended then.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="writing")
        self._under_way: Future[None] | None = None

    def submit(self, write: Callable[[], None]) -> None:
        """Begin to write, once what was begun before is done.

        Raises
        ------
        Exception
            Of what was begun before; ``write`` is not called then.
        """
        self.settle()
        self._under_way = self._thread.submit(write)

    def settle(self) -> None:
        """Wait until everything is written.

        Raises
        ------
        Exception
            Of the writing.
        """
        under_way, self._under_way = self._under_way, None
        if under_way is not None:
            under_way.result()

    def __enter__(self) -> WriteBehind:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self.settle()
            else:
                with contextlib.suppress(Exception):
                    self.settle()
        finally:
            self._thread.shutdown(wait=True)
