"""What a simulated scene truly is: for tests, benchmarks and the demo's figures only.

Nothing that processes a recording may import this module; a test holds the project to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from devices.interfaces import ArmPose
from devices.simulated.optics import SimulatedLens
from devices.simulated.scene import SimulatedScene


@dataclass(frozen=True)
class SceneTruth:
    """What a camera would know from one place without lens, noise or light in its way.

    Attributes
    ----------
    scene : SimulatedScene
    position : str
        Place of the camera.
    camera, projector : SimulatedLens
        With their poses in the scene frame.
    rt_scene_subject : (6,) float64 array
        Pose of the painting or board.
    points : (rows, cols, 3) float64 array
        Surface points in the scene frame; NaN where nothing is seen.
    normals : (rows, cols, 3) float32 array
        Unit normals there.
    albedo : (rows, cols, 3) float32 array
    roughness, varnish, metal : (rows, cols) float32 array
        Reflectance there, by :mod:`devices.simulated.shading_kernels`.
    panel : (rows, cols, 2) float64 array
        Projector column and row of each point, without noise; NaN where nothing is seen.
    shading : (rows, cols) float64 array
        Radiance per light of the panel; 0 in its shadow.
    """

    scene: SimulatedScene
    position: str
    camera: SimulatedLens
    projector: SimulatedLens
    rt_scene_subject: NDArray[np.float64]
    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    albedo: NDArray[np.float32]
    roughness: NDArray[np.float32]
    varnish: NDArray[np.float32]
    metal: NDArray[np.float32]
    panel: NDArray[np.float64]
    shading: NDArray[np.float64]

    def height_at(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height of the subject's surface at coordinates (mm) of its own frame."""
        return self.scene.subject.surface.height_at(x, y)

    def lamp_position(self, pose: ArmPose) -> NDArray[np.float64]:
        """Where the arm's lamp truly is at a pose, (3,) mm in the scene frame."""
        return self.scene.arm.lamp_position(pose)

    def lamp_axis(self, pose: ArmPose) -> NDArray[np.float64]:
        """Direction in which the lamp shines most at a pose, (3,) unit."""
        return self.scene.lamp.axis(self.lamp_position(pose), self.scene.arm)

    def lamp_shading(self, pose: ArmPose) -> NDArray[np.float32]:
        """Radiance (rows, cols) under the lamp at a pose; 0 in its shadow."""
        radiance = self.scene.lamp_radiance(pose, self.position)
        return radiance.reshape(self.shading.shape)


def truth_of(scene: SimulatedScene, *, position: str | None = None) -> SceneTruth:
    """The truth of a scene as it is now.

    Parameters
    ----------
    scene : SimulatedScene
    position : str, optional
        Place of the camera; where it stands by default.
    """
    view = scene.view(position)
    shape = view.lens.height, view.lens.width
    finish = view.finish.reshape(*shape, 6)
    return SceneTruth(
        scene=scene,
        position=scene.position if position is None else position,
        camera=view.lens,
        projector=scene.projector,
        rt_scene_subject=scene.subject.rt_scene_surface.copy(),
        points=view.points.reshape(*shape, 3),
        normals=view.normals.reshape(*shape, 3),
        albedo=finish[..., :3],
        roughness=finish[..., 3],
        varnish=finish[..., 4],
        metal=finish[..., 5],
        panel=scene.projector.project(view.points).reshape(*shape, 2),
        shading=view.response.reshape(shape).astype(np.float64),
    )
