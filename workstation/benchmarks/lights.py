"""Light arms with known errors: what a camera sees of them, and how well they are found again.

Highlights are solved for as points of a sphere at which the normal halves the angle between camera
and lamp, outlines as tangents from the camera; where the lamp truly is comes from the simulated
arm, whose model is written independently of the calibration's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.light_poses import spread_poses
from calibration.lens import Lens, rt_from_matrix, transform
from calibration.light_arm import LightArm, SphereHighlights, TargetShading, fit_light_arm
from calibration.mirror_spheres import sphere_from_outline
from devices.interfaces import ArmLimits, ArmPose
from devices.simulated.arm_kinematics import ArmKinematics, Lamp
from workstation.benchmark_records import Record, Sense

LENS = Lens(
    "LENSMODEL_OPENCV5",
    np.array([4710.0, 4712, 1030, 762, -0.08, 0.05, 4e-4, -3e-4, 0.0]),
    2048,
    1536,
)
SPHERE_MM = 20.0
# The canvas faces the camera.
RT_CAM_SCENE = rt_from_matrix(np.diag([1.0, -1.0, -1.0]), np.array([12.0, -5.0, 900.0]))
_SPHERES = ((-140.0, 70.0, 20.0), (150.0, -80.0, 20.0))
_LIMITS = ArmLimits((0.0, np.radians(350)), (np.radians(15), np.radians(80)))
_EDGES = 240
_EDGE_SIGMA_PX = 0.15
_SPOT_SIGMA_PX = 0.15
_SHADING_SIGMA = 0.005
_ALBEDO = 0.95
_ROUNDS = 60
_BOUND_DEG = 0.1


@dataclass(frozen=True)
class SeenArm:
    """What is seen of an arm, and the truth.

    Attributes
    ----------
    poses : list of ArmPose
    highlights : list of SphereHighlights
    shading : TargetShading
    lamps : (poses, 3) float64 array
        True places in the camera's frame, mm.
    """

    poses: list[ArmPose]
    highlights: list[SphereHighlights]
    shading: TargetShading
    lamps: NDArray[np.float64]

    def fit(self) -> LightArm:
        """Calibrate the arm."""
        return fit_light_arm(self.poses, self.highlights, self.shading, LENS)


def random_arm(seed: int) -> tuple[ArmKinematics, Lamp]:
    """An arm with errors as large as those of a rig built by hand."""
    random = np.random.default_rng([seed, 0x41524D])
    angles = np.radians(random.normal(0, [0.5, 0.5, 0.5, 2.0, 1.0, 0.3]))
    arm = ArmKinematics(
        centre=tuple(random.normal(0, 6.0, 3)),
        radius=1170.0 + random.normal(0, 15.0),
        ring_tilt=(angles[0], angles[1]),
        arc_lean=angles[2],
        azimuth_zero=angles[3],
        elevation_zero=angles[4],
        sag=abs(angles[5]),
    )
    return arm, Lamp(exponent=6.0, aim_error=tuple(random.normal(0, 8.0, 3)))


def see_arm(
    *,
    seed: int = 0,
    poses: int = 24,
    anisotropy: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    extra_sag: Callable[[ArmPose], float] | None = None,
    incidence: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    noise: float = 1.0,
) -> SeenArm:
    """Simulate spheres and target under an arm.

    Parameters
    ----------
    seed : int
        Of arm and noise.
    poses : int
    anisotropy : callable, optional
        Light by the cosine from the lamp's axis, instead of its power.
    extra_sag : callable, optional
        What is added to the elevation at a pose, rad, that no model knows of.
    incidence : callable, optional
        Radiance of the target over a matt one's, by the cosine of the incidence.
    noise : float
        Multiple of the usual noise.
    """
    arm, lamp = random_arm(seed)
    random = np.random.default_rng([seed, 0x4C49])
    where = spread_poses(_LIMITS, poses)
    true = [
        ArmPose(pose.azimuth, pose.elevation + (extra_sag(pose) if extra_sag else 0.0))
        for pose in where
    ]
    in_scene = np.stack([arm.lamp_position(pose) for pose in true])
    lamps = transform(RT_CAM_SCENE, in_scene)
    axes = np.stack([lamp.axis(place, arm) for place in in_scene])
    highlights = []
    for place in transform(RT_CAM_SCENE, np.array(_SPHERES)):
        edges = outline_pixels(place) + random.normal(0, _EDGE_SIGMA_PX * noise, (_EDGES, 2))
        spots = highlight_pixels(place, lamps)
        spots = spots + random.normal(0, _SPOT_SIGMA_PX * noise, spots.shape)
        sphere = sphere_from_outline(edges, LENS, radius_mm=SPHERE_MM)
        highlights.append(SphereHighlights(sphere, spots, _SPOT_SIGMA_PX * noise))
    laws = anisotropy or (lambda cosine: cosine**lamp.exponent), incidence or np.ones_like
    shading = _shade(in_scene, axes, np.array(lamp.colour), laws, random, noise)
    return SeenArm(where, highlights, shading, lamps)


def outline_pixels(centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Edge (n, 2) of a sphere at a centre (3,) of the camera's frame."""
    distance = np.linalg.norm(centre)
    ahead = centre / distance
    across = np.linalg.svd(ahead[np.newaxis])[2][1:]
    sine = SPHERE_MM / distance
    turn = np.linspace(0, 2 * np.pi, _EDGES, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1) @ across
    return LENS.project(np.sqrt(1 - sine**2) * ahead + sine * around)


