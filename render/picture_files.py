"""Rendered pictures as files: PNG for people, OpenEXR for measurements, and contact sheets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.atomic_files import file_in_progress, folder_in_progress, write_bytes
from fitting.exr_files import write_exr
from render.errors import RenderError
from render.painter import RenderedImage
from render.painting_node import Mode

_THUMBNAIL_WIDTH = 400


def write_picture(picture: RenderedImage, path: Path, *, exposure: float = 1.0) -> None:
    """Write a picture: sRGB as PNG, or linear radiance, coverage and depth as OpenEXR.

    Raises
    ------
    RenderError
        Another suffix than .png and .exr, or no folder to write into.
    OSError
        The disk is full, for one.
    """
    path = Path(path)
    check_picture_path(path)
    if path.suffix.lower() == ".png":
        write_bytes(path, _png(picture.encoded(exposure=exposure)))
    else:
        channels = {name: picture.radiance[..., i] for i, name in enumerate("RGB")}
        channels |= {"A": picture.coverage, "Z": picture.depth_mm}
        with file_in_progress(path) as temporary:
            write_exr(temporary, channels)


def check_picture_path(path: Path) -> None:
    """Refuse a file that :func:`write_picture` would refuse, before the picture is drawn.

    Raises
    ------
    RenderError
        Another suffix than .png and .exr, or no folder to write into.
    """
    if path.suffix.lower() not in (".png", ".exr"):
        raise RenderError(f"{path}: pictures are written as .png or .exr")
    if not path.parent.is_dir():
        raise RenderError(f"{path}: there is no folder {path.parent}; make it first")


def write_picture_table(
    paint: Callable[[Mode, str], RenderedImage],
    modes: list[Mode],
    views: list[str],
    out: Path,
    *,
    exposure: float = 1.0,
) -> None:
    """Write a folder with a PNG for every mode and view, and ``contact.png`` of them all.

    Each picture is written as soon as it is painted; the folder appears when it is complete.

    Parameters
    ----------
    paint : callable
        Gives the picture of a mode and a view; all of one size.
    modes, views : list
        Rows and columns of the contact sheet.
    out : Path
        The folder to make.
    exposure : float

    Raises
    ------
    FileExistsError
        ``out`` exists.
    """
    with folder_in_progress(Path(out)) as folder:
        rows = []
        for mode in modes:
            row = []
            for view in views:
                picture = paint(mode, view)
                write_picture(picture, folder / f"{mode}_{view}.png", exposure=exposure)
                row.append(_thumbnail(picture.encoded(exposure=exposure)))
            rows.append(row)
        write_contact_sheet(rows, [str(mode) for mode in modes], views, folder / "contact.png")


def _thumbnail(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    rows, cols = image.shape[:2]
    if cols <= _THUMBNAIL_WIDTH:
        return image
    size = (_THUMBNAIL_WIDTH, max(1, round(rows * _THUMBNAIL_WIDTH / cols)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def write_contact_sheet(
    pictures: list[list[NDArray[np.uint8]]], rows: list[str], columns: list[str], path: Path
) -> None:
    """Write a labelled table of pictures, each (height, width, 3) uint8 sRGB of one size."""
    band, margin = 28, 90
    height, width = pictures[0][0].shape[:2]
    sheet = np.full(
        (band + len(rows) * (height + 4), margin + len(columns) * (width + 4), 3), 245, np.uint8
    )
    for r, line in enumerate(pictures):
        for c, picture in enumerate(line):
            top, left = band + r * (height + 4), margin + c * (width + 4)
            sheet[top : top + height, left : left + width] = picture
    ink, font = (30, 30, 30), cv2.FONT_HERSHEY_SIMPLEX
    for r, label in enumerate(rows):
        at = (6, band + r * (height + 4) + height // 2)
        cv2.putText(sheet, label, at, font, 0.5, ink, 1, cv2.LINE_AA)
    for c, label in enumerate(columns):
        cv2.putText(
            sheet, label, (margin + c * (width + 4) + 6, 19), font, 0.5, ink, 1, cv2.LINE_AA
        )
    write_bytes(Path(path), _png(sheet))


def _png(image: NDArray[np.uint8]) -> bytes:
    # Not to a file: OpenCV does not say that a disk was full when the file was closed.
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    if not done:
        raise RenderError(f"a picture of {image.shape[1]}×{image.shape[0]} makes no PNG")
    return encoded.tobytes()
