"""The digital copy on disk: a folder of one JSON file and OpenEXR maps.

``copy.json`` holds size, pose, relief parameters, boxes and provenance; ``relief.exr`` height, n_x,
n_y and the mask; ``uncertainty.exr`` the standard errors of height and slope; ``diffuse.exr``,
``specular.exr`` and ``lobe.exr`` the reflectance, where it was measured, and
``reflectance-quality.exr`` how well it is known. See ``docs/file-formats.md``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from acquisition.atomic_files import folder_in_progress
from fitting.digital_copy import DigitalCopy, ReflectanceMaps, ReflectanceQuality
from fitting.errors import CopyError, FittingError
from fitting.exr_files import write_exr
from fitting.height_field import HeightField
from fitting.map_rounding import MapRounding
from fitting.reflectance.microfacet import MicrofacetMaps
from fitting.relief import Relief, ReliefBoxes

FORMAT = "impasto-copy-1"
COPY_FILE = "copy.json"
MICROFACET_FILE = "ggx.exr"
_REFLECTANCE = {"diffuse": "RGB", "specular": "RGB", "lobe": "CXYK"}
_QUALITY_FILE = "reflectance-quality.exr"
_QUALITY = {
    "diffuse_sigma": ("diffuse.R", "diffuse.G", "diffuse.B"),
    "specular_sigma": ("specular.R", "specular.G", "specular.B"),
    "lobe_sigma": ("ln_k", "ln_r", "ln_c"),
    "residual": ("residual",),
    "samples": ("samples",),
    "flags": ("flags",),
}
_WHOLE_NUMBERS = {"samples", "flags"}
_LARGEST_HALF = float(np.finfo(np.float16).max)


def write_copy(
    copy: DigitalCopy,
    path: Path,
    *,
    replace: bool = False,
    microfacets: MicrofacetMaps | None = None,
    exact_maps: bool = False,
    beside: Callable[[Path], None] = lambda folder: None,
) -> None:
    """Write a digital copy, whole or not at all.

    Parameters
    ----------
    copy : DigitalCopy
    path : Path
        Folder to make.
    replace : bool
        Whether a copy that is there already is replaced.
    microfacets : MicrofacetMaps, optional
        The reflectance as other viewers take it, for ``ggx.exr``.
    exact_maps : bool
        Whether maps keep every bit that the files have room for, instead of those alone that their
        standard errors leave a meaning (:mod:`fitting.map_rounding`).
    beside : callable, optional
        Writes further files into the copy's folder before it appears.

    Raises
    ------
    CopyError
        ``path`` exists and is not to be replaced, or is no copy; or a reflectance is beyond what
        half floats hold.
    """
    path = Path(path)
    check_destination(path, replace=replace)
    rounding = None if exact_maps else MapRounding.of(copy)
    copy = copy if rounding is None else rounding.applied(copy)
    field = copy.height_field
    with folder_in_progress(path, replace=replace) as folder:
        relief: dict[str, NDArray[Any]] = {
            "height": _as_half_if_exact(field.height),
            "nx": copy.normal_xy[..., 0].astype(np.float16),
            "ny": copy.normal_xy[..., 1].astype(np.float16),
            "mask": field.mask.astype(np.float16),
            "significant": copy.relief.significant.astype(np.float16),
        }
        write_exr(folder / "relief.exr", relief)
        sigma = {"height": np.sqrt(field.variance), "slope": copy.slope_sigma}
        write_exr(folder / "uncertainty.exr", {k: v.astype(np.float16) for k, v in sigma.items()})
        if copy.reflectance is not None:
            _write_reflectance(folder, copy.reflectance)
        if microfacets is not None:
            _write_microfacets(folder / MICROFACET_FILE, microfacets)
        beside(folder)
        header = _header(copy) | {"rounding": None if rounding is None else rounding.as_json()}
        (folder / COPY_FILE).write_text(json.dumps(header, indent=1, allow_nan=False))


def _as_half_if_exact(values: NDArray[np.float32]) -> NDArray[Any]:
    """Half floats where they hold every value as it is: rounded heights take half the room so."""
    with np.errstate(over="ignore"):
        half = values.astype(np.float16)
    return half if np.array_equal(half, values) else values


def check_destination(path: Path, *, replace: bool) -> None:
    """Refuse to write a copy over anything but a copy that is to be replaced.

    Raises
    ------
    CopyError
    """
    if path.exists() and not (replace and _is_copy(path)):
        raise CopyError(f"{path} exists already; choose another place, or remove it first")


def _is_copy(path: Path) -> bool:
    """Whether a folder is a copy of this version or another, and not somebody's ``copy.json``."""
    try:
        header = json.loads((path / COPY_FILE).read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    found = header.get("format") if isinstance(header, dict) else None
    return isinstance(found, str) and found.startswith("impasto-copy-")


def read_copy(path: Path) -> DigitalCopy:
    """Read what :func:`write_copy` wrote.

    Raises
    ------
    CopyError
        A file is missing or damaged, shapes disagree, a measured value is not finite, or a number
        of ``copy.json`` is none that such a copy can have.
    """
    path = Path(path)
    header = _read_header(path / COPY_FILE)
    relief = _read_exr(path / "relief.exr", ("height", "nx", "ny", "mask", "significant"))
    sigma = _read_exr(path / "uncertainty.exr", ("height", "slope"))
    try:
        boxes = header["boxes"]
        count = len(boxes["h_max"])
        field = HeightField(
            relief["height"].astype(np.float32),
            relief["mask"] > 0.5,
            sigma["height"].astype(np.float32) ** 2,
            float(header["pitch_mm"]),
            (float(header["origin_mm"][0]), float(header["origin_mm"][1])),
            np.array(header["rt_cam_canvas"], dtype=np.float64),
            # Copies of earlier versions lack these.
            _array_or_none(header.get("correlation")),
            float(header.get("unresolved_mm", 0.0)),
        )
        copy = DigitalCopy(
            field,
            np.stack([relief["nx"], relief["ny"]], axis=-1).astype(np.float32),
            Relief(
                float(header["delta0_mm"]),
                int(header["cell"]),
                relief["significant"] > 0.5,
                ReliefBoxes(
                    np.array(boxes["corner"], np.int32).reshape(count, 2),
                    np.array(boxes["size"], np.int32).reshape(count, 2),
                    np.array(boxes["h_max"], np.float32),
                    np.array(boxes["peak"], np.int32).reshape(count, 2),
                ),
                header.get("proposed_delta0_mm"),
            ),
            sigma["slope"].astype(np.float32),
            _read_reflectance(path, header) if header["reflectance"] else None,
            header["provenance"],
        )
    except FittingError as error:
        raise CopyError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise CopyError(f"{path / COPY_FILE}: {type(error).__name__} at {error}") from None
    wrong = [name for name, sound in _soundness(copy).items() if not sound]
    if wrong:
        rows, cols = field.shape
        raise CopyError(
            f"{path / COPY_FILE}: {', '.join(wrong)} cannot be that of a copy of {cols} × {rows} "
            "texels"
        )
    return copy


def _soundness(copy: DigitalCopy) -> dict[str, bool]:
    """Whether what ``copy.json`` says can be, where nothing else checks it."""
    field, relief, boxes = copy.height_field, copy.relief, copy.relief.boxes
    proposed = relief.proposed_delta0_mm
    ends = boxes.corner.astype(np.int64) + boxes.size
    return {
        "origin_mm": bool(np.isfinite(field.origin_mm).all()),
        "rt_cam_canvas": field.rt_cam_canvas.shape == (6,)
        and bool(np.isfinite(field.rt_cam_canvas).all()),
        "unresolved_mm": 0 <= field.unresolved_mm < np.inf,
        "delta0_mm": bool(np.isfinite(relief.delta0_mm)),
        "proposed_delta0_mm": proposed is None
        or (isinstance(proposed, int | float) and bool(np.isfinite(proposed))),
        "cell": relief.cell > 0,
        "boxes": boxes.h_max.ndim == 1
        and bool(np.isfinite(boxes.h_max).all())
        and bool((boxes.corner >= 0).all() and (boxes.size > 0).all())
        and bool((ends <= field.shape).all())
        and bool((boxes.peak >= 0).all() and (boxes.peak < field.shape).all()),
        "provenance": isinstance(copy.provenance, dict),
    }


def _header(copy: DigitalCopy) -> dict[str, Any]:
    field, relief = copy.height_field, copy.relief
    return {
        "format": FORMAT,
        "units": {"length": "mm", "angle": "rad", "reflectance": "1/sr"},
        "size_mm": list(field.size_mm),
        "shape": list(field.shape),
        "pitch_mm": field.pitch_mm,
        "origin_mm": list(field.origin_mm),
        "rt_cam_canvas": field.rt_cam_canvas.tolist(),
        "correlation": None if field.correlation is None else field.correlation.tolist(),
        "unresolved_mm": field.unresolved_mm,
        "delta0_mm": relief.delta0_mm,
        "proposed_delta0_mm": relief.proposed_delta0_mm,
        "H_mm": field.height_range_mm[1],
        "cell": relief.cell,
        "boxes": {
            "corner": relief.boxes.corner.tolist(),
            "size": relief.boxes.size.tolist(),
            "h_max": relief.boxes.h_max.astype(float).tolist(),
            "peak": relief.boxes.peak.tolist(),
        },
        "reflectance": copy.reflectance is not None,
        "reflectance_quality": copy.reflectance is not None
        and copy.reflectance.quality is not None,
        "provenance": copy.provenance,
    }


def _array_or_none(values: Any) -> NDArray[np.float64] | None:
    return None if values is None else np.array(values, dtype=np.float64)


def _read_header(path: Path) -> dict[str, Any]:
    try:
        header = json.loads(path.read_text())
    except (FileNotFoundError, NotADirectoryError):
        raise CopyError(f"{path} is missing: this is not a digital copy") from None
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise CopyError(f"{path}: not JSON ({error})") from None
    found = header.get("format") if isinstance(header, dict) else None
    if found != FORMAT:
        raise CopyError(f"{path}: format {found!r}, this version reads {FORMAT!r}")
    return dict(header)


def _write_reflectance(folder: Path, maps: ReflectanceMaps) -> None:
    for name, channels in _REFLECTANCE.items():
        array = getattr(maps, name)
        if np.abs(array).max() > _LARGEST_HALF:
            raise CopyError(
                f"{name} reaches {np.abs(array).max():g}, and the copy's files hold no more than "
                f"{_LARGEST_HALF:g}: radiance is to be relative to a white reference"
            )
        array = array.astype(np.float16)
        write_exr(folder / f"{name}.exr", {c: array[..., i] for i, c in enumerate(channels)})
    if maps.quality is None:
        return
    layers: dict[str, NDArray[Any]] = {}
    for name, array in maps.quality.arrays.items():
        whole = name in _WHOLE_NUMBERS
        # A standard error beyond the largest half says no more than the largest half does.
        limit = np.iinfo(np.uint16).max if whole else _LARGEST_HALF
        stored = np.minimum(array, limit).astype(np.uint32 if whole else np.float16)
        stored = stored.reshape(*array.shape[:2], -1)
        layers |= {channel: stored[..., i] for i, channel in enumerate(_QUALITY[name])}
    write_exr(folder / _QUALITY_FILE, layers)


def _write_microfacets(path: Path, maps: MicrofacetMaps) -> None:
    layers = {
        f"{name}.{channel}": getattr(maps, name)[..., i].astype(np.float16)
        for name in ("albedo", "f0")
        for i, channel in enumerate("RGB")
    }
    layers |= {name: getattr(maps, name).astype(np.float16) for name in ("alpha", "error")}
    write_exr(path, layers)


def _read_reflectance(path: Path, header: dict[str, Any]) -> ReflectanceMaps:
    maps = {}
    for name, channels in _REFLECTANCE.items():
        layers = _read_exr(path / f"{name}.exr", tuple(channels))
        maps[name] = np.stack([layers[c] for c in channels], axis=-1).astype(np.float32)
    # Copies of earlier versions lack it.
    known = header.get("reflectance_quality", False)
    return ReflectanceMaps(**maps, quality=_read_quality(path) if known else None)


def _read_quality(path: Path) -> ReflectanceQuality:
    names = tuple(name for channels in _QUALITY.values() for name in channels)
    layers = _read_exr(path / _QUALITY_FILE, names)
    maps = {}
    for name, channels in _QUALITY.items():
        kind = np.uint16 if name in _WHOLE_NUMBERS else np.float32
        stacked = np.stack([layers[channel] for channel in channels], axis=-1).astype(kind)
        maps[name] = stacked if len(channels) > 1 else stacked[..., 0]
    return ReflectanceQuality(**maps)


def _read_exr(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    if not path.is_file():
        raise CopyError(f"{path} is missing: the copy is not whole")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            layers = {name: np.array(channels[name].pixels) for name in names}
    except KeyError as error:
        raise CopyError(f"{path}: no channel {error}") from None
    except Exception as error:  # the binding raises RuntimeError and others of its own
        raise CopyError(f"{path}: truncated or damaged ({error})") from None
    if len({layer.shape for layer in layers.values()}) != 1:
        raise CopyError(f"{path}: channels of different sizes")
    return layers