def highlight_pixels(
    centre: NDArray[np.float64], lamps: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where lamps (n, 3) are seen in a mirror sphere, (n, 2)."""
    points = np.tile(centre, (len(lamps), 1))
    for _ in range(_ROUNDS):
        half = _unit(-points) + _unit(lamps - points)
        points = centre + SPHERE_MM * _unit(half)
    return LENS.project(points)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _shade(
    lamps: NDArray[np.float64],
    axes: NDArray[np.float64],
    colour: NDArray[np.float64],
    laws: tuple[Callable[[NDArray[np.float64]], NDArray[np.float64]], ...],
    random: np.random.Generator,
    noise: float,
) -> TargetShading:
    x, y = np.meshgrid(np.linspace(-120, 120, 9), np.linspace(-90, 90, 7))
    points = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    away = lamps[:, np.newaxis] - points
    squared = np.sum(away**2, axis=-1)
    towards = away / np.sqrt(squared)[..., np.newaxis]
    cosine = np.maximum(-np.einsum("kni,ki->kn", towards, axes), 0)
    anisotropy, incidence = laws
    irradiance = anisotropy(cosine) / squared * towards[..., 2] * 1170.0**2
    irradiance = irradiance * incidence(towards[..., 2])
    radiance = irradiance[..., np.newaxis] * colour * _ALBEDO / np.pi
    sigma = _SHADING_SIGMA * noise * radiance + 1e-6
    return TargetShading(
        transform(RT_CAM_SCENE, points),
        np.array([0.0, 0.0, -1.0]),
        radiance + sigma * random.standard_normal(radiance.shape),
        sigma,
        _ALBEDO,
    )


def direction_errors(
    seen: SeenArm, arm: LightArm
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors of light directions at the canvas's middle.

    Returns
    -------
    degrees : (poses,) float64 array
    white : (poses, 2) float64 array
        Over the square root of their predicted covariance.
    """
    middle = RT_CAM_SCENE[3:]
    degrees, white = [], []
    for pose, place in zip(seen.poses, seen.lamps, strict=True):
        true, found = _unit(place - middle), arm.lamp(pose).directions(middle)
        across = np.linalg.svd(true[np.newaxis])[2][1:]
        covariance = across @ arm.direction_covariance(pose, middle) @ across.T
        error = across @ (found - true)
        degrees.append(np.degrees(np.linalg.norm(error)))
        white.append(np.linalg.solve(np.linalg.cholesky(covariance), error))
    return np.array(degrees), np.array(white)


def light_records(*, seeds: int = 20) -> list[Record]:
    """Error of light directions, and whether their predicted errors are right."""
    degrees, white = [], []
    for seed in range(seeds):
        seen = see_arm(seed=seed)
        errors, normal = direction_errors(seen, seen.fit())
        degrees.append(errors)
        white.append(normal)
    return [
        Record(
            name="lights.direction_deg",
            value=float(np.max(degrees)),
            unit="°",
            bound=_BOUND_DEG,
            sense=Sense.AT_MOST,
            runs=seeds,
            note=f"worst of all poses; median {np.median(degrees):.2g}; "
            f"{np.sum(np.max(degrees, axis=1) > _BOUND_DEG)} of {seeds} arms beyond the bound",
        ),
        Record(
            name="lights.direction_spread",
            value=float(np.sqrt(np.mean(np.square(white)))),
            unit="",
            bound=(0.9, 1.1),
            sense=Sense.WITHIN,
            runs=seeds,
            note="over poses and seeds",
        ),
    ]
