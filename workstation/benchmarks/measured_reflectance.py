"""Measured reflectance made by others, as radiance samples, and the metrics it is judged by.

Two paints measured with a goniometer (Cornell University, Program of Computer Graphics), and a
glossy ball under 96 calibrated lights (DiLiGenT; Shi et al., PAMI 2019). Neither is part of this
project; ``IMPASTO_REAL_DATA`` names the folder that holds them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FittingError
from fitting.reflectance.lobe import LafortuneLobes
from fitting.reflectance.materials import Material
from fitting.reflectance.samples import RadianceSamples, local_frames
from fitting.reflectance.solver import SolverOptions, fit_texels
from workstation.benchmarks.paint_samples import directions

Floats = NDArray[np.float64]

CORNELL_LIMIT = math.radians(65.5)
# Centres and standard deviation, in nm, of the bands that stand for red, green and blue.
_BAND_CENTRES = (600.0, 540.0, 460.0)
_BAND_WIDTH = 35.0
_WAVELENGTHS = np.arange(400.0, 701.0, 10.0)
LEAST_SQUARES = SolverOptions(huber_limit=math.inf)
_DESCENT = replace(LEAST_SQUARES, search_starts=False, skip_diffuse=False)
_BROADENING = math.log(4.0)
HELD_OUT_LIGHTS = np.arange(96) % 8 == 4


def read_goniometer(path: Path) -> RadianceSamples:
    """One paint as a single texel of samples, evenly weighted in radiance.

    A residual of radiance is cos θ times one of reflectance. Angles to the normal up to 65°.
    """
    lines = path.read_text().splitlines()
    heading = [number for number, line in enumerate(lines) if line.startswith("# theta i")]
    if not heading:
        raise FittingError(f"{path} has no line '# theta i, …': is it a Cornell BRDF file?")
    body = " ".join(line for line in lines[heading[0] :] if not line.startswith("#"))
    rows = np.array(body.split(), dtype=np.float64).reshape(-1, 4 + len(_WAVELENGTHS))
    theta_i, phi_i, theta_s, phi_s = rows[:, :4].T
    kept = (theta_i <= CORNELL_LIMIT) & (theta_s <= CORNELL_LIMIT)
    bands = np.exp(
        -0.5 * ((_WAVELENGTHS - np.array(_BAND_CENTRES)[:, np.newaxis]) / _BAND_WIDTH) ** 2
    )
    colour = rows[kept, 4:] @ (bands / bands.sum(axis=1, keepdims=True)).T
    light = directions(theta_i[kept], phi_i[kept])[np.newaxis]
    view = directions(theta_s[kept], phi_s[kept])[np.newaxis]
    radiance = colour[np.newaxis] * light[..., 2:]
    variance = np.full_like(radiance, float(np.mean(radiance**2)) * 1e-4)
    arrays = (view, light, radiance, variance, np.ones(radiance.shape[:2]))
    return RadianceSamples(*(array.astype(np.float32) for array in arrays))


def relative_rms(lobes: LafortuneLobes, samples: RadianceSamples) -> float:
    """Error of the reflectance over its size, both times cos θ, root mean square over RGB."""
    off = lobes.radiance(samples.view, samples.light) - samples.radiance
    return float(np.sqrt(np.sum(off**2) / np.sum(samples.radiance.astype(np.float64) ** 2)))


def random_shapes(number: int, *, seed: int) -> Floats:
    """Lobes to start from (n, 3): k evenly in ln k from 1 to 1000, r from 0.67 to 1.49."""
    rng = np.random.default_rng(seed)
    ln_k, ln_r = rng.uniform(0.0, math.log(1000.0), number), rng.uniform(-0.4, 0.4, number)
    return np.column_stack([ln_k, ln_r, np.zeros(number)])


def descended(samples: RadianceSamples, shapes: Floats) -> list[LafortuneLobes]:
    """Lobes of one texel where single descents from given shapes (n, 3) end, n of them.

    No grid is searched: least squares go downhill from exactly these k and r.
    """
    return [lobe for lobe, _ in _ends(samples, shapes)]


def continued(samples: RadianceSamples, shapes: Floats) -> list[LafortuneLobes]:
    """The same with continuation in k: the least cost that a start leads to, broadened or not.

    A narrow lobe far off the highlight meets no sample that says where to go. So descents begin
    from the start's r under k, k / 4, k / 16 … down to 1.
    """
    best = []
    for shape in shapes:
        broader = np.arange(shape[0], 0.0, -_BROADENING)
        family = np.tile(shape, (len(broader) + 1, 1))
        family[:, 0] = [*broader, 0.0]
        best.append(min(_ends(samples, family), key=lambda end: end[1])[0])
    return best


def _ends(samples: RadianceSamples, shapes: Floats) -> list[tuple[LafortuneLobes, float]]:
    """Lobe and cost where the descent from each shape ends."""
    repeated = samples.take(np.zeros(len(shapes), np.intp))
    starts = [Material(shape_mean=shape) for shape in shapes]
    fits = fit_texels(repeated, starts, np.arange(len(shapes)), options=_DESCENT)
    lobes, cost = fits.lobes, fits.cost
    return [
        (LafortuneLobes(lobes.shape[[i]], lobes.diffuse[[i]], lobes.specular[[i]]), float(cost[i]))
        for i in range(len(shapes))
    ]


@dataclass(frozen=True)
class Ball:
    """Pictures of the ball.

    Attributes
    ----------
    samples : RadianceSamples
        Of all lights, (pixels, 96).
    light : (96, 3) array
        Directions in the camera's frame, z towards it.
    peak : float
        99.9th percentile of the radiance.
    """

    samples: RadianceSamples
    light: Floats
    peak: float

    @property
    def training(self) -> RadianceSamples:
        """The samples without those of the held-out lights."""
        return self.samples.masked(~HELD_OUT_LIGHTS)

    def psnr_db(self, predicted: Floats) -> float:
        """Of predictions (pixels, 12, 3) for the held-out lights; radiance clipped at the peak."""
        truth = np.minimum(self.samples.radiance[:, HELD_OUT_LIGHTS], self.peak)
        off = np.clip(predicted, 0.0, self.peak) - truth
        return float(10.0 * np.log10(self.peak**2 / np.mean(off**2)))

    def relight_psnr_db(self, lobes: LafortuneLobes) -> float:
        """Of fitted lobes for the held-out lights."""
        out = HELD_OUT_LIGHTS
        return self.psnr_db(lobes.radiance(self.samples.view[:, out], self.samples.light[:, out]))

    def basis_psnr_db(self, basis: Floats) -> float:
        """Of a linear fit of functions of the light's direction (96, f) to each pixel."""
        seen = self.samples.radiance[:, ~HELD_OUT_LIGHTS].astype(np.float64)
        pixels = len(seen)
        columns = seen.transpose(1, 0, 2).reshape(-1, 3 * pixels)
        weights = np.linalg.lstsq(basis[~HELD_OUT_LIGHTS], columns, rcond=None)[0]
        predicted = (basis[HELD_OUT_LIGHTS] @ weights).reshape(-1, pixels, 3)
        return self.psnr_db(predicted.transpose(1, 0, 2))


