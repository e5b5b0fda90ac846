"""A picture of photographs beside their renderings, and of where they differ most."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.atomic_files import write_bytes
from calibration.srgb import encode_srgb
from fitting.errors import FittingError
from fitting.reflectance.held_out import Comparison

_BLOCK = 24
_WORST = 4
_FULL_DELTA_E = 10.0
_STRIP = 22


def draw_held_out(comparisons: Sequence[Comparison], path: Path, *, most: int = 3) -> None:
    """Draw the worst photographs: measured, rendered, ΔE2000 from black (0) to white (10).

    The worst blocks of each are framed. Radiance is shown by sRGB's curve, white being its 99.9th
    percentile.

    Parameters
    ----------
    comparisons : sequence of Comparison
    path : Path
        PNG file.
    most : int
        Photographs drawn, the worst first.
    """
    if not comparisons:
        raise FittingError("no photograph was kept out of the fit: there is nothing to draw")
    worst = sorted(comparisons, key=lambda one: one.psnr_db)[:most]
    rows = [_row(one) for one in worst]
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
    done, png = cv2.imencode(".png", np.vstack(padded))
    if not done:
        raise FittingError(f"{path}: the picture could not be encoded")
    write_bytes(path, png.tobytes())


def _row(one: Comparison) -> NDArray[np.uint8]:
    seen = np.argwhere(np.isfinite(one.delta_e))
    (top, left), (bottom, right) = seen.min(axis=0), seen.max(axis=0) + 1
    here = np.s_[top:bottom, left:right]
    difference = np.nan_to_num(np.clip(one.delta_e[here] * 255 / _FULL_DELTA_E, 0, 255))
    panels = [
        _shown(one.measured[here], one.white),
        _shown(one.rendered[here], one.white),
        np.repeat(difference.astype(np.uint8)[..., np.newaxis], 3, axis=2),
    ]
    scale = max(1, round(420 / max(panels[0].shape[:2])))
    panels = [np.kron(p, np.ones((scale, scale, 1), np.uint8)) for p in panels]
    for row, col, _ in one.worst_blocks(block=_BLOCK, number=_WORST):
        corner = ((col - left) * scale, (row - top) * scale)
        opposite = (corner[0] + _BLOCK * scale, corner[1] + _BLOCK * scale)
        for panel in panels:
            cv2.rectangle(panel, corner, opposite, (40, 40, 230), 1)
    strip = np.zeros((_STRIP, sum(p.shape[1] for p in panels), 3), np.uint8)
    name = one.name.encode("ascii", "replace").decode().replace("?", " deg")
    text = f"{name}: {one.psnr_db:.1f} dB, mean Delta E {one.mean_delta_e:.2f}"
    cv2.putText(strip, text, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (230, 230, 230), 1)
    return np.asarray(np.vstack([strip, np.hstack(panels)]), np.uint8)


def _shown(image: NDArray[np.float32], white: float) -> NDArray[np.uint8]:
    """Linear radiance by the curve of sRGB, in OpenCV's order of the channels."""
    coded = encode_srgb(np.nan_to_num(image / np.float32(white)))
    return np.ascontiguousarray((255 * coded + 0.5).astype(np.uint8)[..., ::-1])
