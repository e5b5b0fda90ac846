"""Parts of a copy's report on its reflectance: maps, and photographs that the fit did not see."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from calibration.srgb import encode_srgb
from fitting.digital_copy import DigitalCopy, ReflectanceMaps
from fitting.errors import CopyError
from fitting.reflectance.flags import TexelFlag
from workstation.copy_writing import HELD_OUT_FILE, HELD_OUT_FOLDER
from workstation.report_maps import draw_map
from workstation.report_page import Comparison, Picture, Section, Table

# Of each photograph that was kept out.
_PICTURES = ("measured", "rendered")
_DIFFERENCES = ("photograph", "PSNR", "noise alone", "mean ΔE2000", "noise alone")


def reflectance_section(copy: DigitalCopy) -> Section:
    """Maps of the lobes, and what is known of their errors."""
    maps = copy.reflectance
    assert maps is not None
    diffuse = np.pi * maps.diffuse.astype(np.float64)
    specular = maps.specular.astype(np.float64).mean(axis=-1)
    exponent = np.log10(np.maximum(maps.lobe[..., 3].astype(np.float64), 1.0))
    pictures = [
        Picture("Diffuse colour π ρ_d, as sRGB", draw_map(copy, encode_srgb(diffuse))),
        Picture(
            "Strength of the lobe ρ_s, mean of red, green and blue",
            draw_map(copy, specular, scale="ρ_s, 1/sr", colours="cividis", limits=(1, 99)),
        ),
        Picture(
            "Sharpness of the lobe, log₁₀ k",
            draw_map(copy, exponent, scale="log₁₀ k", colours="cividis", limits=(1, 99)),
        ),
        *_quality_maps(copy, maps),
    ]
    return Section(
        "Reflectance",
        "One Lafortune lobe per texel: a diffuse part, and a highlight of a strength and sharpness "
        "of its own.",
        tables=tuple(_tables(copy, maps)),
        pictures=tuple(pictures),
    )


def _quality_maps(copy: DigitalCopy, maps: ReflectanceMaps) -> list[Picture]:
    if maps.quality is None:
        return []
    sigma = np.pi * maps.quality.diffuse_sigma.astype(np.float64).mean(axis=-1)
    residual = np.pi * maps.quality.residual.astype(np.float64)
    return [
        Picture(
            "Predicted standard error of the diffuse colour π ρ_d",
            draw_map(
                copy, sigma, scale="standard error, white = 1", colours="magma", limits=(0, 98)
            ),
        ),
        Picture(
            "Observed: RMS that the lobe leaves of the samples, times π",
            draw_map(
                copy, residual, scale="RMS residual × π, white = 1", colours="magma", limits=(0, 98)
            ),
        ),
    ]


def _tables(copy: DigitalCopy, maps: ReflectanceMaps) -> list[Table]:
    found: dict[str, Any] = copy.provenance.get("reflectance") or {}
    rows: list[tuple[str, ...]] = []
    if found.get("photographs"):
        rows.append(("photographs behind the fit", str(found["photographs"])))
    if maps.quality is not None:
        mask = copy.height_field.mask
        samples, flags = maps.quality.samples[mask], maps.quality.flags[mask]
        rows.append(("samples of a texel, median", f"{np.median(samples):.0f}"))
        for flag in TexelFlag:
            share = float(np.mean((flags & int(flag)) != 0))
            if flag.name and share > 0:
                name = flag.name.lower().replace("_", " ")
                rows.append((f"texels flagged {name}", f"{100 * share:.2g} %"))
    tables = [Table(tuple(rows))] if rows else []
    materials = found.get("materials") or []
    if materials:
        heading = ("", "k", "lobe", "misfit, of a 20 % grey's radiance")
        lobes = tuple(
            (f"material {n}", f"{m['k']:.1f}", m["variant"].lower(), f"{100 * _misfit(m):.1f} %")
            for n, m in enumerate(materials, start=1)
        )
        tables.append(Table(lobes, heading))
    return tables


def _misfit(material: dict[str, Any]) -> float:
    """What the lobe is off by, its floor and its share of the radiance, for a matt 20 % grey."""
    grey = 0.2 / math.pi
    return math.hypot(material["misfit"] / grey, material["misfit_relative"])


def held_out_section(copy_folder: Path) -> Section | None:
    """Photographs beside their renderings, each with a slider; None where none was kept out.

    Raises
    ------
    CopyError
        The list of them is damaged.
    """
    listed = copy_folder / HELD_OUT_FILE
    if not listed.is_file():
        return None
    folder = copy_folder / HELD_OUT_FOLDER
    try:
        rows = json.loads(listed.read_text())
        pairs = [_pair(folder, row) for row in rows if _is_whole(folder, row)]
        table = tuple(_differences(row) for row in rows)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CopyError(f"{listed}: damaged ({error}); process the session again") from None
    text = (
        "The fit has not seen these photographs. What their own noise makes of it is what would be "
        "left if the copy were perfect."
    )
    if pairs:
        text += (
            " Move the slider, with the mouse or the arrow keys: the photograph is to its left, "
            "what the copy shows under the same light to its right."
        )
    if len(pairs) < len(rows):
        text += f" Of {len(rows) - len(pairs)} the pictures are not in the copy any more."
    return Section(
        "Photographs kept out",
        text,
        tables=(Table(table, _DIFFERENCES),),
        comparisons=tuple(pairs),
    )


def _differences(row: dict[str, Any]) -> tuple[str, ...]:
    # Copies made before the noise was predicted have none of its figures.
    noise_db, noise_delta = (row.get(name) for name in ("noise_psnr_db", "noise_delta_e"))
    return (
        str(row["name"]),
        f"{row['psnr_db']:.1f} dB",
        "–" if noise_db is None else f"{noise_db:.1f} dB",
        f"{row['delta_e']:.2f}",
        "–" if noise_delta is None else f"{noise_delta:.2f}",
    )


def _is_whole(folder: Path, row: dict[str, Any]) -> bool:
    """Whether both pictures are there: a copy serves without them."""
    return all((folder / f"{row['name']}-{kind}.png").is_file() for kind in _PICTURES)


def _pair(folder: Path, row: dict[str, Any]) -> Comparison:
    name = str(row["name"])
    left, right = (
        Picture(f"{what} {name}", (folder / f"{name}-{kind}.png").read_bytes())
        for what, kind in zip(("photograph", "rendering of"), _PICTURES, strict=True)
    )
    caption = f"{name}: {row['psnr_db']:.1f} dB, mean ΔE2000 {row['delta_e']:.2f}"
    return Comparison(caption, left, right)
