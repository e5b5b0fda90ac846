"""Changes that must not matter to registration and to the surface.

The rig's frame is that of the scan's camera. Turned by quarters, the whole pipeline can be run
again on turned pictures; turned by any angle and moved, the stages that take points can.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from calibration.code_pairs import CodePairs, pair_by_code
from calibration.lens import compose, invert, rotation, transform
from calibration.pose_fit import fit_pose
from calibration.registration import RegisteredView, register_view
from calibration.rig_geometry import CAMERA_FILE, PROJECTOR_FILE, RigGeometry
from devices.errors import ImpastoError
from fitting.canvas import extract_canvas
from fitting.height_field import HeightField
from fitting.range_image import RangeImage, triangulate
from fitting.resampling import resample_heights
from fitting.surface import reconstruct_surface
from workstation.benchmarks.analytic_scans import SIGMA_PX, scan_of, surface_rig
from workstation.benchmarks.invariances import (
    SIGMAS_OF_MANY,
    SINGLE,
    Invariance,
    rounding_sigma,
    threads,
)
from workstation.benchmarks.simulated_photographs import SIGMA_PX as CODE_SIGMA_PX
from workstation.benchmarks.simulated_photographs import VIEWS, photograph
from workstation.benchmarks.turned_cameras import (
    camera_turn,
    turned_lens,
    turned_map,
    turned_picture,
    turned_rig,
)

# All points of so small a picture take part in every plane that is fitted, whichever comes first.
_CAMERA_WIDTH = 240
# A pose's fit ends where a step promises 10⁻⁵ of the largest square that is no outlier, 16; two
# fits do, each on its own side.
_POSE_SETTLED = 2 * (1e-5 * 16) ** 0.5
# Of χ² with six degrees of freedom, a larger root comes once in a thousand times.
_UNLIKELY_POSE = 4.74
_UNLIKELY = 3.0
_STEEPEST = 2.0
_TURNS = 3


def registration_invariances() -> Iterator[Invariance]:
    """What must not matter to registering a photograph; deviations in standard errors."""
    rig = surface_rig(_CAMERA_WIDTH)
    scan = photograph(np.zeros(6), seed=0, lens=rig.camera, rig=rig)
    shot = photograph(VIEWS["left"], seed=1, lens=rig.camera, rig=rig)
    reference = register_view(shot, scan, rig)

    def changed(
        name: str, rt_cam_rig: NDArray[np.float64], tolerance: float = _POSE_SETTLED
    ) -> Invariance:
        return Invariance(f"register, {name}", _pose(rt_cam_rig, reference), tolerance, "σ")

    with threads(1):
        yield changed("one thread", register_view(shot, scan, rig).rt_cam_rig, 0.0)
    for quarters in (1, 2):
        turn = camera_turn(quarters)
        found = register_view(
            shot, turned_map(scan, quarters), turned_rig(rig, quarters), lens=rig.camera
        )
        name = f"turned by {90 * quarters}°"
        yield changed(f"scan's camera {name}", compose(found.rt_cam_rig, turn))
        lens = turned_lens(rig.camera, quarters)
        found = register_view(turned_map(shot, quarters), scan, rig, lens=lens)
        yield changed(f"photograph's camera {name}", compose(invert(turn), found.rt_cam_rig))
    for unit, name in ((1e-3, "metres"), (1e3, "micrometres")):
        pose = register_view(shot, scan, _scaled(rig, unit)).rt_cam_rig
        yield changed(f"rig in {name}", np.concatenate([pose[:3], pose[3:] / unit]))
    # As for corners: rounding adds noise, and the pose's error to it goes as to the code's.
    rounding = SIGMAS_OF_MANY * rounding_sigma(rig.projector.width) / CODE_SIGMA_PX
    single = register_view(_single(shot), _single(scan), rig)
    yield changed("code in single precision", single.rt_cam_rig, rounding)
    pairs = pair_by_code(shot, scan, rig)
    random = np.random.default_rng(0)
    for _ in range(_TURNS):
        order = random.permutation(len(pairs))
        yield changed(
            "pairs in another order", fit_pose(pairs.chosen(order), rig.camera).rt_cam_ref
        )
        moved = _anywhere(random)
        pose = fit_pose(_moved(pairs, moved), rig.camera).rt_cam_ref
        yield changed("rig's frame turned and moved at will", compose(pose, moved))
    yield _of_a_plane(rig)


def _pose(found: NDArray[np.float64], reference: RegisteredView) -> float:
    """By how much a pose is another one, in standard errors of all six numbers together."""
    if np.array_equal(found, reference.rt_cam_rig):
        return 0.0
    step = compose(found, invert(reference.rt_cam_rig))
    return float(np.linalg.norm(np.linalg.solve(np.linalg.cholesky(reference.covariance), step)))


def _anywhere(random: np.random.Generator) -> NDArray[np.float64]:
    """A turn about any axis by up to half a turn, and a metre in any direction."""
    axis = random.normal(size=3)
    turn = random.uniform(0, np.pi) * axis / np.linalg.norm(axis)
    return np.concatenate([turn, random.uniform(-1000, 1000, 3)])


def _moved(pairs: CodePairs, rt: NDArray[np.float64]) -> CodePairs:
    turn = rotation(rt)
    return replace(
        pairs, points=transform(rt, pairs.points), covariance=turn @ pairs.covariance @ turn.T
    )


def _of_a_plane(rig: RigGeometry) -> Invariance:
    """A plane, which looks nearly alike from two sides, is refused or its pose is right."""
    name = "register, a plane: error over the stated one"
    flat = [
        photograph(pose, seed=seed, lens=rig.camera, rig=rig, flat=True)
        for seed, pose in enumerate((np.zeros(6), VIEWS["left"]))
    ]
    try:
        found = register_view(flat[1], flat[0], rig)
    except ImpastoError:
        return Invariance(name, 0.0, _UNLIKELY_POSE, "σ")
    return Invariance(name, _pose(VIEWS["left"], found), _UNLIKELY_POSE, "σ")


def surface_invariances() -> Iterator[Invariance]:
    """What must not matter to the height field."""
    rig = surface_rig(_CAMERA_WIDTH)
    scan = scan_of(rig)
    surface = reconstruct_surface(scan, rig)
    reference = surface.copy.height_field
    allowed = _arithmetic_mm(reference)
    with threads(1):
        alone = reconstruct_surface(scan, rig).copy.height_field
    yield Invariance("surface, one thread", _millimetres(alone, reference), 0.0, "mm")
    for unit, name in ((1e-3, "metres"), (1e3, "micrometres")):
        field = reconstruct_surface(scan, _scaled(rig, unit)).copy.height_field
        deviation = _millimetres(_rescaled(field, 1 / unit), reference)
        yield Invariance(f"surface, rig in {name}", deviation, allowed, "mm")
    for quarters in (1, 2, 3):
        turned = turned_map(scan, quarters)
        field = reconstruct_surface(turned, turned_rig(rig, quarters)).copy.height_field
        deviation = _millimetres(_turned_back(field, quarters), reference)
        yield Invariance(f"surface, camera turned by {90 * quarters}°", deviation, allowed, "mm")
    range_image = triangulate(scan, rig)
    upright = resample_heights(range_image, extract_canvas(range_image))
    random = np.random.default_rng(0)
    for _ in range(_TURNS):
        # Depth, of which the variance is known, is along the axis about which this turns.
        turn = np.array([0, 0, random.uniform(-0.7, 0.7), 0, 0, 0])
        points = transform(turn, range_image.points)
        yield _of_turned_points(replace(range_image, points=points), turn, upright, allowed)
        # Files of a calibration may count from any frame: a board's, a first camera's.
        found = reconstruct_surface(scan, _filed(rig, _anywhere(random))).copy.height_field
        yield Invariance(
            "surface, calibration's frame turned and moved at will",
            _millimetres(found, reference),
            allowed,
            "mm",
        )
    field = reconstruct_surface(_single(scan), rig).copy.height_field
    # A texel is as sure of its height as the code's noise lets it be; see calibration.
    rounding = SIGMAS_OF_MANY * rounding_sigma(rig.projector.width) / SIGMA_PX
    sigma = float(np.sqrt(np.median(reference.variance[reference.mask])))
    yield Invariance(
        "surface, code in single precision",
        _millimetres(field, reference),
        rounding * sigma + allowed,
        "mm",
    )
    for share in (1e-1, 1e-3):
        yield _of_a_short_baseline(rig, share)


def _arithmetic_mm(field: HeightField) -> float:
    """What single precision leaves of heights that are found in another way.

    The canvas's X follows an edge of the hull of its points, which OpenCV has in single precision:
    it may turn by a rounding of half the canvas's size over the shortest such edge, a pitch. Away
    from the middle the relief is looked up elsewhere by that, and is as steep as the seed fill
    lets it be.
    """
    half = 0.5 * float(np.hypot(*field.size_mm))
    turn = SINGLE * half / field.pitch_mm
    return _STEEPEST * half * turn


def _filed(rig: RigGeometry, rt_cam_ref: NDArray[np.float64]) -> RigGeometry:
    """The rig as it is read from files that count from another frame; they have ten digits."""
    with TemporaryDirectory() as folder:
        place = Path(folder)
        rig.camera.save(place / CAMERA_FILE, rt_this_ref=rt_cam_ref)
        rt_proj_ref = compose(rig.rt_proj_cam, rt_cam_ref)
        rig.projector.save(place / PROJECTOR_FILE, rt_this_ref=rt_proj_ref)
        return RigGeometry.load(place)


def _of_turned_points(
    range_image: RangeImage,
    turn: NDArray[np.float64],
    upright: HeightField,
    allowed: float,
) -> Invariance:
    """The rig's frame turned about the camera's axis by any angle: heights and canvas follow."""
    canvas = extract_canvas(range_image)
    field = resample_heights(range_image, canvas)
    step = compose(invert(compose(turn, upright.rt_cam_canvas)), field.rt_cam_canvas)
    half = 0.5 * float(np.hypot(*field.size_mm))
    # What the pose of the canvas does at its corners counts as heights do.
    moved = float(np.linalg.norm(step[:3]) * half + np.linalg.norm(step[3:]))
    deviation = max(_millimetres(field, upright), moved)
    name = f"surface, rig's frame turned by {np.degrees(turn[2]):.1f}°"
    return Invariance(name, deviation, allowed, "mm")


def _of_a_short_baseline(rig: RigGeometry, share: float) -> Invariance:
    """A rig whose lenses stand close together refuses, or states errors that large."""
    narrow = replace(
        rig, rt_proj_cam=np.concatenate([rig.rt_proj_cam[:3], share * rig.rt_proj_cam[3:]])
    )
    try:
        field = reconstruct_surface(scan_of(narrow), narrow).copy.height_field
    except ImpastoError:
        stated = 0.0
    else:
        spread = np.nanstd(field.height[field.mask])
        stated = float(spread / np.sqrt(np.median(field.variance[field.mask])))
    baseline_mm = np.linalg.norm(narrow.rt_proj_cam[3:])
    name = f"surface, {baseline_mm:.2g} mm of baseline: height over its stated error"
    return Invariance(name, stated, _UNLIKELY, "")


def _scaled(rig: RigGeometry, factor: float) -> RigGeometry:
    """The rig in another unit of length."""
    pose = np.concatenate([rig.rt_proj_cam[:3], factor * rig.rt_proj_cam[3:]])
    return replace(rig, rt_proj_cam=pose)


def _rescaled(field: HeightField, factor: float) -> HeightField:
    return replace(field, height=factor * field.height)


def _turned_back(field: HeightField, quarters: int) -> HeightField:
    """X and Y follow the picture: what a turned camera sees lies turned on the canvas."""
    return replace(
        field,
        height=turned_picture(field.height, -quarters),
        mask=turned_picture(field.mask, -quarters),
        variance=turned_picture(field.variance, -quarters),
    )


def _single(correspondence: CorrespondenceMap) -> CorrespondenceMap:
    """The code's coordinates in single precision."""
    axes = {
        axis: replace(decoded, coordinate=decoded.coordinate.astype(np.float32))
        for axis, decoded in correspondence.axes.items()
    }
    return replace(correspondence, axes=axes)


def _millimetres(found: HeightField, reference: HeightField) -> float:
    if found.shape != reference.shape:
        return np.inf
    both = found.mask & reference.mask
    if both.sum() < 0.999 * max(found.mask.sum(), reference.mask.sum()):
        return np.inf
    return float(np.abs(found.height - reference.height)[both].max())
