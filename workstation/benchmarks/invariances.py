"""Changes that must not matter: order of inputs, threads, units, level of light.

Each is stated with the tolerance that the arithmetic leaves: sums in another order differ in their
last digits, and single precision has seven of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.decoding import decode
from acquisition.frame_files import Samples
from acquisition.hdr import merge_bracket
from acquisition.plan import Plan
from acquisition.sample_noise import SampleNoise
from acquisition.session import Session
from calibration.rig_geometry import RigGeometry
from devices.errors import ImpastoError
from fitting.height_field import HeightField
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.solver import TexelFits, fit_texels
from fitting.surface import reconstruct_surface
from workstation.benchmarks.analytic_scans import scan_of, surface_rig
from workstation.benchmarks.paint_samples import glossy_finishes, paint_samples

_FULL_SCALE = 65535


@dataclass(frozen=True)
class Invariance:
    """A change that must not matter.

    Attributes
    ----------
    name : str
        Stage and change.
    deviation : float
        Largest change of the result; infinite where the result is not there.
    tolerance : float
    unit : str
    """

    name: str
    deviation: float
    tolerance: float
    unit: str

    @property
    def holds(self) -> bool:
        """Whether the change did not matter."""
        return self.deviation <= self.tolerance


def measure_invariances(session: Path) -> list[Invariance]:
    """Make every change and see what it does.

    Parameters
    ----------
    session : Path
        A small scan with its calibration.
    """
    return [
        *_of_decoding(Session.open(session)),
        *_of_merging(),
        *_of_surface(),
        *_of_reflectance(),
    ]


def _of_decoding(session: Session) -> Iterator[Invariance]:
    plan = session.plan
    frames = {frame.id: session.read_frame(frame.id) for frame in plan.frames}
    reference = decode(plan, frames.__getitem__)

    def changed(
        name: str, plan: Plan, read: Callable[[str], Samples], tolerance: float
    ) -> Invariance:
        return Invariance(
            f"decode, {name}", _pixels(decode(plan, read), reference), tolerance, "px"
        )

    random = np.random.default_rng(0)
    for _ in range(3):
        order = tuple(plan.frames[i] for i in random.permutation(len(plan.frames)))
        permuted = plan.model_copy(update={"frames": order})
        yield changed("frames in another order", permuted, frames.__getitem__, 1e-4)
    with _threads(1):
        yield changed("one thread", plan, frames.__getitem__, 0.0)
    gain = min(16, _FULL_SCALE // plan.saturation_level)
    brighter = plan.model_copy(update={"saturation_level": plan.saturation_level * gain})
    yield changed(
        f"{gain} times the sensor numbers",
        brighter,
        lambda frame: (
            (frames[frame].astype(np.uint32) * gain).clip(0, _FULL_SCALE).astype(np.uint16)
        ),
        1e-3,
    )


def _pixels(found: CorrespondenceMap, reference: CorrespondenceMap) -> float:
    """Largest difference of coordinates, where nearly all pixels have one in both."""
    worst = 0.0
    for axis, expected in reference.axes.items():
        a, b = found.axes[axis].coordinate, expected.coordinate
        both = np.isfinite(a) & np.isfinite(b)
        if both.sum() < 0.999 * max(np.isfinite(a).sum(), np.isfinite(b).sum()):
            return np.inf
        worst = max(worst, float(np.abs(a - b)[both].max()))
    return worst


def _of_merging() -> Iterator[Invariance]:
    random = np.random.default_rng(1)
    exposures = np.array([0.01, 0.04, 0.16])
    radiance = 10 ** random.uniform(1, 5, (64, 64))
    noise = SampleNoise(4.0, 0.5, "stated")
    level = radiance[None] * exposures[:, None, None]
    stack = np.clip(random.poisson(level / 0.5) * 0.5 + 32, 0, 4095).astype(np.uint16)

    def merge(order: NDArray[np.intp], unit: float) -> NDArray[np.float32]:
        merged = merge_bracket(
            [stack[i] for i in order],
            exposures[order] * unit,
            noise=noise,
            black_level=32.0,
            saturation_level=4095,
        )
        return np.asarray(merged.radiance * unit, np.float32)

    rising = np.arange(3)
    reference = merge(rising, 1.0)
    for name, found in (
        ("exposures in another order", merge(rising[::-1], 1.0)),
        ("exposures in milliseconds", merge(rising, 1e3)),
        ("exposures in days", merge(rising, 1 / 86_400)),
    ):
        deviation = np.nanmax(np.abs(found - reference) / (np.abs(reference) + 1.0))
        same = np.array_equal(np.isnan(found), np.isnan(reference))
        yield Invariance(f"merge, {name}", float(deviation) if same else np.inf, 1e-5, "")


def _of_surface() -> Iterator[Invariance]:
    rig = surface_rig(320)
    scan = scan_of(rig)
    reference = reconstruct_surface(scan, rig).copy.height_field
    with _threads(1):
        alone = reconstruct_surface(scan, rig).copy.height_field
    yield Invariance("surface, one thread", _millimetres(alone, reference, 1.0), 0.0, "mm")
    for unit, name in ((1e-3, "metres"), (1e3, "micrometres")):
        pose = np.concatenate([rig.rt_proj_cam[:3], unit * rig.rt_proj_cam[3:]])
        field = reconstruct_surface(scan, replace(rig, rt_proj_cam=pose)).copy.height_field
        yield Invariance(
            f"surface, rig in {name}", _millimetres(field, reference, unit), 1e-3, "mm"
        )
    for share in (1e-1, 1e-3):
        yield _of_a_short_baseline(rig, share)


def _of_a_short_baseline(rig: RigGeometry, share: float) -> Invariance:
    """A rig whose lenses stand close together refuses, or states errors that large."""
    pose = np.concatenate([rig.rt_proj_cam[:3], share * rig.rt_proj_cam[3:]])
    narrow = replace(rig, rt_proj_cam=pose)
    try:
        field = reconstruct_surface(scan_of(narrow), narrow).copy.height_field
    except ImpastoError:
        stated = 0.0
    else:
        spread = np.nanstd(field.height[field.mask])
        stated = float(spread / np.sqrt(np.median(field.variance[field.mask])))
    baseline_mm = np.linalg.norm(pose[3:])
    name = f"surface, {baseline_mm:.2g} mm of baseline: height over its stated error"
    return Invariance(name, stated, 3.0, "")


def _millimetres(found: HeightField, reference: HeightField, unit: float) -> float:
    if found.shape != reference.shape:
        return np.inf
    both = found.mask & reference.mask
    if both.sum() < 0.999 * max(found.mask.sum(), reference.mask.sum()):
        return np.inf
    return float(np.abs(found.height / unit - reference.height)[both].max())


def _of_reflectance() -> Iterator[Invariance]:
    random = np.random.default_rng(2)
    texels, count = 200, 48
    samples = paint_samples(glossy_finishes(texels, random), texels, count, seed=3)
    reference = fit_texels(samples)
    order = random.permutation(texels)
    inverse = np.argsort(order)
    shuffled = fit_texels(samples.take(order))
    cost, diffuse = shuffled.cost[inverse], shuffled.lobes.diffuse[inverse]
    yield _fit("texels in another order", cost, diffuse, reference, 1e-12)
    places = random.permutation(count)
    found = fit_texels(_samples(samples, lambda array: array[:, places]))
    yield _fit("samples in another order", found.cost, found.lobes.diffuse, reference, 1e-2)
    with _threads(1):
        found = fit_texels(samples)
    yield _fit("one thread", found.cost, found.lobes.diffuse, reference, 0.0)
    for factor in (1e-6, 1e6):
        scaled = replace(
            samples, radiance=samples.radiance * factor, variance=samples.variance * factor**2
        )
        found = fit_texels(scaled)
        yield _fit(f"light × {factor:g}", found.cost, found.lobes.diffuse / factor, reference, 1e-2)


def _samples(
    samples: RadianceSamples, change: Callable[[NDArray[np.float32]], NDArray[np.float32]]
) -> RadianceSamples:
    names = ("view", "light", "radiance", "variance", "weight")
    return RadianceSamples(*(change(getattr(samples, name)) for name in names))


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


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = numba.get_num_threads()
    numba.set_num_threads(count)
    try:
        yield
    finally:
        numba.set_num_threads(before)