def read_ball(folder: Path) -> Ball:
    """The ball, divided by the lights' intensities, in units of its median radiance."""
    import cv2

    light = np.loadtxt(folder / "light_directions.txt")
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    intensity = np.loadtxt(folder / "light_intensities.txt")
    mask = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_UNCHANGED)
    if mask is None:
        raise FittingError(f"{folder} has no mask.png: is it the DiLiGenT ball?")
    inside = (mask if mask.ndim == 2 else mask[..., 0]) > 0
    names = (folder / "filenames.txt").read_text().split()
    pictures = np.stack(
        [cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)[inside] for name in names], axis=1
    )
    radiance = pictures[..., ::-1] / intensity
    unit = float(np.median(radiance))
    radiance /= unit
    frames = local_frames(np.load(folder / "normals_gt.npy")[inside])
    towards_light = np.einsum("nij,mj->nmi", frames, light)
    towards_camera = np.broadcast_to(frames[:, np.newaxis, :, 2], radiance.shape)
    # The camera's noise is not known. A fiftieth of the median is below what any model reaches;
    # how far the model is off is found from the samples.
    variance = np.full_like(radiance, 0.02**2)
    weight = np.ones(radiance.shape[:2])
    arrays = (towards_camera, towards_light, radiance, variance, weight)
    samples = RadianceSamples(*(array.astype(np.float32) for array in arrays))
    return Ball(samples, light, float(np.percentile(radiance, 99.9)))


def polynomial_basis(light: Floats) -> Floats:
    """Polynomial texture maps (Malzbender et al., SIGGRAPH 2001): biquadratic in x and y."""
    x, y = light[:, 0], light[:, 1]
    return np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)], axis=1)


def hemispherical_basis(light: Floats) -> Floats:
    """Nine hemispherical harmonics (Gautron et al., EGSR 2004), up to constant factors."""
    phi = np.arctan2(light[:, 1], light[:, 0])
    z = light[:, 2]
    rim = np.sqrt(np.maximum(z - z * z, 0.0))
    return np.stack(
        [
            np.ones_like(z),
            np.cos(phi) * rim,
            2.0 * z - 1.0,
            np.sin(phi) * rim,
            np.cos(2.0 * phi) * (z - z * z),
            np.cos(phi) * (2.0 * z - 1.0) * rim,
            1.0 - 6.0 * z + 6.0 * z * z,
            np.sin(phi) * (2.0 * z - 1.0) * rim,
            np.sin(2.0 * phi) * (z - z * z),
        ],
        axis=1,
    )
