"""Changes that must not matter to calibration: of camera and projector, and of the light arm.

Deviations are in standard errors of what is calibrated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from acquisition.plan import Imager
from calibration.arm_fit import INTENSITY
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.gates import check_calibration
from calibration.lens import rotation, transform
from calibration.light_arm import LightArm, SphereHighlights, fit_light_arm
from calibration.mirror_spheres import MirrorSphere
from calibration.procam import ProcamCalibration, ProcamOptions, calibrate_procam
from calibration.rig_geometry import RigGeometry
from devices.errors import ImpastoError
from workstation.benchmarks.degenerate_boards import calibrated, good_boards
from workstation.benchmarks.invariances import (
    SIGMAS_OF_MANY,
    Invariance,
    rounding_sigma,
    threads,
)
from workstation.benchmarks.lights import LENS, RT_CAM_SCENE, SeenArm, see_arm
from workstation.benchmarks.simulated_boards import (
    BOARD,
    CAMERA,
    NOISE_PX,
    PROJECTOR,
    simulate_boards,
    true_rig,
)
from workstation.benchmarks.turned_cameras import (
    camera_turn,
    turned_lens,
    turned_pixels,
    turned_rig,
)

# mrcal goes on until a step is 10⁻⁸ of the numbers that it solves for, which are scaled so that
# they are about one; their standard errors are 10⁻⁴ of that and more.
_SOLVED = 1e-3
# The arm's fit ends where a step would be 0.02 standard errors; two fits do, each on its own side.
_ARM_SETTLED = 2 * 0.02
_NEARLY_PARALLEL = 0.02
# Of the standardised errors of some twenty numbers, a larger one comes once in a thousand times.
_UNLIKELY = 4.2
_ARM_POSES = 16
_ARM_SEED = 0


def calibration_invariances() -> Iterator[Invariance]:
    """What must not matter to calibrating camera and projector."""
    views = good_boards()
    reference = calibrated(views)

    def changed(name: str, found: RigGeometry, tolerance: float = _SOLVED) -> Invariance:
        return _rig(f"calibrate, {name}", found, reference, tolerance)

    yield changed("poses in another order", _solved(views[::-1]).rig)
    yield changed("boards turned by 180°", _solved([view.turned() for view in views]).rig)
    with threads(1):
        yield changed("one thread", _solved(views).rig, 0.0)
    for unit, name in ((1e-3, "metres"), (1e3, "micrometres")):
        board = replace(BOARD, square_mm=unit * BOARD.square_mm)
        yield changed(f"squares in {name}", _scaled(_solved(views, board=board).rig, 1 / unit))
    lens = reference.rig.camera
    for quarters in (1, 2):
        turned = [
            replace(view, pixels=(turned_pixels(view.pixels[0], lens, quarters), view.pixels[1]))
            for view in views
        ]
        camera = Imager(width=CAMERA.height, height=CAMERA.width) if quarters % 2 else CAMERA
        found = turned_rig(_solved(turned, camera=camera).rig, -quarters)
        yield changed(f"camera turned by {90 * quarters}°", found)
    single = [
        replace(view, pixels=tuple(p.astype(np.float32) for p in view.pixels)) for view in views
    ]
    # A solution is as sure of its numbers as the corners' noise lets it be, and what rounding adds
    # is to that as its deviation is to the noise.
    rounding = SIGMAS_OF_MANY * rounding_sigma(max(CAMERA.width, PROJECTOR.width)) / NOISE_PX
    yield changed("corners in single precision", _solved(single).rig, rounding)
    yield _of_nearly_parallel_boards()


def _solved(
    views: list[BoardView], *, board: Chessboard = BOARD, camera: Imager = CAMERA
) -> ProcamCalibration:
    options = ProcamOptions(models=("LENSMODEL_OPENCV4",))
    return calibrate_procam(views, board, camera=camera, projector=PROJECTOR, options=options)


def _scaled(rig: RigGeometry, factor: float) -> RigGeometry:
    """The rig in another unit of length."""
    pose = np.concatenate([rig.rt_proj_cam[:3], factor * rig.rt_proj_cam[3:]])
    return replace(rig, rt_proj_cam=pose)


def _rig(
    name: str, found: RigGeometry, reference: ProcamCalibration, tolerance: float
) -> Invariance:
    off = found.parameters - reference.rig.parameters
    sigmas = np.sqrt(np.diagonal(reference.covariance().covariance))
    return Invariance(name, float(np.max(np.abs(off) / sigmas)), tolerance, "σ")


def _of_nearly_parallel_boards() -> Invariance:
    """Boards that all but face the same way are refused, or the stated errors are that large."""
    name = "calibrate, nearly parallel boards: error over the stated one"
    views = simulate_boards(9, seed=1, tilt=_NEARLY_PARALLEL).views
    try:
        found = _solved(list(views))
    except ImpastoError:
        return Invariance(name, 0.0, _UNLIKELY, "σ")
    if not check_calibration(found).passed:
        return Invariance(name, 0.0, _UNLIKELY, "σ")
    camera, projector = true_rig()
    true = [
        *(m[i, j] for m in (camera.matrix,) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))),
        *camera.distortion,
        *(m[i, j] for m in (projector.matrix,) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))),
        *projector.distortion,
        *projector.rt_lens_ref,
    ]
    sigmas = np.sqrt(np.diagonal(found.covariance().covariance))
    return Invariance(
        name, float(np.max(np.abs(found.rig.parameters - true) / sigmas)), _UNLIKELY, "σ"
    )


def light_arm_invariances() -> Iterator[Invariance]:
    """What must not matter to calibrating a light arm."""
    seen = see_arm(seed=_ARM_SEED, poses=_ARM_POSES)
    reference = seen.fit()
    poses, highlights, shading = seen.poses, seen.highlights, seen.shading

    def changed(
        name: str, found: LightArm, *, quarters: int = 0, unit: float = 1.0, light: float = 1.0
    ) -> Invariance:
        deviation = _lamps(found, reference, seen, quarters=quarters, unit=unit, light=light)
        return Invariance(f"light arm, {name}", deviation, _ARM_SETTLED, "σ")

    order = np.random.default_rng(0).permutation(len(poses))
    yield changed(
        "poses in another order",
        fit_light_arm(
            [poses[i] for i in order],
            [replace(one, pixels=one.pixels[order]) for one in highlights[::-1]],
            replace(shading, radiance=shading.radiance[order], sigma=shading.sigma[order]),
            LENS,
        ),
    )
    for factor in (1e-6, 1e6):
        bright = replace(shading, radiance=factor * shading.radiance, sigma=factor * shading.sigma)
        found = fit_light_arm(poses, highlights, bright, LENS)
        yield changed(f"light × {factor:g}", found, light=factor)
    for unit, name in ((1e-3, "metres"), (1e3, "micrometres")):
        found = fit_light_arm(
            poses,
            [replace(one, sphere=_scaled_sphere(one.sphere, unit)) for one in highlights],
            replace(shading, points=unit * shading.points),
            LENS,
        )
        yield changed(f"lengths in {name}", found, unit=unit)
    for quarters in (1, 2):
        turn = rotation(camera_turn(quarters))
        found = fit_light_arm(
            poses,
            [_turned(one, quarters) for one in highlights],
            replace(shading, points=shading.points @ turn.T, normal=turn @ shading.normal),
            turned_lens(LENS, quarters),
        )
        yield changed(f"camera turned by {90 * quarters}°", found, quarters=quarters)
    found = fit_light_arm(
        poses,
        [replace(one, pixels=one.pixels.astype(np.float32)) for one in highlights],
        replace(
            shading,
            radiance=shading.radiance.astype(np.float32),
            sigma=shading.sigma.astype(np.float32),
        ),
        LENS,
    )
    yield changed("highlights and radiance in single precision", found)


def _scaled_sphere(sphere: MirrorSphere, unit: float) -> MirrorSphere:
    return replace(
        sphere,
        centre=unit * sphere.centre,
        radius_mm=unit * sphere.radius_mm,
        covariance=unit**2 * sphere.covariance,
    )


def _turned(one: SphereHighlights, quarters: int) -> SphereHighlights:
    turn = rotation(camera_turn(quarters))
    covariance = turn @ one.sphere.covariance @ turn.T
    sphere = replace(one.sphere, centre=turn @ one.sphere.centre, covariance=covariance)
    return replace(one, sphere=sphere, pixels=turned_pixels(one.pixels, LENS, quarters))


def _lamps(
    found: LightArm,
    reference: LightArm,
    seen: SeenArm,
    *,
    quarters: int,
    unit: float,
    light: float,
) -> float:
    """Largest change of the lamps' directions from the canvas's middle, and of their intensity."""
    middle = transform(RT_CAM_SCENE, np.zeros(3))
    intensity_sigmas = np.sqrt(np.diagonal(reference.covariance)[INTENSITY])
    back = rotation(camera_turn(quarters)).T
    worst = 0.0
    for pose in seen.poses:
        expected, lamp = reference.lamp(pose), found.lamp(pose)
        sigma = np.radians(reference.direction_sigma_deg(pose, middle))
        place = back @ lamp.position / unit
        worst = max(worst, _angle(place - middle, expected.position - middle) / sigma)
        # Irradiance goes with the square of the distance.
        brighter = np.log(lamp.intensity / (light * unit**2) / expected.intensity)
        worst = max(worst, float(np.max(np.abs(brighter) / intensity_sigmas)))
    return worst


def _angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    across = np.linalg.norm(np.cross(a, b))
    return float(np.arctan2(across, a @ b))
