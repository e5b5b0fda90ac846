"""Digital copies whose shape is known, for holding the renderer against itself and its reference.

The oil painting is the simulated rig's, without a scan between: its heights averaged over the
texels, with reflectance that only has to look like paint. The plaster relief and the dime are real
shapes, and are there where IMPASTO_REAL_DATA names the folder of real captures.
"""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from devices.simulated.oil_painting import paint_oil
from devices.simulated.surface import Surface
from fitting.digital_copy import DigitalCopy, ReflectanceMaps
from fitting.height_field import HeightField
from fitting.neighbour_kernels import triangle_normals
from fitting.relief_classification import ReliefOptions, classify_relief

Floats = NDArray[np.float32]

_DIME_PITCH_MM = 0.0632
_DIELECTRIC = 0.04  # reflectance of oil paint, head-on


def copy_of_heights(
    height: Floats,
    pitch_mm: float,
    *,
    mask: NDArray[np.bool_] | None = None,
    reflectance: ReflectanceMaps | None = None,
    cell: int = 20,
) -> DigitalCopy:
    """A copy of heights (rows, cols) in mm about the middle of its canvas."""
    rows, cols = height.shape
    mask = np.ones(height.shape, np.bool_) if mask is None else mask
    variance = np.where(mask, np.float32(1e-6), np.float32(0))
    field = HeightField(
        np.where(mask, height, 0).astype(np.float32),
        mask,
        variance,
        pitch_mm,
        (-(cols - 1) / 2 * pitch_mm, (rows - 1) / 2 * pitch_mm),
        np.zeros(6),
    )
    normal, sigma = triangle_normals(field.height, mask, variance, pitch_mm)
    relief = classify_relief(field, ReliefOptions(cell=cell))
    return DigitalCopy(field, normal, relief, np.nan_to_num(sigma), reflectance)


def oil_copy(*, texel: int = 4, seed: int = 0, cell: int = 20) -> DigitalCopy:
    """The simulated oil painting's canvas, 400 × 300 mm, in texels of 0.1 mm times ``texel``."""
    surface = _canvas(paint_oil(seed=seed))
    height = _averaged(surface.height, texel)
    return copy_of_heights(
        height - np.float32(np.median(height)),
        surface.pitch_mm * texel,
        reflectance=paint_reflectance(surface, texel),
        cell=cell,
    )


def paint_reflectance(surface: Surface, texel: int) -> ReflectanceMaps:
    """Lobes that look like a surface's paint and varnish, averaged over texels.

    The lobe is a mirror's with k = 2 / α² - 2, Phong's exponent of a microfacet width α, and holds
    the energy that a dielectric reflects head-on.
    """
    albedo = _averaged((surface.albedo / np.float32(255)) ** 2, texel)
    varnish = _averaged(surface.varnish / np.float32(255), texel)
    alpha = _averaged(surface.roughness / np.float32(255), texel)
    alpha = np.clip(alpha + (0.2 - alpha) * varnish, 0.15, 0.9)
    k = np.clip(2 / alpha**2 - 2, 1, 80)
    energy = _DIELECTRIC * (k + 1) / (2 * np.pi)
    lobe = np.stack([-np.ones_like(k), -np.ones_like(k), np.ones_like(k), k], axis=-1)
    return ReflectanceMaps(
        (albedo * (1 - _DIELECTRIC) / np.pi).astype(np.float32),
        np.repeat(energy[..., np.newaxis], 3, axis=-1).astype(np.float32),
        lobe.astype(np.float32),
    )


def dime_heights(data: Path) -> tuple[Floats, float]:
    """Heights about their median, and their spacing, mm, of a measured coin, 17.9 mm across."""
    height = np.load(data / "gelsight_dime" / "dime_height_mm.npy").astype(np.float32)
    return height - np.float32(np.nanmedian(height)), _DIME_PITCH_MM


def dime_copy(data: Path) -> DigitalCopy:
    """The coin, matt."""
    return copy_of_heights(*dime_heights(data))


def plaster_copy(data: Path) -> DigitalCopy:
    """A plaster relief as this project scans it: deep, noisy, with gaps; matt."""
    from acquisition.capture_description import read_description
    from acquisition.foreign_capture import find_capture, record_capture
    from calibration.opencv_files import read_rig_geometry
    from workstation.processing import process_session

    name = "slmaster_relief_mono"
    fixtures = Path(__file__).parents[2] / "fixtures" / "captures"
    description = read_description(fixtures / f"{name}.toml")
    names = description.calibration
    assert names is not None  # the fixture names one
    with TemporaryDirectory() as folder:
        rig = read_rig_geometry(
            data / name / names.file,
            names,
            camera=description.camera,
            projector=description.projector,
        )
        rig.save(Path(folder) / "calibration")
        found = find_capture(data / name, description)
        record_capture(found, Path(folder) / "s", calibration=Path(folder) / "calibration")
        return process_session(Path(folder) / "s").copy


def real_copies() -> dict[str, DigitalCopy]:
    """The dime and the plaster relief by name; none where there are no real captures."""
    data = os.environ.get("IMPASTO_REAL_DATA")
    if not data:
        return {}
    return {"dime": dime_copy(Path(data)), "plaster": plaster_copy(Path(data))}


def _canvas(surface: Surface) -> Surface:
    """The part of a painting's surface within its frame."""
    rows, cols = surface.height.shape
    width, height = (round(side / surface.pitch_mm) for side in surface.canvas_mm)
    top, left = (rows - height) // 2, (cols - width) // 2
    inside = slice(top, top + height), slice(left, left + width)
    return Surface(
        surface.height[inside],
        surface.albedo[inside],
        surface.roughness[inside],
        surface.varnish[inside],
        surface.metal[inside],
        surface.pitch_mm,
        surface.canvas_mm,
    )


def _averaged(values: Floats, texel: int) -> Floats:
    rows, cols = (side // texel for side in values.shape[:2])
    blocks = values[: rows * texel, : cols * texel].reshape(rows, texel, cols, texel, -1)
    means = blocks.mean(axis=(1, 3), dtype=np.float32)
    return np.asarray(means[..., 0] if values.ndim == 2 else means)
