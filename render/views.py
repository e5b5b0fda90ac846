"""Where camera and light stand: the paper's six views (its table 1), and any other.

Directions are given by azimuth and elevation against the canvas: azimuth from the canvas's right
(X) towards its top (Y), elevation 90° straight in front. A visitor stands below: azimuth -90°.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from render.errors import RenderError


class NamedView(StrEnum):
    """The six views of the paper's table 1."""

    NEAR_GRAZING = "near-grazing"
    NEAR_FRONT = "near-front"
    INSHOT_GRAZING = "inshot-grazing"
    INSHOT_FRONT = "inshot-front"
    FAR_GRAZING = "far-grazing"
    FAR_FRONT = "far-front"


_GRAZING_ELEVATION = np.deg2rad(15.0)
_FRONT_ELEVATION = np.deg2rad(82.0)
_BELOW = np.deg2rad(-90.0)
# Distances in units of in shot.
_FILLED = 0.94  # share of the frame, in shot
_NEAR_SHARE = 0.1
_FAR_FACTOR = 10.0


@dataclass(frozen=True)
class View:
    """A camera that looks at the middle of the canvas.

    Attributes
    ----------
    azimuth, elevation : float
        Radians.
    distance_mm : float
        From the middle of the canvas.
    field_of_view : float
        Vertical, radians.
    """

    azimuth: float
    elevation: float
    distance_mm: float
    field_of_view: float = float(np.deg2rad(35.0))

    def __post_init__(self) -> None:
        if not 0 < self.field_of_view < np.pi:
            raise RenderError("the field of view lies between 0° and 180°")
        if not (np.isfinite(self.distance_mm) and self.distance_mm > 0):
            raise RenderError(f"the camera's distance must be positive, not {self.distance_mm} mm")
        if not (np.isfinite(self.azimuth) and abs(self.elevation) <= np.pi / 2 + 1e-9):
            raise RenderError("elevations run from -90° to 90°")

    @property
    def position(self) -> NDArray[np.float64]:
        """Of the camera in the canvas frame, (3,) mm."""
        return self.distance_mm * direction(self.azimuth, self.elevation)

    def pose(self) -> NDArray[np.float64]:
        """Camera to canvas, (4, 4), in OpenGL's camera axes (x right, y up, z backward)."""
        backward = direction(self.azimuth, self.elevation)
        # The painting hangs: its top is up. Along the canvas's own vertical that says nothing,
        # and the limit of grazing views there has the normal up from below, down from above.
        up = np.array([0.0, 1.0, 0.0])
        if abs(backward[1]) > 1 - 1e-9:
            up = np.array([0.0, 0.0, -np.sign(backward[1])])
        right = np.cross(up, backward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(backward, right), backward], axis=1)
        pose[:3, 3] = self.position
        return pose


def direction(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Unit vector from the canvas, (3,)."""
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def named_view(
    copy: DigitalCopy, name: NamedView, *, aspect: float, field_of_view: float = np.deg2rad(35.0)
) -> View:
    """One of the six views of a copy.

    In shot the whole canvas fits the frame; near is a tenth of that distance, but above the relief;
    far is ten times as far.

    Parameters
    ----------
    copy : DigitalCopy
    name : NamedView
    aspect : float
        Width of the frame over its height.
    field_of_view : float
        Vertical, radians.

    Returns
    -------
    View
    """
    distance_name, angle_name = name.value.split("-")
    elevation = _GRAZING_ELEVATION if angle_name == "grazing" else _FRONT_ELEVATION
    fitting = _fitting_distance(copy, elevation, aspect, field_of_view)
    distance = {"near": fitting * _NEAR_SHARE, "inshot": fitting, "far": fitting * _FAR_FACTOR}
    chosen = distance[distance_name]
    low, high = copy.height_field.height_range_mm
    clear = (high + 0.1 * (high - low) + copy.height_field.pitch_mm) / np.sin(elevation)
    return View(_BELOW, elevation, max(chosen, clear), field_of_view)


def _fitting_distance(
    copy: DigitalCopy, elevation: float, aspect: float, field_of_view: float
) -> float:
    """Least distance from below at which the box around the copy fits the frame, mm."""
    (x0, y0), (width, height) = copy.height_field.origin_mm, copy.height_field.size_mm
    half = 0.5 * copy.height_field.pitch_mm
    corners = np.array(
        [
            (x, y, z)
            for x in (x0 - half, x0 - half + width)
            for y in (y0 + half, y0 + half - height)
            for z in copy.height_field.height_range_mm
        ]
    )
    right, up, towards = (corners @ View(_BELOW, elevation, 1.0).pose()[:3, :3]).T
    frame = _FILLED * np.tan(field_of_view / 2)
    # A corner d - towards away from the camera shows at right and up over frame · (d - towards).
    needed = towards + np.maximum(np.abs(right) / aspect, np.abs(up)) / frame
    return float(needed.max())


def parse_view(
    text: str, copy: DigitalCopy, *, aspect: float, field_of_view: float = np.deg2rad(35.0)
) -> View:
    """A view by name, or as ``"azimuth,elevation,distance"`` in degrees and mm.

    Raises
    ------
    RenderError
        Neither.
    """
    if text in list(NamedView):
        return named_view(copy, NamedView(text), aspect=aspect, field_of_view=field_of_view)
    numbers = parse_numbers(text, 3)
    if numbers is None:
        raise RenderError(
            f"no view {text!r}; take one of {', '.join(NamedView)}, or azimuth,elevation,distance "
            'in degrees and mm, as in "-90,30,400"'
        )
    azimuth, elevation, distance = numbers
    return View(np.deg2rad(azimuth), np.deg2rad(elevation), distance, field_of_view)


def parse_numbers(text: str, count: int) -> list[float] | None:
    """Finite numbers separated by commas, or None where the text is not ``count`` of them."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        return None
    return numbers if len(numbers) == count and np.isfinite(numbers).all() else None
