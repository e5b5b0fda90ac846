"""From recorded photographs of mirror spheres and a white target to a calibrated light arm."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquisition.decoding import decode
from acquisition.plan import Purpose
from acquisition.session import Session
from calibration.arm_fit import SphereHighlights
from calibration.arm_geometry import initial_arm
from calibration.arm_photographs import ArmPhotographs
from calibration.errors import CalibrationError, CalibrationRefusedError
from calibration.flat_field import FlatField, vignetting_of
from calibration.light_arm import LightArm, fit_light_arm
from calibration.light_gates import check_distance, check_lights
from calibration.rig_geometry import RigGeometry
from calibration.sphere_search import Circle, FoundSphere, find_spheres, sphere_highlights
from calibration.target_shading import TargetShading
from calibration.triangulation import reconstruct_points
from calibration.verdicts import GateReport
from calibration.white_target import WhiteTarget, find_white_target, target_shading
from devices.bayer import BayerPattern
from devices.interfaces import ArmPose
from fitting.reflectance.lamp_table import LampTable
from workstation.interruption import interruption_held
from workstation.report_sections import LightSection


@dataclass(frozen=True, kw_only=True)
class LightOptions:
    """What is known of spheres and target.

    Attributes
    ----------
    sphere_mm : float
        Radius of the mirror spheres.
    spheres_px : tuple of (column, row, radius)
        Where they are in the pictures; by default they are looked for.
    target_px : (float, float) or None
        Column and row of a pixel on the white target; by default the picture's middle.
    albedo : float
        Of the white target; 1 makes it the white that all radiance is relative to.
    mosaic : BayerPattern or None
        Order of the sensor's colours; by default what the sessions say, and monochrome where they
        do not.
    place : str or None
        Of the camera: that of the rig's calibration; by default the first of each session.
    """

    sphere_mm: float
    spheres_px: tuple[Circle, ...] = ()
    target_px: tuple[float, float] | None = None
    albedo: float = 1.0
    mosaic: BayerPattern | None = None
    place: str | None = None

    def __post_init__(self) -> None:
        if not 0 < self.sphere_mm < np.inf:
            raise CalibrationError(f"a sphere has a positive radius, not {self.sphere_mm} mm")
        if not 0 < self.albedo <= 1:
            raise CalibrationError(f"a white target reflects 0 to 1, not {self.albedo}")


@dataclass(frozen=True)
class CalibratedLights:
    """A calibrated light arm with what it was calibrated by.

    Attributes
    ----------
    arm : LightArm
    spheres : tuple of FoundSphere
    target : WhiteTarget
    flat_field : FlatField
        The camera's vignetting, as the target shows it.
    white : ArmPhotographs
        Photographs of the target.
    digests : dict of str to str
        Of the sessions, by name.
    """

    arm: LightArm
    spheres: tuple[FoundSphere, ...]
    target: WhiteTarget
    flat_field: FlatField
    white: ArmPhotographs
    digests: dict[str, str]

    @property
    def target_middle(self) -> NDArray[np.float64]:
        """Middle (3,) of the white target in the rig's frame, mm."""
        return np.asarray(self.target.points.mean(axis=0))

    def table(self, poses: Iterable[ArmPose] = ()) -> LampTable:
        """The lamp at the poses of the calibration and at others.

        Parameters
        ----------
        poses : iterable of ArmPose
            Those of other photographs.
        """
        every = dict.fromkeys([*self.arm.poses, *poses])
        return LampTable.of(self.arm, every, flat_field=self.flat_field)

    def direction_sigma_deg(self) -> NDArray[np.float64]:
        """Standard error (poses,) of the direction from the target's middle."""
        middle = self.target_middle
        return np.array([self.arm.direction_sigma_deg(pose, middle) for pose in self.arm.poses])

    def direction_error_deg(self) -> float:
        """Median angle by which directions from the target's middle are predicted to err.

        Of two coordinates across a direction, each normal, the length is Rayleigh's, whose median
        is √(2 ln 2) standard errors.
        """
        middle = self.target_middle
        traces = [np.trace(self.arm.direction_covariance(p, middle)) for p in self.arm.poses]
        return float(np.degrees(np.sqrt(np.log(2) * np.median(traces))))

    @property
    def gates(self) -> GateReport:
        """What it must show before anything is lit by it."""
        return check_lights(
            self.arm,
            [one.sphere for one in self.spheres],
            target_middle=self.target_middle,
            target_normal=self.target.normal,
        )

    def section(self) -> LightSection:
        """For the report: positions about the target's middle, z along its normal."""
        arm = self.arm
        up = self.target.normal
        across = np.cross([0.0, 1.0, 0.0], up)
        across = across / np.linalg.norm(across)
        frame = np.stack([-across, np.cross(up, -across), up])
        places = arm.parameters.positions(arm.poses) - self.target_middle
        return LightSection(
            names=tuple(
                f"{np.degrees(p.azimuth):.1f}°, {np.degrees(p.elevation):.1f}°" for p in arm.poses
            ),
            position_mm=places @ frame.T,
            residual_deg=arm.residual_deg,
            sigma_deg=self.direction_sigma_deg(),
        )

    def figures(self) -> dict[str, Any]:
        """Plain numbers."""
        arm = self.arm
        residuals = arm.residual_deg[np.isfinite(arm.residual_deg)]
        sigma = self.direction_sigma_deg()
        return {
            **self.gates.figures(),
            "poses": len(arm.poses),
            "spheres": [
                {
                    "column": one.circle[0],
                    "row": one.circle[1],
                    "radius_px": one.circle[2],
                    "centre_mm": one.sphere.centre.tolist(),
                    "before_target_mm": float(
                        (one.sphere.centre - self.target_middle) @ self.target.normal
                    ),
                    "outline_px": one.sphere.outline_px,
                }
                for one in self.spheres
            ],
            "target_blocks": len(self.target.points),
            "target_flatness_mm": self.target.flatness_mm,
            "residual_deg_rms": float(np.sqrt(np.mean(residuals**2))),
            "direction_sigma_deg_median": float(np.median(sigma)),
            "direction_sigma_deg_largest": float(sigma.max()),
            "direction_error_deg_median": self.direction_error_deg(),
            "suspect": [
                [float(np.degrees(a)) for a in (arm.poses[n].azimuth, arm.poses[n].elevation)]
                for n in arm.suspect
            ],
            "inflation": arm.inflation,
            "shading_excess": arm.shading_excess,
            "shading_misfit": arm.shading_misfit,
            "target_is_matt": arm.matt,
            "placed_by_highlights": arm.placed_by_highlights,
            "sphere_radius_error": arm.radius_error,
            "sphere_radius_sigma": arm.radius_sigma,
            "radius_mm": arm.parameters.radius_mm,
            "exponent": arm.parameters.exponent,
            "vignetting": self.flat_field.coefficients.tolist(),
            "sessions": self.digests,
        }


