"""Heights read back from rendered depth."""

from __future__ import annotations

import numpy as np

from render.painter import RenderedImage
from render.views import View


def heights_hit(picture: RenderedImage, view: View) -> np.ndarray:
    """Height in the canvas frame of what each pixel shows; minus infinity where nothing is."""
    rows, cols = picture.depth_mm.shape
    half = np.tan(view.field_of_view / 2)
    x = (2 * (np.arange(cols) + 0.5) / cols - 1) * half * cols / rows
    y = (1 - 2 * (np.arange(rows) + 0.5) / rows) * half
    x, y = np.meshgrid(x, y)
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1) @ view.pose()[:3, :3].T
    z = view.position[2] + picture.depth_mm * rays[..., 2]
    return np.where(picture.depth_mm > 0, z, -np.inf)
