"""Pictures one after another as a video, in what OpenCV's build can encode."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from render.errors import RenderError

# MPEG-4 first; Motion JPEG is in every build, and larger.
_CODECS = ((".mp4", "mp4v"), (".avi", "MJPG"))


class VideoFile:
    """A video being written.

    Attributes
    ----------
    path : Path
        Its suffix is that of the codec there is.
    frames : int
        Pictures that it has.
    """

    def __init__(self, path: Path, writer: cv2.VideoWriter, size: tuple[int, int]) -> None:
        self.path = path
        self.frames = 0
        self._writer = writer
        self._size = size

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Append a picture, (rows, cols, 3) uint8 sRGB; an odd row or column is left out."""
        width, height = self._size
        if picture.shape[0] < height or picture.shape[1] < width:
            raise RenderError(f"{self.path}: pictures of one size make a video")
        self._writer.write(np.ascontiguousarray(picture[:height, :width, ::-1]))
        self.frames += 1


@contextmanager
def video_file(
    folder: Path, stem: str, *, width: int, height: int, fps: float
) -> Iterator[VideoFile]:
    """Write a video into a folder while the block runs.

    Parameters
    ----------
    folder : Path
    stem : str
        File name without the suffix, which is the codec's.
    width, height : int
        Of the pictures; codecs take even numbers only.
    fps : float
        Pictures per second.

    Raises
    ------
    RenderError
        Pictures smaller than 2×2, an OpenCV that encodes neither MPEG-4 nor Motion JPEG, or a file
        that does not hold every picture in the end; it is removed.
    """
    size = (width // 2 * 2, height // 2 * 2)
    if min(size) < 2:
        raise RenderError(f"a video has pictures of at least 2×2, not {width}×{height}")
    for suffix, codec in _CODECS:
        path = folder / f"{stem}{suffix}"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, size)
        if writer.isOpened():
            break
        path.unlink(missing_ok=True)
    else:
        raise RenderError("this OpenCV can write no video; leave out --video and join the frames")
    film = VideoFile(path, writer, size)
    try:
        yield film
    finally:
        writer.release()
    # OpenCV does not say that a disk was full.
    found = _frames_of(path)
    if found != film.frames:
        path.unlink()
        raise RenderError(
            f"{path.name}: the video holds {found} of {film.frames} pictures; is the disk full?"
        )


def _frames_of(path: Path) -> int:
    reader = cv2.VideoCapture(str(path))
    try:
        return int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        reader.release()
