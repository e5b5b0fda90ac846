"""Changes that must not matter to reflectance and to pictures of a copy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.lens import rotation
from fitting.digital_copy import DigitalCopy, ReflectanceMaps
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.solver import TexelFits, fit_texels
from fitting.relief_classification import classify_relief
from fitting.surface import reconstruct_surface
from render.opengl import pyrender
from render.painter import Light, Painter, RenderedImage, painting_scene
from render.painting_maps import PaintingMaterial
from render.painting_node import Mode, painting_mesh
from render.painting_renderer import RoomLight
from render.views import NamedView, View, named_view
from workstation.benchmarks.analytic_scans import scan_of, surface_rig
from workstation.benchmarks.invariances import SINGLE, Invariance, threads
from workstation.benchmarks.paint_samples import glossy_finishes, paint_samples

_TEXELS, _SAMPLES = 200, 48
# A descent ends where the cost falls by less than 10⁻⁵ of itself; amplitudes, whose share of it is
# quadratic, may be off by the root of that, and two descents each on its own side.
_DESCENT = 2 * 1e-5**0.5
_WIDTH, _HEIGHT = 160, 120
_CAMERA_WIDTH = 160
_SHIFT_MM = 1000.0
# Roundings between a vertex and its pixel: two matrices, each of four products and sums.
_ROUNDINGS = 16
# Of pixels: on a silhouette a sample may fall to the other side.
_SILHOUETTES = 1e-3


def reflectance_invariances() -> Iterator[Invariance]:
    """What must not matter to the fit of texels, relative to cost or ρ_d; see :func:`_fit`."""
    random = np.random.default_rng(2)
    finishes = glossy_finishes(_TEXELS, random)
    samples = paint_samples(finishes, _TEXELS, _SAMPLES, seed=3)
    reference = fit_texels(samples)
    order = random.permutation(_TEXELS)
    inverse = np.argsort(order)
    shuffled = fit_texels(samples.take(order))
    cost, diffuse = shuffled.cost[inverse], shuffled.lobes.diffuse[inverse]
    yield _fit("texels in another order", cost, diffuse, reference, 1e-12)
    places = random.permutation(_SAMPLES)
    found = fit_texels(_samples(samples, lambda array: array[:, places]))
    yield _fit("samples in another order", found.cost, found.lobes.diffuse, reference, _DESCENT)
    with threads(1):
        found = fit_texels(samples)
    yield _fit("one thread", found.cost, found.lobes.diffuse, reference, 0.0)
    for factor in (1e-6, 1e6):
        scaled = replace(
            samples, radiance=samples.radiance * factor, variance=samples.variance * factor**2
        )
        found = fit_texels(scaled)
        diffuse = found.lobes.diffuse / factor
        yield _fit(f"light × {factor:g}", found.cost, diffuse, reference, _DESCENT)
    for degrees in (37.0, 90.0, 180.0):
        found = fit_texels(_turned(samples, np.radians(degrees)))
        name = f"canvas's axes turned by {degrees:g}°"
        yield _fit(name, found.cost, found.lobes.diffuse, reference, _DESCENT)
    double = _samples(samples, lambda array: array.astype(np.float64))
    found = fit_texels(double)
    yield _fit("double precision", found.cost, found.lobes.diffuse, reference, 0.0)
    yield _of_too_few_samples(samples)


def _samples(
    samples: RadianceSamples, change: Callable[[NDArray[np.float32]], NDArray[np.float32]]
) -> RadianceSamples:
    names = ("view", "light", "radiance", "variance", "weight")
    return RadianceSamples(*(change(getattr(samples, name)) for name in names))


def _turned(samples: RadianceSamples, angle: float) -> RadianceSamples:
    """Directions in axes turned about the normals, which lobes of C_x = C_y do not tell."""
    turn = rotation(np.array([0, 0, angle, 0, 0, 0])).T
    view, light = (array.astype(np.float64) @ turn for array in (samples.view, samples.light))
    return replace(samples, view=view.astype(np.float32), light=light.astype(np.float32))


def _of_too_few_samples(samples: RadianceSamples) -> Invariance:
    """Of one photograph nothing is told of the highlight, and this is said of every texel."""
    one = samples.masked(np.arange(_SAMPLES) == 0)
    found = fit_texels(one)
    said = TexelFlag.DIFFUSE | TexelFlag.UNOBSERVED | TexelFlag.LOBE_FROM_PRIOR
    said |= TexelFlag.NO_SAMPLES | TexelFlag.DARK
    silent = (found.flags & int(said)) == 0
    finite = all(
        np.isfinite(array).all()
        for array in (found.lobes.shape, found.lobes.diffuse, found.lobes.specular)
    )
    deviation = float(silent.sum()) if finite else np.inf
    return Invariance("reflectance, one photograph: texels without a remark", deviation, 0.0, "")


def _fit(
    name: str,
    cost: NDArray[np.float64],
    diffuse: NDArray[np.float64],
    reference: TexelFits,
    tolerance: float,
) -> Invariance:
    """Compare cost and ρ_d with the reference's, the 99th percentile of the texels.

    A texel with two minima of nearly one depth may end in the other: the cost then hardly differs.
    """
    if not (np.isfinite(cost).all() and np.isfinite(diffuse).all()):
        return Invariance(f"reflectance, {name}", np.inf, tolerance, "")
    by_cost = np.abs(cost / reference.cost - 1)
    by_diffuse = np.abs(diffuse - reference.lobes.diffuse).max(axis=1)
    by_diffuse /= np.abs(reference.lobes.diffuse).max(axis=1) + 1e-12
    deviation = float(np.quantile(np.minimum(by_cost, by_diffuse), 0.99))
    return Invariance(f"reflectance, {name}", deviation, tolerance, "")


def render_invariances() -> Iterator[Invariance]:
    """What must not matter to a picture, in every mode; deviations in radiance.

    Places of samples are off by the roundings of their coordinates, over what a pixel covers, and
    radiance by no more than that share of the brightest.
    """
    copy = _small_copy()
    view = named_view(copy, NamedView.INSHOT_GRAZING, aspect=_WIDTH / _HEIGHT)
    random = np.random.default_rng(0)
    with Painter() as painter:
        for mode in Mode:
            reference = _painted(painter, copy, view, mode)
            scene = _moved_scene(copy, view, mode, _anywhere(random))
            moved = painter.paint_scene(scene, width=_WIDTH, height=_HEIGHT)
            footprint_mm = 2 * view.distance_mm * np.tan(0.5 * view.field_of_view) / _HEIGHT
            reach = _SHIFT_MM + view.distance_mm
            allowed = _ROUNDINGS * SINGLE * reach / footprint_mm * float(reference.radiance.max())
            name = f"render, {mode}"
            yield _picture(f"{name}, all of the scene moved", moved, reference, allowed)
            for unit, said in ((1e-3, "metres"), (1e3, "micrometres")):
                scaled_view = replace(view, distance_mm=unit * view.distance_mm)
                scaled = _painted(painter, _scaled(copy, unit), scaled_view, mode)
                yield _picture(f"{name}, lengths in {said}", scaled, reference, allowed)
            for factor in (2.0**-20, 2.0**20):
                # Powers of two, by which nothing is rounded.
                usual = Light()
                light = replace(
                    usual, strength=factor * usual.strength, ambient=factor * usual.ambient
                )
                bright = _painted(painter, copy, view, mode, light)
                seen = reference.coverage == 1
                off = np.abs(bright.radiance / np.float32(factor) - reference.radiance)[seen]
                yield Invariance(f"{name}, light × {factor:.2g}", float(off.max()), 0.0, "")
        yield from _of_shadows(painter, copy, view)
        yield from _of_a_flat_copy(painter, copy, view)


def _small_copy() -> DigitalCopy:
    rig = surface_rig(_CAMERA_WIDTH)
    copy = reconstruct_surface(scan_of(rig), rig).copy
    shape = copy.height_field.shape
    random = np.random.default_rng(0)
    diffuse, specular = (random.uniform(0.05, 0.25, (*shape, 3)).astype(np.float32) for _ in "ds")
    lobe = np.broadcast_to(np.array([-1.0, -1.0, 1.1, 20.0], np.float32), (*shape, 4))
    return replace(copy, reflectance=ReflectanceMaps(diffuse, specular, lobe.copy()))


def _painted(
    painter: Painter, copy: DigitalCopy, view: View, mode: Mode, light: Light | None = None
) -> RenderedImage:
    return painter.paint(copy, view, mode=mode, width=_WIDTH, height=_HEIGHT, light=light)


def _anywhere(random: np.random.Generator) -> NDArray[np.float64]:
    """A turn (4, 4) about any axis, and a metre in any direction."""
    axis = random.normal(size=3)
    turn = random.uniform(0, np.pi) * axis / np.linalg.norm(axis)
    pose = np.eye(4)
    pose[:3, :3] = rotation(np.concatenate([turn, np.zeros(3)]))
    shift = random.normal(size=3)
    pose[:3, 3] = _SHIFT_MM * shift / np.linalg.norm(shift)
    return pose


def _moved_scene(
    copy: DigitalCopy, view: View, mode: Mode, move: NDArray[np.float64]
) -> pyrender.Scene:
    """Painting, camera and lamp, all moved alike."""
    mesh = painting_mesh(copy, mode, material=PaintingMaterial(copy))
    scene = painting_scene(copy, mesh, view, Light(), _WIDTH / _HEIGHT)
    for node in list(scene.nodes):
        scene.set_pose(node, move @ scene.get_pose(node))
    return scene


def _scaled(copy: DigitalCopy, unit: float) -> DigitalCopy:
    """The copy in another unit of length."""
    field, relief = copy.height_field, copy.relief
    single = np.float32(unit)
    boxes = replace(relief.boxes, h_max=single * relief.boxes.h_max)
    return replace(
        copy,
        height_field=replace(
            field,
            height=single * field.height,
            variance=single**2 * field.variance,
            pitch_mm=unit * field.pitch_mm,
            origin_mm=(unit * field.origin_mm[0], unit * field.origin_mm[1]),
        ),
        relief=replace(relief, delta0_mm=unit * relief.delta0_mm, boxes=boxes),
    )


def _picture(
    name: str, found: RenderedImage, reference: RenderedImage, tolerance: float
) -> Invariance:
    """Compare radiance, in all but a thousandth of the pixels, and coverage on average."""
    off = np.abs(found.radiance - reference.radiance).max(axis=2)
    deviation = float(np.quantile(off, 1 - _SILHOUETTES))
    covered = float(np.abs(found.coverage - reference.coverage).mean())
    return Invariance(name, max(deviation, covered), tolerance, "")


def _of_shadows(painter: Painter, copy: DigitalCopy, view: View) -> Iterator[Invariance]:
    """Moved as a whole, the scene has the same shadows; ray by ray, so that none may jump."""
    reference = painter.paint(
        copy, view, mode=Mode.EXACT, width=_WIDTH, height=_HEIGHT, shadows=True
    )
    scene = _moved_scene(copy, view, Mode.EXACT, _anywhere(np.random.default_rng(1)))
    moved = painter.paint_scene(scene, width=_WIDTH, height=_HEIGHT, room_light=RoomLight())
    off = np.abs(moved.radiance - reference.radiance).max(axis=2)
    jumped = float((off > 1 / 255).mean())
    yield Invariance("render, exact, shadows of a moved scene: pixels", jumped, _SILHOUETTES, "")


def _of_a_flat_copy(painter: Painter, copy: DigitalCopy, view: View) -> Iterator[Invariance]:
    """Without any relief, what searches for it draws what a mesh is."""
    field = copy.height_field
    level = replace(field, height=np.zeros_like(field.height))
    flat = replace(
        copy,
        height_field=level,
        normal_xy=np.zeros_like(copy.normal_xy),
        relief=classify_relief(level),
    )
    reference = _painted(painter, flat, view, Mode.MESH)
    for mode in (Mode.EXACT, Mode.BOUNDED):
        found = _painted(painter, flat, view, mode)
        yield _picture(f"render, {mode}, a flat copy", found, reference, 1 / 255)
