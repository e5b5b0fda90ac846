"""Reflectance of the simulated oil painting, judged by photographs that the fit has not seen."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from devices.interfaces import ArmPose
from fitting.digital_copy import DigitalCopy
from fitting.reflectance.back_projection import PhotographSampler, RayCount, SamplingOptions
from fitting.reflectance.clusters import ClusterOptions
from fitting.reflectance.held_out import Comparison, compare_held_out, pooled_psnr_db
from fitting.reflectance.held_out_picture import draw_held_out
from fitting.reflectance.maps import FittedReflectance, MapOptions, fit_maps
from fitting.reflectance.photographs import Photograph
from fitting.reflectance.solver import SolverOptions
from fitting.reflectance.terrain import Terrain
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.painted_photographs import (
    PaintedScene,
    lamp_poses,
    low_lamp_poses,
)
from workstation.pareto_front import pareto_front

LIGHTS = 24
DEFAULT_SETTING = "default"
_KEPT_OUT = slice(3, None, 6)  # of the poses of the lamp
_LIMIT_LIGHTS = 10  # times as many lights
# Every sixth photograph and every third: twice and four times as many as the default learns from.
_LIMIT_SURVEYED = (6, 3)
# Materials are few here, and choosing them is most of the work on so small a canvas.
_CLUSTERS = ClusterOptions(most=4, survey=1000, per_material=200)
_SETTINGS_WIDTH = 112  # of the photographs that settings are compared by
_SAME_DB = 0.1  # what changing nothing but the seed of the survey does
# A scan's standard error of a height (docs/surface.md has that of single exposures).
_SCAN_SIGMA_MM = 0.01


@dataclass(frozen=True)
class PaintingTrial:
    """The painting with its photographs, some of which are kept out of every fit.

    Attributes
    ----------
    scene : PaintedScene
    copy : DigitalCopy
        Without reflectance.
    used, kept_out : list of Photograph
    """

    scene: PaintedScene
    copy: DigitalCopy
    used: list[Photograph]
    kept_out: list[Photograph]

    @classmethod
    def of(cls, scene: PaintedScene) -> PaintingTrial:
        """72 photographs: three places of the camera under 24 lights each."""
        poses = lamp_poses(LIGHTS)
        kept = poses[_KEPT_OUT]
        used = [pose for pose in poses if pose not in kept]
        return cls(
            scene,
            scene.copy(),
            scene.photographs(used),
            scene.photographs(kept, seed=1),
        )

    def fit(
        self,
        photographs: Sequence[Photograph] | None = None,
        *,
        copy: DigitalCopy | None = None,
        options: MapOptions | None = None,
        sampling: SamplingOptions | None = None,
        surveyed: Sequence[Photograph] | None = None,
    ) -> tuple[DigitalCopy, FittedReflectance, PhotographSampler, float]:
        """The copy with reflectance, and the processor's seconds that it took."""
        bare = copy or self.copy
        terrain = Terrain.of(bare.height_field)
        sampler = PhotographSampler(
            bare, photographs or self.used, terrain, sampling or SamplingOptions()
        )
        learning = replace(sampler, photographs=surveyed, rays=RayCount()) if surveyed else None
        before = time.process_time()
        fitted = fit_maps(sampler, options=options, surveyed=learning)
        return fitted.added_to(bare), fitted, sampler, time.process_time() - before

    def judged(
        self, copy: DigitalCopy, photographs: Sequence[Photograph] | None = None
    ) -> list[Comparison]:
        """Photographs kept out of the fit beside their renderings."""
        terrain = Terrain.of(copy.height_field)
        return compare_held_out(copy, terrain, photographs or self.kept_out)


def bench_painting(
    *, width: int = 160, seed: int = 0, pictures: Path | None = None
) -> list[Record]:
    """Records of the painting: held-out photographs, the model's limit, shadows, time and error.

    Parameters
    ----------
    width : int
        Of the photographs in pixels of 0.2 mm.
    seed : int
        Of painting and noise.
    pictures : Path, optional
        Folder for the photographs kept out, and for run time against error.
    """
    trial = PaintingTrial.of(PaintedScene.of(width=width, seed=seed))
    copy, fitted, sampler, seconds = trial.fit(options=MapOptions(clusters=_CLUSTERS))
    judged = trial.judged(copy)
    psnr = pooled_psnr_db(judged)
    if pictures is not None:
        draw_held_out(judged, pictures / "reflectance-held-out.png")
    small = PaintingTrial.of(PaintedScene.of(width=_SETTINGS_WIDTH, seed=seed))
    settled = measure_settings(small)
    limit, usual = _limit(small), settled[0][2]
    texels = fitted.texels
    single = [one.psnr_db for one in judged]
    note = (
        f"{len(trial.used)} photographs, {texels} texels of 0.2 mm, {1e3 * seconds / texels:.2f} "
        f"ms of one core each; single photographs {min(single):.1f} to {max(single):.1f} dB; "
        f"{len(fitted.palette.materials)} materials"
    )
    return [
        _record("oil.heldout_psnr_db", psnr, "dB", 35.0, Sense.AT_LEAST, len(judged), note),
        _record(
            *("oil.model_limit_db", limit - usual, "dB", 1.0, Sense.AT_MOST, len(judged)),
            note=f"below the same model with ten times the lights and no noise, {limit:.2f} dB, "
            f"on a part of {0.2 * _SETTINGS_WIDTH:.0f} mm",
        ),
        _record(
            *("oil.delta_e", float(np.mean([one.mean_delta_e for one in judged])), "", 1.5),
            *(Sense.AT_MOST, len(judged), "CIEDE2000, mean over the canvas of each photograph"),
        ),
        *_visibility(trial, sampler),
        _front(settled, pictures),
    ]