def calibrate_lights(
    rig: RigGeometry,
    spheres: Path,
    white: Path | None = None,
    *,
    options: LightOptions,
    begin: Callable[[str], None] = lambda stage: None,
) -> CalibratedLights:
    """Calibrate a light arm from photographs recorded by ``impasto photograph``.

    Parameters
    ----------
    rig : RigGeometry
        Calibration of camera and projector; the camera is where it was then.
    spheres : Path
        Session of two mirror spheres or more, before something bright.
    white : Path, optional
        Session of a flat white target where paintings will stand; by default it stands between the
        spheres, in the same session.
    options : LightOptions
    begin : callable, optional
        Called with the name of each stage as it starts.

    Raises
    ------
    CalibrationError
        Spheres or target are not found, or do not determine the arm.
    CalibrationRefusedError
        They do not since the spheres are not beside the target: their radius is wrong.
    SessionError
        A session is damaged.
    """
    together = white is None or Path(white).resolve() == Path(spheres).resolve()
    begin("finding the spheres")
    balls = _photographs(Path(spheres), rig, options)
    with interruption_held():
        found = find_spheres(
            balls, rig.camera, radius_mm=options.sphere_mm, near=options.spheres_px
        )
        highlights = sphere_highlights(balls, found)
    begin("reading the white target")
    target_photos = balls if together or white is None else _photographs(white, rig, options)
    with interruption_held():
        target = _target(target_photos, rig, options, found if together else [])
        shading = target_shading(
            target_photos,
            target,
            towards_lamp=_rough_directions(balls, highlights, rig, target, target_photos.poses),
            albedo=options.albedo,
        )
    begin("fitting the light arm")
    poses = balls.poses
    if not together:
        poses, highlights, shading = _joined(balls.poses, target_photos.poses, highlights, shading)
    try:
        arm = fit_light_arm(poses, highlights, shading, rig.camera)
    except CalibrationError as error:
        beside = check_distance(
            [one.sphere for one in found], target.points.mean(axis=0), target.normal
        )
        if beside.passed:
            raise
        raise CalibrationRefusedError(f"{error}. {beside.gate}: {beside.remedy}") from error
    arm, flat_field = _without_vignetting(arm, target, rig)
    digests = {p.session.path.name: p.session.digest for p in (balls, target_photos)}
    return CalibratedLights(arm, tuple(found), target, flat_field, target_photos, digests)


