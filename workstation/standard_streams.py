"""What a command says never spoils what it makes.

Whoever reads its output may leave (``| head``, a terminal that is gone), or know fewer letters than
δ and µ. What a command makes are files, so it goes on to its end without its reader, and says what
it can in the letters that there are.
"""

from __future__ import annotations

import errno
import io
import sys
from typing import Any

# Nobody reads any more: a pipe whose other end is closed, a terminal that is gone.
_NOBODY_READS = (errno.EPIPE, errno.EIO)


def outlive_readers() -> None:
    """Replace standard output and standard error, where they are those that Python opened."""
    if sys.stdout is sys.__stdout__:
        sys.stdout = _outliving(sys.stdout)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _outliving(sys.stderr)


class _Outlet(io.FileIO):
    """A file that takes everything once nobody reads it any more."""

    def write(self, content: Any) -> int:
        try:
            return super().write(content)
        except OSError as error:
            if error.errno not in _NOBODY_READS:
                raise
            return memoryview(content).nbytes


def _outliving(stream: Any) -> Any:
    if stream is None:  # closed by a shell
        return None
    stream.flush()
    outlet = _Outlet(stream.fileno(), "w", closefd=False)
    unbuffered = isinstance(stream.buffer, io.RawIOBase)
    return io.TextIOWrapper(
        outlet if unbuffered else io.BufferedWriter(outlet),
        encoding=stream.encoding,
        errors="backslashreplace" if stream is sys.__stderr__ else "replace",
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