def _limit(trial: PaintingTrial) -> float:
    """Held-out PSNR of the same model from ten times the lights, without noise.

    Materials are looked for as by default, in as many texels and in more photographs. Which ones
    are found is a matter of chance by a tenth of a decibel or two: the better of two counts.
    """
    kept = lamp_poses(LIGHTS)[_KEPT_OUT]
    many = [pose for pose in lamp_poses(LIGHTS * _LIMIT_LIGHTS) if pose not in kept]
    clean = trial.scene.photographs(many, noise=False)
    truth = trial.scene.photographs(kept, noise=False)
    found = []
    for step in _LIMIT_SURVEYED:
        options = MapOptions(clusters=_CLUSTERS)
        copy, _, _, _ = trial.fit(clean, options=options, surveyed=clean[::step])
        found.append(pooled_psnr_db(trial.judged(copy, truth)))
    return max(found)


def _visibility(trial: PaintingTrial, sampler: PhotographSampler) -> Iterator[Record]:
    """Under lamps so low that much of the canvas is in shadow, and under those of the trial."""
    scene, scanned = trial.scene, trial.scene.copy(height_sigma_mm=_SCAN_SIGMA_MM)
    around = scene.surroundings(trial.copy)
    low, usual = low_lamp_poses(LIGHTS), lamp_poses(LIGHTS)

    def told(copy: DigitalCopy, poses: Sequence[ArmPose]) -> tuple[float, float]:
        terrain = Terrain.of(copy.height_field, surroundings=around)
        return scene.shadow_accuracy(copy, terrain, poses)

    exact, dark = told(trial.copy, low)
    note = (
        f"lamps 8° to 14° above the canvas, {100 * dark:.1f} % in shadow; with heights off by "
        f"{1e3 * _SCAN_SIGMA_MM:.0f} µm {told(scanned, low)[0]:.4f}; under the photographs' lamps "
        f"{told(trial.copy, usual)[0]:.4f}"
    )
    runs = LIGHTS * trial.copy.height_field.mask.size
    yield _record("visibility.accuracy", exact, "", 0.995, Sense.AT_LEAST, runs, note)
    yield _record(
        *("visibility.share_in_shadow", dark, "", 0.05, Sense.AT_LEAST, runs),
        note="so that the figure of accuracy means something",
    )
    rays = sampler.rays
    yield _record(
        *("visibility.rays_share", rays.cast / rays.tested, "", 0.6, Sense.AT_MOST, rays.tested),
        note="of pairs of texel and source a ray was cast for; the rest is above the local horizon",
    )


def _front(found: list[tuple[str, float, float]], pictures: Path | None) -> Record:
    """Whether any other setting is both quicker and better than the default."""
    if pictures is not None:
        draw_settings(found, pictures / "reflectance-time-against-error.png")
    usual = found[0]
    better = [o for o in found[1:] if o[1] < usual[1] and o[2] > usual[2] + _SAME_DB]
    return _record(
        *("pareto.beat_default", float(len(better)), "", 0.0, Sense.AT_MOST, len(found)),
        note=", ".join(f"{name} {cost:.2f} ms {psnr:.2f} dB" for name, cost, psnr in found),
    )


def _record(
    name: str, value: float, unit: str, bound: float, sense: Sense, runs: int, note: str
) -> Record:
    return Record(name=name, value=value, unit=unit, bound=bound, sense=sense, runs=runs, note=note)


@dataclass(frozen=True)
class Setting:
    """One point of run time against error."""

    name: str
    photographs: int
    options: MapOptions


def settings() -> list[Setting]:
    """Choices that cost or spare time: samples, starts, precision, model, normals."""
    usual = MapOptions(clusters=_CLUSTERS)

    def solver(**choices: float) -> MapOptions:
        return replace(usual, solver=replace(SolverOptions(), **choices))  # type: ignore[arg-type]

    return [
        Setting(DEFAULT_SETTING, 1, usual),
        Setting("half of the photographs", 2, usual),
        Setting("a quarter of them", 4, usual),
        Setting("normals of the heights", 1, replace(usual, refine_normals=False)),
        Setting("one start", 1, solver(starts=1, weak_starts=1)),
        Setting("tolerance 10⁻³", 1, solver(tolerance=1e-3)),
        Setting("one material", 1, replace(usual, clusters=replace(_CLUSTERS, most=1))),
        Setting("no lobe skipped", 1, solver(skip_diffuse=False)),
    ]


def measure_settings(trial: PaintingTrial) -> list[tuple[str, float, float]]:
    """Name, processor's milliseconds per texel, and held-out PSNR of every setting."""
    found = []
    for setting in settings():
        photographs = trial.used[:: setting.photographs]
        copy, fitted, _, seconds = trial.fit(photographs, options=setting.options)
        psnr = pooled_psnr_db(trial.judged(copy))
        found.append((setting.name, 1e3 * seconds / fitted.texels, psnr))
    return found


def draw_settings(found: list[tuple[str, float, float]], path: Path) -> None:
    """Run time against error; what nothing else beats in both is joined by a line."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for name, cost, psnr in found:
        mark, colour = ("*", "tab:red") if name == DEFAULT_SETTING else (".", "0.3")
        axes.plot(cost, psnr, mark, color=colour, markersize=12)
        axes.annotate(name, (cost, psnr), xytext=(5, 4), textcoords="offset points", fontsize=8)
    best = pareto_front(found, lambda one: (one[1], -one[2]))
    axes.plot([one[1] for one in best], [one[2] for one in best], color="tab:red", lw=1, zorder=0)
    axes.set_xlabel("processor time per texel (ms of one core)")
    axes.set_ylabel("PSNR of photographs kept out (dB)")
    axes.margins(x=0.25)
    figure.savefig(path, dpi=120)