def _photographs(path: Path, rig: RigGeometry, options: LightOptions) -> ArmPhotographs:
    session = Session.open(path)
    for name, lens, imager in (
        ("camera", rig.camera, session.plan.camera),
        ("projector", rig.projector, session.plan.projector),
    ):
        if (lens.width, lens.height) != (imager.width, imager.height):
            raise CalibrationError(
                f"{path} was recorded with a {name} of {imager.width}×{imager.height} pixels, and "
                f"the rig was calibrated at {lens.width}×{lens.height}"
            )
    with interruption_held():
        return ArmPhotographs.of(session, place=options.place, mosaic=options.mosaic)


def _target(
    photographs: ArmPhotographs, rig: RigGeometry, options: LightOptions, spheres: list[FoundSphere]
) -> WhiteTarget:
    session = photographs.session
    plan = session.plan_of(Purpose.CODE, camera_position=photographs.place)
    points, _ = reconstruct_points(decode(plan, session.read_frame), rig)
    return find_white_target(
        points,
        rig.camera,
        origin=photographs.origin,
        seed=options.target_px,
        spheres=[one.circle for one in spheres],
    )


def _rough_directions(
    balls: ArmPhotographs,
    highlights: list[SphereHighlights],
    rig: RigGeometry,
    target: WhiteTarget,
    poses: tuple[ArmPose, ...],
) -> NDArray[np.float64]:
    """Directions from the target to the lamp by an arm without errors, good to a few degrees."""
    middle = target.points.mean(axis=0)
    spots = [one.sphere.reflect(rig.camera.unproject(one.pixels)) for one in highlights]
    arm = initial_arm(balls.poses, spots, level=np.ones(3), target=middle)
    towards = arm.positions(poses) - middle
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))


def _joined(
    of_spheres: tuple[ArmPose, ...],
    of_target: tuple[ArmPose, ...],
    highlights: list[SphereHighlights],
    shading: TargetShading,
) -> tuple[tuple[ArmPose, ...], list[SphereHighlights], TargetShading]:
    """Observations of two sessions under the poses of both."""
    unseen = np.full((len(of_target), 2), np.nan)
    dark = np.full((len(of_spheres), *shading.radiance.shape[1:]), np.nan)
    return (
        (*of_spheres, *of_target),
        [replace(one, pixels=np.concatenate([one.pixels, unseen])) for one in highlights],
        replace(
            shading,
            radiance=np.concatenate([dark, shading.radiance]),
            sigma=np.concatenate([dark, shading.sigma]),
        ),
    )


def _without_vignetting(
    arm: LightArm, target: WhiteTarget, rig: RigGeometry
) -> tuple[LightArm, FlatField]:
    """The arm, its intensity as of radiance that is freed of the vignetting, and the vignetting."""
    assert arm.target_gains is not None  # targets from photographs have gains that are fitted
    lens = rig.camera
    field = vignetting_of(
        target.pixels,
        arm.target_gains,
        centre=lens.intrinsics[2:4],
        width=lens.width,
        height=lens.height,
    )
    level = float(np.median(arm.target_gains / field.gain(target.pixels)))
    intensity = arm.parameters.intensity * level
    return replace(arm, parameters=replace(arm.parameters, intensity=intensity)), field
