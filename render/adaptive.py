"""Which boxes an adaptive rendering draws: the coefficient α_box (paper section 5.3, eq. 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from render.errors import RenderError


@dataclass(frozen=True, kw_only=True)
class AdaptiveOptions:
    """Sensitivity of the switch between bump and relief mapping.

    Attributes
    ----------
    K : float
        Scale of the ratio r = |IB| / |CI|.
    epsilon_min, epsilon_max : float
        Where K r is below the first a box is not drawn, above the second it is opaque.

    Raises
    ------
    RenderError
        A negative K, or ε_min not below ε_max.
    """

    K: float = 1.0
    epsilon_min: float = 0.0005
    epsilon_max: float = 0.002

    def __post_init__(self) -> None:
        if not (np.isfinite(self.K) and self.K >= 0):
            raise RenderError(f"K must be a number that is not negative, not {self.K}")
        if not 0 <= self.epsilon_min < self.epsilon_max < np.inf:
            raise RenderError(
                f"0 ≤ ε_min < ε_max is needed, not {self.epsilon_min} and {self.epsilon_max}"
            )


def box_alpha(
    copy: DigitalCopy, camera: NDArray[np.float64], options: AdaptiveOptions | None = None
) -> NDArray[np.float64]:
    """α_box of every box for a camera.

    I is the highest point of a box, B where the viewing ray through I meets the bump plane at δ0.

    Parameters
    ----------
    copy : DigitalCopy
    camera : (3,) array
        Position C in the canvas frame, mm.
    options : AdaptiveOptions, optional

    Returns
    -------
    (boxes,) float64 array
        From 0 (not drawn) to 1 (opaque).
    """
    options = options or AdaptiveOptions()
    field, boxes = copy.height_field, copy.relief.boxes
    highest = np.stack(
        [
            field.origin_mm[0] + field.pitch_mm * boxes.peak[:, 1],
            field.origin_mm[1] - field.pitch_mm * boxes.peak[:, 0],
            boxes.h_max,
        ],
        axis=1,
    )
    # B = I + s (I - C) on the plane, so r = |s|; a ray that never meets it is beyond any threshold.
    above = np.maximum(highest[:, 2] - copy.relief.delta0_mm, 0.0)
    fall = np.asarray(camera, dtype=np.float64)[2] - highest[:, 2]
    r = np.full(len(boxes), np.inf)
    np.divide(above, fall, out=r, where=fall > 0)
    # K = 0 asks for no box at all, whatever r is.
    scaled = options.K * r if options.K > 0 else np.zeros(len(boxes))
    span = options.epsilon_max - options.epsilon_min
    return np.asarray(np.clip((scaled - options.epsilon_min) / span, 0.0, 1.0))
