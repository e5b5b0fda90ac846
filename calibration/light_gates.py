"""Gates of a calibrated light arm.

Highlights fit an arm as well with spheres of a wrong radius, which puts all of them, and the lamps,
at a wrong distance. What contradicts it is the white target: where it stands, and how the lamp's
light falls on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from calibration.light_arm import LightArm
from calibration.mirror_spheres import MirrorSphere
from calibration.verdicts import Criterion, GateReport, Sense, Untested, Verdict

# What a radius may seem wrong by chance, in standard errors.
_SIGMAS = 3.0


class LightGate(StrEnum):
    """What is tested."""

    DISTANCE = "spheres beside the target"
    OUTLINES = "spheres where their outlines are"
    HIGHLIGHTS = "highlights"
    SUSPECT = "suspect poses"
    SHADING = "shading of the target"
    RADIUS = "radius of the spheres by the target's shading"


@dataclass(frozen=True, kw_only=True)
class LightGateLimits:
    """What is let through.

    Attributes
    ----------
    behind_radii, before_radii : float
        Most distance of a sphere's middle behind the target's plane and before it, over its radius.
    outline_sigmas : float
        Most shift of a sphere by its highlights from where its outline is, in standard errors.
    residual_deg : float
        Most root mean square angle between lamps and highlights.
    suspect_share : float
        Most share of poses whose highlights are off by more than noise explains.
    shading_misfit : float
        Most relative root mean square error of the target's radiance from pose to pose, beyond
        which it is flagged: what is called matt departs from Lambert's law by some hundredths.
    largest_shading_misfit : float
        The same, beyond which it refuses.
    radius_error : float
        Most relative error of the spheres' radius, beyond three times its standard error, by the
        target's shading; a hundredth is 0.4° of direction. Beyond these three alone it is flagged.
    radius_sigma : float
        Largest standard error of it that tells a right radius.
    """

    behind_radii: float = 1.0
    before_radii: float = 4.0
    outline_sigmas: float = 3.0
    residual_deg: float = 0.5
    suspect_share: float = 0.25
    shading_misfit: float = 0.03
    largest_shading_misfit: float = 0.1
    radius_error: float = 0.005
    radius_sigma: float = 0.02


def check_lights(
    arm: LightArm,
    spheres: Sequence[MirrorSphere],
    *,
    target_middle: NDArray[np.float64],
    target_normal: NDArray[np.float64],
    limits: LightGateLimits | None = None,
) -> GateReport:
    """Put a light arm's calibration through the gates.

    Parameters
    ----------
    arm : LightArm
    spheres : sequence of MirrorSphere
        By which it was calibrated, where their outlines are.
    target_middle, target_normal : (3,) arrays
        Of the white target, in the camera's frame; the normal towards the camera.
    limits : LightGateLimits, optional
    """
    limits = limits or LightGateLimits()
    verdicts = [
        check_distance(spheres, target_middle, target_normal, limits),
        _outlines(arm, limits),
        _highlights(arm, limits),
        _suspect(arm, limits),
        _shading(arm, limits),
    ]
    radius = _radius(arm, spheres[0].radius_mm, limits)
    if isinstance(radius, Untested):
        return GateReport(tuple(verdicts), (radius,))
    return GateReport((*verdicts, radius))


def check_distance(
    spheres: Sequence[MirrorSphere],
    middle: NDArray[np.float64],
    normal: NDArray[np.float64],
    limits: LightGateLimits | None = None,
) -> Verdict:
    """Whether spheres stand beside the white target, as :func:`check_lights` asks.

    It takes no arm, and so tells why one could not be fitted.
    """
    limits = limits or LightGateLimits()
    before = np.array([(one.centre - middle) @ normal for one in spheres])
    radius = spheres[0].radius_mm
    if before.min() < -limits.behind_radii * radius:
        said = f"{-before.min():.0f} mm behind the white target's plane"
    else:
        said = f"{before.max():.0f} mm before the white target's plane"
    # A sphere of another radius that looks the same is at a distance in proportion.
    share = float(np.mean([one.centre @ normal for one in spheres])) / radius
    least, most = middle @ normal / (share - 1), middle @ normal / share
    return Verdict(
        LightGate.DISTANCE,
        (
            Criterion(
                "least distance before the plane, radii",
                float(before.min() / radius),
                -limits.behind_radii,
                Sense.AT_LEAST,
            ),
            Criterion(
                "largest distance before the plane, radii",
                float(before.max() / radius),
                limits.before_radii,
            ),
        ),
        f"with a radius of {radius:g} mm the spheres would stand {said}; beside it they have one "
        f"of {least:.1f} to {most:.1f} mm: measure the radius, which is half the diameter, and "
        "stand the spheres beside the target",
    )


def _outlines(arm: LightArm, limits: LightGateLimits) -> Verdict:
    worst = int(np.argmax(arm.sphere_shift_sigmas))
    found = float(arm.sphere_shift_sigmas[worst])
    return Verdict(
        LightGate.OUTLINES,
        (Criterion("largest shift, standard errors", found, limits.outline_sigmas),),
        f"the highlights put sphere {worst + 1}, counted from the left, {found:.1f} standard "
        "errors from where its outline is: use spheres of one radius, and see that none moves",
    )


def _highlights(arm: LightArm, limits: LightGateLimits) -> Verdict:
    seen = arm.residual_deg[np.isfinite(arm.residual_deg)]
    rms = float(np.sqrt(np.mean(seen**2)))
    over = float(np.sqrt(arm.inflation))
    return Verdict(
        LightGate.HIGHLIGHTS,
        (
            Criterion("RMS angle to the lamps, °", rms, limits.residual_deg),
            Criterion("RMS over noise, beyond chance", over, 1.0, refuses=False),
        ),
        f"highlights are off by {rms:.2f}° RMS, {over:.1f} times what noise explains: the arm sags "
        "in another way than the model's, has play, or a sphere was loose; tighten them and "
        "photograph again",
    )


def _suspect(arm: LightArm, limits: LightGateLimits) -> Verdict:
    seen = int(np.isfinite(arm.residual_deg).sum())
    places = ", ".join(
        f"{np.degrees(arm.poses[n].azimuth):.1f}°/{np.degrees(arm.poses[n].elevation):.1f}°"
        for n in arm.suspect
    )
    return Verdict(
        LightGate.SUSPECT,
        (
            Criterion("share of poses", len(arm.suspect) / max(seen, 1), limits.suspect_share),
            Criterion("poses", float(len(arm.suspect)), 0.0, refuses=False),
        ),
        f"the highlights at azimuth/elevation {places} are off by more than noise explains: look "
        "for other lights and reflections, and photograph these poses again",
    )


def _shading(arm: LightArm, limits: LightGateLimits) -> Verdict:
    found, name = arm.shading_misfit, "relative RMS error of radiance"
    return Verdict(
        LightGate.SHADING,
        (
            Criterion(f"{name}, to be used at all", found, limits.largest_shading_misfit),
            Criterion(name, found, limits.shading_misfit, refuses=False),
        ),
        f"the white target's radiance is off by {found:.1%} from what the lamps would give: is it "
        "matt, is the spheres' radius right, and was every other light out?",
    )


def _radius(arm: LightArm, radius_mm: float, limits: LightGateLimits) -> Verdict | Untested:
    off, sigma = abs(arm.radius_error), arm.radius_sigma
    beyond = max(off - _SIGMAS * sigma, 0.0)
    # What tells little may still contradict the radius outright, as other light on the target does.
    if not (sigma <= limits.radius_sigma or beyond > limits.radius_error):
        return Untested(
            LightGate.RADIUS, "the target's radiance tells too little; photograph more poses"
        )
    right = radius_mm * (1 + arm.radius_error)
    return Verdict(
        LightGate.RADIUS,
        (
            Criterion(
                "relative error beyond three standard errors",
                beyond,
                limits.radius_error,
            ),
            Criterion("over its standard error", off / sigma, _SIGMAS, refuses=False),
        ),
        f"how the light falls on the white target asks for spheres of {right:.2f} mm (standard "
        f"error {radius_mm * arm.radius_sigma:.2f} mm), not {radius_mm:g} mm: measure their "
        "diameter, of which the radius is half, and see that no other light falls on the target",
    )
