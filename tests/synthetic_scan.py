"""Made-up scans for the tests: plans of patterns, frames of known coordinates, range images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from acquisition.correspondence import AxisCoordinate, CorrespondenceMap, Rejection
from acquisition.patterns import Axis, Gray, PhaseShift, pattern_profile
from acquisition.plan import Crop, Imager, Plan, PlannedFrame
from calibration.lens import rt_from_matrix, transform
from fitting.range_image import RangeImage


def make_plan(
    patterns: list,
    *,
    width: int = 320,
    height: int = 240,
    projector: tuple[int, int] = (512, 320),
    saturation: int = 1023,
) -> Plan:
    return Plan(
        camera=Imager(width=width, height=height),
        projector=Imager(width=projector[0], height=projector[1]),
        crop=Crop(column=0, row=0, width=width, height=height),
        saturation_level=saturation,
        frames=tuple(PlannedFrame(id=f"{i:04d}", pattern=p) for i, p in enumerate(patterns)),
        source="test",
    )


def fringe_patterns(axis: Axis, *, period: float, steps: int, **extra: float) -> list[PhaseShift]:
    return [
        PhaseShift(axis=axis, period_px=period, shift_rad=2 * np.pi * k / steps, **extra)
        for k in range(steps)
    ]


def gray_patterns(axis: Axis, *, step: float, bits: int, inverse: bool = False) -> list[Gray]:
    return [Gray(axis=axis, bit=b, bits=bits, step_px=step, inverse=inverse) for b in range(bits)]


def expose(
    plan: Plan,
    coordinates: dict[Axis, np.ndarray],
    *,
    mean: float = 400.0,
    modulation: float = 300.0,
    sigma: float = 0.0,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Frames of a plan where each pixel sees the given projector coordinates."""
    random = np.random.default_rng(seed)
    frames = {}
    for frame in plan.frames:
        axis = getattr(frame.pattern, "axis", Axis.COLUMN)
        at = coordinates.get(axis, np.zeros((plan.crop.height, plan.crop.width)))
        level = mean + modulation * (2 * pattern_profile(frame.pattern, at) - 1)
        noisy = level + random.normal(0, sigma, level.shape) if sigma else level
        frames[frame.id] = np.clip(np.round(noisy), 0, 1023).astype(np.uint16)
    return frames


@dataclass(frozen=True)
class RangeScene:
    """A range image of a made-up surface, and where its points lie on it.

    ``x`` and ``y`` (mm) are in the surface's own frame, whose pose is ``rt_cam_surface``; ``z`` is
    the true height there.
    """

    image: RangeImage
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    rt_cam_surface: np.ndarray


def make_range_image(
    relief: Callable[[np.ndarray, np.ndarray], np.ndarray],
    *,
    tilt: tuple[float, float] = (0.04, -0.06),
    distance: float = 430.0,
    shape: tuple[int, int] = (192, 256),
    focal: float = 720.0,
    sigma: float = 0.02,
    seed: int = 0,
) -> RangeScene:
    """What a camera ranges of ``relief(x, y)``, in mm, NaN where there is nothing to see.

    The surface's frame is turned by ``tilt`` (radians about the picture's x and y) from facing the
    camera at a distance.
    """
    rows, cols = shape
    col, row = np.meshgrid(np.arange(float(cols)), np.arange(float(rows)))
    rays = np.stack([(col - cols / 2) / focal, (row - rows / 2) / focal, np.ones(shape)], axis=-1)
    facing = np.diag([1.0, -1.0, -1.0])
    matrix = cv2.Rodrigues(np.array([*tilt, 0.0]))[0] @ facing
    origin = np.array([0.0, 0.0, distance])
    pose = rt_from_matrix(matrix, origin)
    local_rays, eye = rays @ matrix, -origin @ matrix
    depth = _first_hit(relief, eye, local_rays)
    at = eye + depth[..., np.newaxis] * local_rays
    z = relief(at[..., 0], at[..., 1])
    seen = np.isfinite(z) & np.isfinite(depth)
    depth = np.where(seen, depth + np.random.default_rng(seed).normal(0, sigma, shape), np.nan)
    image = RangeImage(
        depth[..., np.newaxis] * rays,
        np.where(seen, max(sigma, 1e-4) ** 2, np.inf).astype(np.float32),
        np.where(seen, 0, int(Rejection.LOW_MODULATION)).astype(np.uint16),
        focal,
        0.0,
    )
    return RangeScene(image, at[..., 0], at[..., 1], z, pose)


def _first_hit(relief, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distance along rays to a relief between -25 and 25 mm, by marching, then bisection."""
    low, high = ((level - eye[2]) / rays[..., 2] for level in (25.0, -25.0))
    steps = np.linspace(0, 1, 51)

    def above(share):
        at = eye + (low + share * (high - low))[..., np.newaxis] * rays
        # Where there is nothing to see a ray goes on.
        return ~(at[..., 2] <= np.nan_to_num(relief(at[..., 0], at[..., 1]), nan=-30.0))

    before = np.zeros(low.shape)
    flying = np.ones(low.shape, bool)
    for share in steps[1:]:
        flying &= above(np.full(low.shape, share))
        before[flying] = share
    after = np.minimum(before + steps[1], 1.0)
    for _ in range(20):
        middle = 0.5 * (before + after)
        clear = above(middle)
        before, after = np.where(clear, middle, before), np.where(clear, after, middle)
    return np.where(flying, np.nan, low + before * (high - low))


def depth_of_scene(rays: np.ndarray, relief) -> np.ndarray:
    """Depth at which rays meet a tilted plane at 430 mm with ``relief(x, y)`` on it."""
    normal = np.array([0.06, -0.04, -1.0])
    depth = (normal @ [0, 0, 430.0]) / (rays @ normal)
    for _ in range(30):
        points = rays * depth[..., np.newaxis]
        depth = (normal @ [0, 0, 430.0] + relief(points[..., 0], points[..., 1])) / (rays @ normal)
    return depth


def correspond(rig, relief, *, sigma=0.05, seed=0, axes=tuple(Axis), shape=(240, 320)):
    """The correspondence map of a scene, with its true points."""
    col, row = np.meshgrid(np.arange(float(shape[1])), np.arange(float(shape[0])))
    rays = rig.camera.unproject(np.stack([col, row], axis=-1))
    points = rays * depth_of_scene(rays, relief)[..., np.newaxis]
    panel = rig.projector.project(transform(rig.rt_proj_cam, points))
    random = np.random.default_rng(seed)
    decoded = {}
    for axis in axes:
        at = panel[..., 0 if axis is Axis.COLUMN else 1] + random.normal(0, sigma, shape)
        variance = np.full(shape, max(sigma, 1e-4) ** 2, np.float32)
        modulation = np.full(shape, 100, np.float32)
        decoded[axis] = AxisCoordinate(at, variance, modulation, 32.0, 1.0)
    nothing = np.zeros(shape, np.uint16)
    ambient = np.full(shape, 100, np.float32)
    return CorrespondenceMap(decoded, ambient, nothing, (0, 0), 1.0), points


def bumps(x, y):
    return -1.5 * np.exp(-((x - 8) ** 2 + (y + 5) ** 2) / 40) + 0.3 * np.sin(x / 4)
