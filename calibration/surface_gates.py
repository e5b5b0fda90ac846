"""Gates on a calibration by the board's surface: what the surface leaves, and what moved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.dense_solution import DenseSolution
from calibration.gate_limits import Gate, GateLimits
from calibration.verdicts import Criterion, Verdict

# Projector and camera that move by this many times what is warned of are no rig.
_REFUSED_MOTION = 10.0


def surface_criterion(surface: DenseSolution, limits: GateLimits) -> Criterion:
    """What blocks of the board's surface are off in the projector, of the worst pose."""
    worst = float(_off_px(surface).max())
    return Criterion("RMS of the surface's blocks, worst pose, px", worst, limits.residual_px)


def surface_remedy(surface: DenseSolution, names: tuple[str, ...]) -> str:
    """What to do where :func:`surface_criterion` does not hold."""
    off = _off_px(surface)
    # A figure that is not known is the worst, as for the criterion.
    worst = int(np.argmax(off))
    return (
        f"the white of the board is {off[worst]:.2f} px off the surface that all poses share, most "
        f"of all in {names[worst]}: its fringes were decoded wrongly, or the board bent or moved "
        "while it was recorded; record it again, on a firm support"
    )


def _off_px(surface: DenseSolution) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(surface.sample_rms_px, axis=1))


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
