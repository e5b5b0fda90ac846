"""Pictures in a scratch file that is mapped into memory, so that many of them take little of it."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

Singles = NDArray[np.float32]


class ScratchPictures:
    """Pictures of one shape, written one after the other and then mapped all at once.

    One mapping for all: each would keep a file open, of which a process may have about a thousand.

    Parameters
    ----------
    file : binary file
        Empty, open for writing and reading; it may be closed, and even removed, once the pictures
        are mapped.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._shape: tuple[int, ...] = ()
        self._count = 0

    def append(self, picture: NDArray[np.floating]) -> int:
        """Write one more picture, of the shape of those before, and return its number."""
        assert self._count == 0 or picture.shape == self._shape  # the callers see to that
        self._file.write(np.ascontiguousarray(picture, np.float32).data)
        self._shape = picture.shape
        self._count += 1
        return self._count - 1

    def mapped(self) -> Singles:
        """All pictures, (n, ...), read-only; pages are read where they are looked at.

        More can be appended, and mapped again.
        """
        self._file.flush()
        return np.memmap(self._file, np.float32, "r", shape=(self._count, *self._shape))
