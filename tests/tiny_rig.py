"""A rig of few pixels, whose pictures depend on its scene alone: the same whenever they are taken.

Two grey levels in a coarse pattern carry no noise, so a picture may come twice.
"""

from __future__ import annotations

import time
import zlib
from dataclasses import dataclass, field

import numpy as np

from devices.interfaces import (
    ArmCapabilities,
    ArmLimits,
    ArmPose,
    CameraCapabilities,
    Frame,
    ProjectorCapabilities,
)
from devices.rig import Rig

WIDTH, HEIGHT = 20, 16
SATURATION = 1023
BLACK = 32


@dataclass
class TinyScene:
    """What lights the scene, and everything that was done to it, in order."""

    log: list[str] = field(default_factory=list)
    showing: bytes | None = None
    pose: ArmPose | None = None
    lamp_on: bool = False
    position: str = "front"
    sequence: int = 0
    ended: float = 0.0

    @property
    def dark(self) -> bool:
        return self.showing is None and not self.lamp_on


class TinyCamera:
    capabilities = CameraCapabilities("tiny camera", WIDTH, HEIGHT, SATURATION, (1e-4, 10.0))

    def __init__(self, scene: TinyScene) -> None:
        self.scene = scene

    def capture(self, exposure_s, *, deadline=None):
        scene = self.scene
        scene.sequence += 1
        began = max(time.monotonic(), scene.ended)
        scene.ended = began + exposure_s
        if scene.dark:
            radiance = np.full((HEIGHT, WIDTH), 0.0)
        else:
            state = (scene.showing, scene.lamp_on and scene.pose, scene.position)
            seed = zlib.crc32(repr(state).encode())
            bright = np.random.default_rng(seed).random((HEIGHT, WIDTH)) < 0.5
            radiance = np.where(bright, 1000.0 + 4000.0 * scene.lamp_on, 300.0)
        image = np.minimum(np.round(BLACK + radiance * exposure_s), SATURATION).astype(np.uint16)
        return Frame(image, scene.sequence, exposure_s, exposure_s, scene.ended, time.time())

    def close(self):
        self.scene.log.append("camera closed")


class TinyProjector:
    capabilities = ProjectorCapabilities("tiny projector", 64, 40, 1 / 60)

    def __init__(self, scene: TinyScene) -> None:
        self.scene = scene

    def show(self, projection, *, deadline=None):
        assert not self.scene.lamp_on
        self.scene.showing = projection.digest.encode()
        self.scene.log.append(f"show {projection.name}")
        return time.monotonic()

    def blank(self):
        self.scene.showing = None
        self.scene.log.append("blank")

    def close(self):
        self.blank()


class TinyArm:
    capabilities = ArmCapabilities("tiny arm", ArmLimits((0.0, 6.0), (0.3, 1.4)), 0.5)

    def __init__(self, scene: TinyScene) -> None:
        self.scene = scene

    @property
    def pose(self):
        return self.scene.pose

    @property
    def lamp_on(self):
        return self.scene.lamp_on

    def home(self, *, deadline=None):
        assert self.scene.dark
        self.scene.pose = ArmPose(0.0, 0.3)
        self.scene.log.append("home")

    def move_to(self, pose, *, deadline=None):
        self.capabilities.limits.check(pose)
        self.scene.lamp_on = False
        assert self.scene.dark
        self.scene.pose = pose
        self.scene.log.append(f"move to {pose}")

    def switch_lamp(self, on):
        self.scene.lamp_on = on
        self.scene.log.append(f"lamp {'on' if on else 'off'}")
        return time.monotonic()

    def stop(self):
        self.scene.lamp_on = False
        self.scene.log.append("stop")

    def close(self):
        self.stop()


class TinyMount:
    positions = ("front", "left")

    def __init__(self, scene: TinyScene) -> None:
        self.scene = scene

    @property
    def position(self):
        return self.scene.position

    def place(self, position):
        assert self.scene.dark
        self.scene.position = position
        self.scene.log.append(f"place {position}")


def tiny_rig(scene: TinyScene | None = None, **devices) -> Rig:
    """A rig with every device; single ones can be exchanged."""
    scene = scene or TinyScene()
    made = {
        "camera": TinyCamera(scene),
        "projector": TinyProjector(scene),
        "arm": TinyArm(scene),
        "mount": TinyMount(scene),
    } | devices
    return Rig(**made, source="simulation", prove_light=False)
