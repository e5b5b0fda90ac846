"""The simulated scene: what stands before the camera, what lights it, and what a frame of it is.

A scene knows the state of the world (what the panel shows, where arm and camera are) and computes
frames of it. What depends on the camera's place alone is computed once per place, what depends on
the lamp's pose once per pose; a frame is then a look-up on the panel, and the sensor.

The scene frame is the canvas frame of a painting that hangs where it should.
"""

from __future__ import annotations

import hashlib
from collections import Counter, OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from devices.errors import DeviceError
from devices.interfaces import ArmPose
from devices.simulated.arm_kinematics import ArmKinematics, Lamp, LampCarrier
from devices.simulated.optics import PanelResponse, SimulatedLens
from devices.simulated.scene_objects import PlacedSurface, SceneObject
from devices.simulated.sensor import Light, Sensor
from devices.simulated.shading_kernels import shade

# Views of a scene that are kept: each takes some 250 MB for three megapixels.
_KEPT_VIEWS = 2
_KEPT_LAMPS = 2
_UNLIT = -1e4


@dataclass(frozen=True)
class View:
    """What one place of the camera sees, whatever lights it; n pixels, row by row.

    Attributes
    ----------
    lens : SimulatedLens
    points : (n, 3) float64 array
        Surface points in the scene frame; NaN where nothing is seen.
    normals : (n, 3) float32 array
    finish : (n, 6) float32 array
        As in :class:`~devices.simulated.surface.SurfacePoints`.
    panel : (n, 2) float32 array
        Projector column and row of each point, lit or not; far outside where nothing is seen.
    response : (n,) float32 array
        Radiance per light of the panel; 1 for white paper that faces the projector.
    ambient : (n,) float32 array
        Radiance of the room's light.
    transmission : (n,) float32 array
        What vignetting leaves of the light.
    """

    lens: SimulatedLens
    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    finish: NDArray[np.float32]
    panel: NDArray[np.float32]
    response: NDArray[np.float32]
    ambient: NDArray[np.float32]
    transmission: NDArray[np.float32]


