"""Directions of distant lights: the ``.lp`` files of museum domes, and spheres without an arm.

An ``.lp`` file (as the tools for polynomial texture maps and RTI read it) holds the number of
pictures on its first line, then a picture's name and a direction on each line: x to the right, y
up, z towards the viewer.

A dome's lamps are taken as infinitely far, and its camera too where its lens is not known: the
sphere is then a circle, its normal at a pixel follows from the pixel's place in it, and the light's
direction is the line of sight reflected there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.atomic_files import write_bytes
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.mirror_spheres import MirrorSphere

_MOST_LIGHTS = 100_000
_LONGEST_LINE = 4096
# Lengths of directions that stand for unit vectors written with few digits.
_UNIT = (0.5, 2.0)


@dataclass(frozen=True)
class LightDirections:
    """One distant light for each picture.

    Attributes
    ----------
    pictures : tuple of str
        Names, each once.
    directions : (n, 3) float64 array
        Unit vectors towards the lights: x right, y up, z towards the viewer.
    """

    pictures: tuple[str, ...]
    directions: NDArray[np.float64]

    def __post_init__(self) -> None:
        directions = np.asarray(self.directions, np.float64)
        if not self.pictures or directions.shape != (len(self.pictures), 3):
            raise CalibrationError(
                f"{len(self.pictures)} pictures and directions of shape {directions.shape}: each "
                "picture has one direction"
            )
        doubled = _first_doubled(self.pictures)
        if doubled is not None:
            raise CalibrationError(f"picture {doubled!r} has two directions")
        length = np.linalg.norm(directions, axis=1)
        for number in range(len(length)):
            if not _UNIT[0] <= length[number] <= _UNIT[1]:
                raise CalibrationError(
                    f"picture {self.pictures[number]!r}: {directions[number]} is no unit vector"
                )
        object.__setattr__(self, "directions", directions / length[:, np.newaxis])


def _first_doubled(names: Sequence[str]) -> str | None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            return name
        seen.add(name)
    return None


def read_lp(path: Path, *, pictures: Path | None = None) -> LightDirections:
    """Read an ``.lp`` file.

    Parameters
    ----------
    path : Path
    pictures : Path, optional
        Folder in which each picture must be there; names in the file may have folders of their
        own, which are tried first and then left out.

    Returns
    -------
    LightDirections
        Pictures as named in the file, or as found in the folder.

    Raises
    ------
    CalibrationError
        Missing, malformed, directions that are not finite or zero, or a picture that is not there;
        the message names the line.
    """
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise CalibrationError(f"{path}: no such file of light directions") from None
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: not a readable text file ({error})") from None
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line]
    if not lines:
        raise CalibrationError(f"{path}: empty; its first line is the number of pictures")
    count = _read_count(path, *lines[0])
    if count != len(lines) - 1:
        raise CalibrationError(
            f"{path}: its first line says {count} pictures, and {len(lines) - 1} follow: the file "
            "was cut off, or edited; mend the number or the lines"
        )
    names, directions = [], []
    for number, line in lines[1:]:
        name, direction = _read_line(path, number, line)
        names.append(name if pictures is None else _find_picture(path, number, name, pictures))
        directions.append(direction)
    try:
        return LightDirections(tuple(names), np.array(directions))
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None


def _read_count(path: Path, number: int, line: str) -> int:
    if not (line.isascii() and line.isdigit() and 0 < int(line[:12]) <= _MOST_LIGHTS):
        raise CalibrationError(
            f"{path}, line {number}: {line[:40]!r} is no number of pictures from 1 to "
            f"{_MOST_LIGHTS}"
        )
    return int(line[:12])


def _read_line(path: Path, number: int, line: str) -> tuple[str, list[float]]:
    # Names may contain blanks; the last three words are the direction.
    words = line.rsplit(maxsplit=3)
    where = f"{path}, line {number}"
    if len(line) > _LONGEST_LINE or len(words) != 4:
        raise CalibrationError(f"{where}: a picture's name and three numbers are expected")
    try:
        direction = [float(word) for word in words[1:]]
    except ValueError:
        raise CalibrationError(f"{where}: {' '.join(words[1:])[:60]!r} are no numbers") from None
    length = float(np.linalg.norm(direction))
    if not np.isfinite(length):
        raise CalibrationError(f"{where}: the direction is not finite")
    if not _UNIT[0] <= length <= _UNIT[1]:
        raise CalibrationError(
            f"{where}: a direction of length {length:.3g}; unit vectors towards the light are "
            "expected" + (", and zero is no direction" if length == 0 else "")
        )
    return words[0], direction


def _find_picture(path: Path, number: int, name: str, folder: Path) -> str:
    """Path of a picture inside a folder; files often name folders of another machine."""
    parts = name.replace("\\", "/").split("/")
    inside = [part for part in parts if part not in ("", ".", "..")]
    for candidate in ("/".join(inside), inside[-1] if inside else ""):
        if candidate and (Path(folder) / candidate).is_file():
            return candidate
    raise CalibrationError(
        f"{path}, line {number}: picture {name!r} is not in {folder}; copy it there, or take its "
        "line out and mend the number on the first"
    )


def write_lp(path: Path, lights: LightDirections) -> None:
    """Write an ``.lp`` file.

    Raises
    ------
    CalibrationError
        A name with a line break, or none.
    """
    for name in lights.pictures:
        if not name.strip() or name != name.strip() or len(name.splitlines()) != 1:
            raise CalibrationError(f"{name!r} cannot be written as a picture's name")
    lines = [str(len(lights.pictures))]
    for name, (x, y, z) in zip(lights.pictures, lights.directions, strict=True):
        lines.append(f"{name} {x:.9f} {y:.9f} {z:.9f}")
    write_bytes(Path(path), ("\n".join(lines) + "\n").encode())


def directions_from_circles(
    circles: NDArray[np.float64], highlights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions of distant lights from spheres seen by a distant camera.

    Parameters
    ----------
    circles : (spheres, 3) array
        Column and row of each sphere's middle, and its radius, pixels.
    highlights : (spheres, pictures, 2) array
        Columns and rows; NaN where a sphere shows none.

    Returns
    -------
    directions : (pictures, 3) float64 array
        x right, y up, z towards the viewer.
    disagreement : (pictures,) float64 array
        RMS angle between the spheres and their mean, rad; NaN of a single one.

    Raises
    ------
    CalibrationError
        A picture without a highlight, or one outside of its sphere.
    """
    circles, highlights = np.asarray(circles, np.float64), np.asarray(highlights, np.float64)
    if circles.ndim != 2 or circles.shape[1] != 3 or not (circles[:, 2] > 0).all():
        raise CalibrationError("a sphere's circle is column, row and a positive radius")
    if highlights.ndim != 3 or highlights.shape[::2] != (len(circles), 2):
        raise CalibrationError("highlights are a pixel for each sphere and picture")
    offset = (highlights - circles[:, np.newaxis, :2]) / circles[:, np.newaxis, 2:]
    squared = np.sum(offset**2, axis=-1)
    if (squared >= 1).any():
        sphere, picture = np.argwhere(squared >= 1)[0]
        raise CalibrationError(
            f"picture {picture + 1}: the highlight is outside of sphere {sphere + 1}"
        )
    height = np.sqrt(1 - squared)
    normal = np.stack([offset[..., 0], -offset[..., 1], height], axis=-1)
    reflected = 2 * height[..., np.newaxis] * normal - np.array([0, 0, 1.0])
    return _mean_directions(reflected)


