"""Gates on a calibration by the board's surface: what the surface leaves, and what moved."""

from __future__ import annotations

import numpy as np

from calibration.dense_solution import DenseSolution
from calibration.gate_limits import Gate, GateLimits
from calibration.verdicts import Criterion, Verdict

# Projector and camera that move by this many times what is warned of are no rig.
_REFUSED_MOTION = 10.0


def surface_criterion(surface: DenseSolution, limits: GateLimits) -> Criterion:
    """What blocks of the board's surface are off in the projector, of the worst pose."""
    worst = float(np.linalg.norm(surface.sample_rms_px, axis=1).max())
    return Criterion("RMS of the surface's blocks, worst pose, px", worst, limits.residual_px)


def motion_verdict(surface: DenseSolution, names: tuple[str, ...], limits: GateLimits) -> Verdict:
    """Whether camera and projector stood still to one another from pose to pose.

    The motion was solved for, so it does not spoil the calibration; but a scan is recorded after
    one more of the kind.
    """
    motion = surface.motion()
    beyond = np.maximum(motion.moved_px - 2 * motion.moved_sigma_px, 0)
    worst = int(np.argmax(beyond))
    found, name = float(beyond[worst]), "motion beyond twice its standard error, px"
    return Verdict(
        Gate.MOTION,
        (
            Criterion(f"worst {name}", found, limits.motion_px, refuses=False),
            Criterion(
                f"worst {name}, to be used at all", found, _REFUSED_MOTION * limits.motion_px
            ),
        ),
        f"camera and projector moved against one another: in {names[worst]} the projector stood "
        f"{1000 * motion.turn_rad[worst]:.2f} mrad and {motion.shift_mm[worst]:.2f} mm from its "
        f"mean place, which moves its picture by {motion.moved_px[worst]:.2f} ± "
        f"{motion.moved_sigma_px[worst]:.2f} px on the board; it was solved for, but the next scan "
        "will have moved as well: tighten what holds both, and let them warm up",
    )
