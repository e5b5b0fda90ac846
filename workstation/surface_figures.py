"""What a board's surface showed, as numbers and in words: shear, relief, and motion per pose."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.procam import ProcamCalibration


def surface_figures(calibration: ProcamCalibration) -> dict[str, Any] | None:
    """Figures of a calibration by the board's surface; None of one from corners alone.

    Returns
    -------
    dict or None
        Shear in mrad, stretch as a share, lengths in mm, motion in mrad, mm and projector pixels;
        each with its standard error as ``_sigma``.
    """
    surface = calibration.surface
    if surface is None:
        return None
    skew, motion = surface.skew, surface.motion()
    height = surface.corner_places[..., 2]
    samples = surface.problem.samples
    poses = [
        {
            "name": name,
            "blocks": len(samples[n].pixels),
            "blocks_rms_px": surface.sample_rms_px[n].tolist(),
            "corners_rms_px": float(surface.corner_rms_px[n]),
            "turn_mrad": 1000 * float(motion.turn_rad[n]),
            "turn_sigma_mrad": 1000 * float(motion.turn_sigma_rad[n]),
            "shift_mm": float(motion.shift_mm[n]),
            "shift_sigma_mm": float(motion.shift_sigma_mm[n]),
            "moved_px": float(motion.moved_px[n]),
            "moved_sigma_px": float(motion.moved_sigma_px[n]),
        }
        for n, name in enumerate(calibration.solution.names)
    ]
    return {
        "shear_mrad": 1000 * skew.shear,
        "shear_sigma_mrad": 1000 * skew.sigma[0],
        "stretch": skew.stretch,
        "stretch_sigma": skew.sigma[1],
        "relief_lowest_mm": float(height.min()),
        "relief_highest_mm": float(height.max()),
        "relief_sigma_mm": float(np.median(surface.corner_sigma_mm[..., 2])),
        "corner_displacement_rms_mm": float(np.sqrt(np.mean(surface.displacement_mm**2))),
        "corner_displacement_sigma_mm": float(np.median(surface.corner_sigma_mm[..., :2])),
        "poses": poses,
    }


def surface_sentences(figures: dict[str, Any]) -> tuple[str, str]:
    """On the board, and on what moved, from :func:`surface_figures`."""
    moved = max(figures["poses"], key=lambda pose: pose["moved_px"])
    return (
        f"the board is printed askew by {figures['shear_mrad']:+.2f} ± "
        f"{figures['shear_sigma_mrad']:.2f} mrad and {100 * figures['stretch']:+.3f} ± "
        f"{100 * figures['stretch_sigma']:.3f} % longer along its rows; its corners stand "
        f"{figures['relief_lowest_mm']:+.3f} to {figures['relief_highest_mm']:+.3f} mm off their "
        f"plane (± {figures['relief_sigma_mm']:.3f} mm)",
        f"camera and projector moved against one another by up to {moved['turn_mrad']:.2f} ± "
        f"{moved['turn_sigma_mrad']:.2f} mrad from the mean ({moved['name']}), which is "
        f"{moved['moved_px']:.2f} ± {moved['moved_sigma_px']:.2f} px on the board",
    )