def directions_from_spheres(
    spheres: Sequence[MirrorSphere], highlights: NDArray[np.float64], lens: Lens
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions of distant lights from spheres seen through a known lens.

    Parameters
    ----------
    spheres : sequence of MirrorSphere
    highlights : (spheres, pictures, 2) array
        Columns and rows; NaN where a sphere shows none.
    lens : Lens

    Returns
    -------
    directions, disagreement
        As of :func:`directions_from_circles`: about the camera's axes, with y up and z towards the
        viewer.
    """
    highlights = np.asarray(highlights, np.float64)
    if highlights.ndim != 3 or highlights.shape[::2] != (len(spheres), 2):
        raise CalibrationError("highlights are a pixel for each sphere and picture")
    seen = [
        sphere.reflect(lens.unproject(pixels))[1]
        for sphere, pixels in zip(spheres, highlights, strict=True)
    ]
    return _mean_directions(np.stack(seen) * [1.0, -1.0, -1.0])


def _mean_directions(
    seen: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    known = np.isfinite(seen).all(axis=-1)
    count = known.sum(axis=0)
    if not (count > 0).all():
        raise CalibrationError(
            f"picture {int(np.argmin(count > 0)) + 1}: no sphere shows a highlight"
        )
    total = np.where(known[..., np.newaxis], seen, 0).sum(axis=0)
    mean = total / np.linalg.norm(total, axis=1, keepdims=True)
    off = np.where(known, np.sum((seen - mean) ** 2, axis=-1), 0).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.where(count > 1, np.sqrt(off / (count - 1)), np.nan)
    return mean, spread
