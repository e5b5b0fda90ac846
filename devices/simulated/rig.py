"""The simulated rig: a camera that sees what a projector shows on a painting.

The geometry is cast once per rig; a frame is then the projected picture looked up at every pixel's
panel coordinate, shaded, and put through the sensor. Everything is a function of the seed.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceTimeoutError
from devices.interfaces import CameraCapabilities, Frame, Projection, ProjectorCapabilities
from devices.simulated.optics import SimulatedLens
from devices.simulated.painting import Painting, paint_small_oil
from devices.simulated.ray_kernels import cast_rays, lit_from, look_up


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A linear sensor.

    Attributes
    ----------
    full_well_e : float
        Electrons at saturation.
    read_noise_e : float
        Standard deviation of the read-out.
    bits : int
        Of the converter; full scale is the full well.
    black_level : float
        Offset in sensor numbers.
    """

    full_well_e: float = 10_000.0
    read_noise_e: float = 8.0
    bits: int = 10
    black_level: float = 8.0

    @property
    def ceiling(self) -> int:
        """Largest sensor number."""
        return 2**self.bits - 1

    def expose(
        self, electrons: NDArray[np.float64], random: np.random.Generator
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Sensor numbers of expected electrons (rows, cols): photon and read noise, quantised."""
        caught = random.poisson(np.minimum(electrons, 4 * self.full_well_e)).astype(np.float64)
        caught += random.normal(0.0, self.read_noise_e, caught.shape)
        numbers = caught * self.ceiling / self.full_well_e + self.black_level
        kind = np.uint8 if self.bits <= 8 else np.uint16
        return np.clip(np.round(numbers), 0, self.ceiling).astype(kind)


@dataclass(frozen=True)
class SceneTruth:
    """What the camera would know without noise, for tests and the demo's figures only.

    Attributes
    ----------
    points : (rows, cols, 3) float64 array
        Surface points in the canvas frame; NaN where the camera sees nothing.
    panel : (rows, cols, 2) float64 array
        Projector column and row that light each pixel.
    shading : (rows, cols) float64 array
        Radiance per projected level, 1 for a white surface facing the projector at the canvas.
    """

    points: NDArray[np.float64]
    panel: NDArray[np.float64]
    shading: NDArray[np.float64]


class SimulatedRig:
    """Painting, light, camera and projector; ``camera`` and ``projector`` are its devices.

    Parameters
    ----------
    painting : Painting
    camera_lens, projector_lens : SimulatedLens
    sensor : Sensor
    seed : int
        Of the noise; each frame has its own, by sequence number.
    blur_px : float
        Standard deviation of the projector's blur on its panel.
    gamma : float
        Exponent of the projector's response.
    black : float
        Light of a dark projector, as a share of full light.
    gloss : float
        Strength of the highlights (a microfacet lobe) beside the diffuse reflection.
    """

    def __init__(
        self,
        painting: Painting,
        camera_lens: SimulatedLens,
        projector_lens: SimulatedLens,
        *,
        sensor: Sensor | None = None,
        seed: int = 0,
        blur_px: float = 0.6,
        gamma: float = 1.0,
        black: float = 0.004,
        gloss: float = 0.02,
    ) -> None:
        self.painting = painting
        self.camera_lens = camera_lens
        self.projector_lens = projector_lens
        self.sensor = sensor or Sensor()
        self.truth = _cast(painting, camera_lens, projector_lens, gloss)
        self._seed = seed
        self._blur_px = blur_px
        self._gamma = gamma
        self._black = black
        self._shown = np.zeros((projector_lens.height, projector_lens.width), np.float32)
        self.camera = SimulatedCamera(self)
        self.projector = SimulatedProjector(self)

    def show(self, image: NDArray[np.uint8]) -> None:
        """Put a picture on the projector's panel."""
        level = (image.astype(np.float32) / 255) ** self._gamma
        if self._blur_px > 0:
            level = cv2.GaussianBlur(level, (0, 0), self._blur_px).astype(np.float32)
        self._shown = np.float32(self._black) + np.float32(1 - self._black) * level

    def electrons(self, exposure_s: float) -> NDArray[np.float64]:
        """Expected electrons of every camera pixel (rows, cols) under what is shown now."""
        light = look_up(self._shown, self.truth.panel.reshape(-1, 2))
        light = light.reshape(self.truth.shading.shape)
        # A second of full light on white paper fills the well twentyfold.
        scale = 20 * self.sensor.full_well_e * exposure_s
        return np.asarray(np.maximum(light, 0.0) * self.truth.shading * scale)

    def noise_of_frame(self, sequence: int) -> np.random.Generator:
        """Random numbers of one frame, independent of all others."""
        return np.random.default_rng([self._seed, sequence])


class SimulatedCamera:
    """The rig's camera."""

    def __init__(self, rig: SimulatedRig) -> None:
        self._rig = rig
        self._sequence = 0
        self._closed = False
        self._ended = 0.0

    @property
    def capabilities(self) -> CameraCapabilities:
        """Size and range of the simulated sensor."""
        lens = self._rig.camera_lens
        return CameraCapabilities(
            model="simulated camera",
            width=lens.width,
            height=lens.height,
            saturation_level=self._rig.sensor.ceiling,
            exposure_range_s=(1e-6, 60.0),
        )

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        """Take one frame of what the projector shows now.

        Nobody waits for a simulated exposure: the frame says when it would have ended.

        Raises
        ------
        DeviceError
            The camera is closed, the exposure is out of range, or the deadline has passed.
        """
        if self._closed:
            raise DeviceError("the simulated camera is closed")
        self.capabilities.check_exposure(exposure_s)
        began = max(time.monotonic(), self._ended)
        self._sequence += 1
        image = self._rig.sensor.expose(
            self._rig.electrons(exposure_s), self._rig.noise_of_frame(self._sequence)
        )
        now = time.monotonic()
        if deadline is not None and deadline.passed:
            raise DeviceTimeoutError("the simulated camera did not deliver in time")
        self._ended = began + exposure_s
        wall_time = time.time() + self._ended - now
        return Frame(image, self._sequence, exposure_s, exposure_s, self._ended, wall_time)

    def close(self) -> None:
        """Release the camera."""
        self._closed = True


class SimulatedProjector:
    """The rig's projector."""

    def __init__(self, rig: SimulatedRig) -> None:
        self._rig = rig
        self._closed = False

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """Size of the simulated panel."""
        lens = self._rig.projector_lens
        return ProjectorCapabilities("simulated projector", lens.width, lens.height, 1 / 60)

    def show(self, projection: Projection, *, deadline: Deadline | None = None) -> float:
        """Show a picture of the panel's size."""
        if self._closed:
            raise DeviceError("the simulated projector is closed")
        self.capabilities.check_projection(projection)
        self._rig.show(projection.image)
        return time.monotonic()

    def blank(self) -> None:
        """Show black."""
        self._rig.show(np.zeros(self.capabilities.size[::-1], np.uint8))

    def close(self) -> None:
        """Blank the panel."""
        self.blank()
        self._closed = True


def demo_rig(
    *, seed: int = 0, camera_width: int = 800, sensor: Sensor | None = None
) -> SimulatedRig:
    """The small rig of the demo: an oil painting of 120 × 90 mm in a frame, 450 mm away.

    Parameters
    ----------
    seed : int
        Of painting and noise.
    camera_width : int
        Width of a frame; the height is three quarters of it.
    sensor : Sensor, optional
    """
    camera = SimulatedLens.looking_at(
        width=camera_width,
        height=camera_width * 3 // 4,
        focal_px=2.3 * camera_width,
        position=(-25.0, 12.0, 450.0),
        target=(0.0, 0.0, 0.0),
        distortion=(-0.08, 0.05, 4e-4, -3e-4, 0.0),
    )
    projector = SimulatedLens.looking_at(
        width=912,
        height=570,
        focal_px=1750.0,
        position=(170.0, 25.0, 430.0),
        target=(0.0, 0.0, 0.0),
        distortion=(-0.05, 0.03, -5e-4, 2e-4, 0.0),
        centre_shift=(6.0, 40.0),
    )
    painting = paint_small_oil(seed=seed)
    return SimulatedRig(painting, camera, projector, sensor=sensor, seed=seed)


def _cast(
    painting: Painting, camera: SimulatedLens, projector: SimulatedLens, gloss: float
) -> SceneTruth:
    """Cast every camera pixel onto the painting, and look back from the projector."""
    low, high = float(painting.height.min()), float(painting.height.max())
    rays = camera.rays()
    eye, lamp = camera.position, projector.position
    distance = cast_rays(painting.height, painting.pitch_mm, eye, rays, low, high)
    points = eye + distance[:, np.newaxis] * rays
    seen = np.isfinite(distance)
    panel = np.full((len(rays), 2), -1e4)
    shading = np.zeros(len(rays))
    at = points[seen]
    panel[seen] = projector.project(at)
    lit = lit_from(painting.height, painting.pitch_mm, at, lamp, high, 1e-6)
    normal, albedo = painting.surface_at(at[:, 0], at[:, 1])
    to_lamp = lamp - at
    reach = np.linalg.norm(to_lamp, axis=1)
    light = to_lamp / reach[:, np.newaxis]
    cosine = np.maximum(0.0, (normal * light).sum(axis=1))
    half = light - rays[seen]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    facing = np.maximum(1e-6, (normal * half).sum(axis=1))
    # Beckmann's distribution of microfacets with a roughness of 0.3.
    beckmann = np.exp((1 - 1 / facing**2) / 0.09) / (0.09 * facing**4)
    fall_off = (np.linalg.norm(lamp) / reach) ** 2
    shading[seen] = lit * fall_off * cosine * (albedo + gloss * beckmann)
    shape = (camera.height, camera.width)
    return SceneTruth(points.reshape(*shape, 3), panel.reshape(*shape, 2), shading.reshape(shape))