class SimulatedScene:
    """A subject before a background, with its lights, its sensor and the places of the camera.

    Parameters
    ----------
    subject : PlacedSurface
        What is to be digitised, or looked at to calibrate.
    background : tuple of SceneObject
        What else is there.
    cameras : dict of str to SimulatedLens
        The camera's lens at each of its places; the first is where it stands.
    projector : SimulatedLens
    panel : PanelResponse
    sensor : Sensor
    arm : ArmKinematics
    lamp : Lamp
    ambient : float
        Diffuse light of the room, 1 being the projector's full light.
    seed : int
        Of all noise.
    """

    def __init__(
        self,
        subject: PlacedSurface,
        background: tuple[SceneObject, ...],
        cameras: dict[str, SimulatedLens],
        projector: SimulatedLens,
        *,
        panel: PanelResponse | None = None,
        sensor: Sensor | None = None,
        arm: ArmKinematics | None = None,
        lamp: Lamp | None = None,
        ambient: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.subject = subject
        self.background = background
        self.cameras = cameras
        self.projector = projector
        self.panel = panel or PanelResponse()
        self.sensor = sensor or Sensor()
        self.arm = arm or ArmKinematics()
        self.lamp = lamp or Lamp()
        self.ambient = ambient
        self.seed = seed
        self.position = next(iter(cameras))
        self._carrier: LampCarrier | None = None
        self._views: OrderedDict[str, View] = OrderedDict()
        self._lamps: OrderedDict[tuple[str, ArmPose], NDArray[np.float32]] = OrderedDict()
        self._taken: Counter[bytes] = Counter()
        first = cameras[self.position]
        self._pattern = self.sensor.fixed_pattern(first.width * first.height, seed=seed)
        self.blank()

    def blank(self) -> None:
        """Put the projector's light out: what is left is that of a black picture."""
        size = self.projector.height, self.projector.width
        self._light_panel(np.zeros(size, np.uint8), b"")

    def show(self, image: NDArray[np.uint8]) -> None:
        """Put a picture (rows, cols) on the projector's panel.

        Raises
        ------
        DeviceError
            It is not of the panel's size.
        """
        if image.shape != (self.projector.height, self.projector.width) or image.dtype != np.uint8:
            raise DeviceError(
                f"the simulated panel shows 8-bit pictures of {self.projector.width}×"
                f"{self.projector.height}, not {image.dtype} of {image.shape[::-1]}"
            )
        # The proof of a recording's first light blanks the panel, and one that is gone on with
        # further on needs none: the noise of a black picture must not hang on that.
        self._light_panel(image, b"" if image.any() else b"a picture")

    def _light_panel(self, image: NDArray[np.uint8], how: bytes) -> None:
        self._shown = self.panel.light(image)
        self._shown_digest = hashlib.sha256(how + np.ascontiguousarray(image).tobytes()).digest()

    def carry_lamp(self, carrier: LampCarrier) -> None:
        """Let the lamp be wherever ``carrier`` says that it mechanically is."""
        self._carrier = carrier

    def place_camera(self, position: str) -> None:
        """Put the camera at one of its places.

        Raises
        ------
        DeviceError
            There is no such place.
        """
        if position not in self.cameras:
            raise DeviceError(
                f"the simulated camera has no position {position!r}; there are "
                f"{', '.join(self.cameras)}"
            )
        self.position = position

    def move_subject(self, rt_scene_subject: NDArray[np.float64]) -> None:
        """Put the subject elsewhere: its pose (6,), Rodrigues and mm, in the scene frame."""
        self.replace_subject(self.subject.placed(rt_scene_subject))

    def replace_subject(
        self, subject: PlacedSurface, *, background: tuple[SceneObject, ...] | None = None
    ) -> None:
        """Put another subject before the camera, and other things about it if there are any."""
        self.subject = subject
        if background is not None:
            self.background = background
        self._views.clear()
        self._lamps.clear()

    def electrons(self, exposure_s: float) -> NDArray[np.float64]:
        """Electrons (rows, cols) that light would set free on average in a perfect sensor."""
        light = self._light()
        bright = self.sensor.mean_radiance(light) * self.sensor.rate_e_per_s * exposure_s
        lens = self.cameras[self.position]
        return np.asarray(bright.reshape(lens.height, lens.width))

    def expose(self, exposure_s: float) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Take a frame (rows, cols) of the world as it is.

        Its noise is a function of seed and subject, of what lights it, of exposure and position,
        and of how often just this was taken; not of the frames taken otherwise. A recording that
        was cut off and resumed is the same as one that was not.
        """
        key = self._key_of_next(exposure_s)
        numbers = self.sensor.expose(self._light(), self._pattern, exposure_s=exposure_s, key=key)
        lens = self.cameras[self.position]
        return numbers.reshape(lens.height, lens.width)

    def view(self, position: str | None = None) -> View:
        """What the camera sees from a place; by default where it stands."""
        name = self.position if position is None else position
        if name not in self._views:
            while len(self._views) >= _KEPT_VIEWS:
                self._views.popitem(last=False)
            self._views[name] = self._look(self.cameras[name])
        self._views.move_to_end(name)
        return self._views[name]

    def lamp_radiance(self, pose: ArmPose, position: str | None = None) -> NDArray[np.float32]:
        """Radiance (n,) of every pixel under the arm's lamp at a pose."""
        name = self.position if position is None else position
        if (name, pose) not in self._lamps:
            while len(self._lamps) >= _KEPT_LAMPS:
                self._lamps.popitem(last=False)
            self._lamps[name, pose] = self._shade_by_lamp(self.view(name), pose)
        self._lamps.move_to_end((name, pose))
        return self._lamps[name, pose]

    def _light(self) -> Light:
        view = self.view()
        steady = view.ambient
        pose = self._lit_pose()
        if pose is not None:
            steady = steady + self.lamp_radiance(pose)
        return Light(self._shown, view.panel, view.response, steady)

    def _lit_pose(self) -> ArmPose | None:
        """Where the lamp is, if it is lit."""
        if self._carrier is None or not self._carrier.lamp_on:
            return None
        pose = self._carrier.pose
        if pose is None:
            raise DeviceError("the simulated lamp is lit, but nothing says where it is")
        return pose

    def _key_of_next(self, exposure_s: float) -> int:
        pose = self._lit_pose()
        lit = None if pose is None else (float(pose.azimuth), float(pose.elevation))
        placed = tuple(self.subject.rt_scene_surface.tolist())
        state = repr((self.seed, self.position, float(exposure_s), lit, placed)).encode()
        what = hashlib.sha256(state + self._shown_digest).digest()
        self._taken[what] += 1
        taken = self._taken[what].to_bytes(8, "little")
        return int.from_bytes(hashlib.sha256(what + taken).digest()[:8], "little")

    def _look(self, lens: SimulatedLens) -> View:
        rays, eye = lens.rays(), lens.position
        objects = (self.subject, *self.background)
        distances = [thing.cast(eye, rays) for thing in objects]
        distance = distances[0]
        for other in distances[1:]:
            distance = np.fmin(distance, other)
        points = eye + distance[:, np.newaxis] * rays
        normals = np.zeros((len(rays), 3), np.float32)
        finish = np.zeros((len(rays), 6), np.float32)
        footprints = _footprints(points.reshape(lens.height, lens.width, 3))
        for thing, own in zip(objects, distances, strict=True):
            seen = np.flatnonzero(own == distance)
            found = thing.points_at(points[seen], footprints[seen])
            normals[seen], finish[seen] = found.normals, found.finish
        panel = np.full((len(rays), 2), _UNLIT)
        seen = np.flatnonzero(np.isfinite(distance))
        panel[seen] = self.projector.project(points[seen])
        transmission = lens.transmission().astype(np.float32)
        weights = self.sensor.weights((1.0, 1.0, 1.0))
        projector = self.projector
        lit = shade(
            *(points, normals, finish, self._hidden(points, projector.position), eye),
            *(projector.position, projector.axis, projector.vignetting),
            *(float(np.linalg.norm(projector.position)), weights, lens.width),
        )
        return View(
            lens=lens,
            points=points,
            normals=normals,
            finish=finish,
            panel=panel.astype(np.float32),
            response=lit * transmission,
            ambient=self._ambient(finish, weights, lens) * transmission,
            transmission=transmission,
        )

    def _ambient(
        self, finish: NDArray[np.float32], weights: NDArray[np.float64], lens: SimulatedLens
    ) -> NDArray[np.float32]:
        """Light from all around reflects by the albedo."""
        albedo = finish[:, :3].reshape(lens.height, lens.width, 3)
        radiance = np.empty((lens.height, lens.width), np.float32)
        for row in (0, 1):
            for col in (0, 1):
                here = slice(row, None, 2), slice(col, None, 2)
                radiance[here] = albedo[here] @ (self.ambient * weights[row, col])
        return radiance.ravel()

    def _shade_by_lamp(self, view: View, pose: ArmPose) -> NDArray[np.float32]:
        light = self.arm.lamp_position(pose)
        lit = shade(
            *(view.points, view.normals, view.finish, self._hidden(view.points, light)),
            *(view.lens.position, light, self.lamp.axis(light, self.arm), self.lamp.exponent),
            *(self.arm.radius, self.sensor.weights(self.lamp.colour), view.lens.width),
        )
        return np.asarray(lit * view.transmission)

    def _hidden(self, points: NDArray[np.float64], light: NDArray[np.float64]) -> NDArray[np.bool_]:
        hidden = self.subject.hides(points, light)
        for thing in self.background:
            hidden |= thing.hides(points, light)
        return hidden


def _footprints(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """By how much the point moves from pixel to pixel along rows and columns, (n, 2, 3).

    Zero beside edges, where the neighbours lie on something else.
    """
    moves = np.empty((*points.shape[:2], 2, 3), np.float32)
    for along, axis in enumerate((1, 0)):
        step = np.gradient(points, axis=axis)
        length = np.linalg.norm(step, axis=-1)
        usual = np.nanmedian(length) if np.isfinite(length).any() else 0.0
        moves[:, :, along] = np.where((length < 4 * usual)[..., np.newaxis], step, 0)
    return moves.reshape(-1, 2, 3)
