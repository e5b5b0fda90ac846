"""Photographs of a made-up relief, rendered by the formula of their lamp, for the tests."""

from __future__ import annotations

import math

import numpy as np

from calibration.lamp import Lamp
from calibration.lens import Lens, rt_from_matrix
from fitting.reflectance.photographs import Photograph

ROWS, COLS = 90, 120


def lens(width: int = COLS, height: int = ROWS, focal: float = 600.0) -> Lens:
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    distortion = np.array([-0.08, 0.05, 4e-4, -3e-4, 0.0])
    return Lens.from_opencv(matrix, distortion, width=width, height=height)


def pose_looking_at_origin(eye) -> np.ndarray:
    """``rt_cam_canvas`` of an upright camera at ``eye``, in the canvas frame."""
    eye = np.asarray(eye, float)
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward])
    return rt_from_matrix(turn, -turn @ eye)


def lamp(elevation_deg: float, azimuth_deg: float, *, distance: float = 400.0) -> Lamp:
    e, a = math.radians(elevation_deg), math.radians(azimuth_deg)
    towards = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    intensity = math.pi * distance**2 * np.array([1.0, 0.93, 0.82])
    return Lamp(distance * towards, -towards, intensity, 4.0)


def photograph(eye=(-20.0, 10.0, 300.0), light: Lamp | None = None, image=None, **more):
    """A photograph of ``image``, grey by default, with a small even variance."""
    image = np.full((ROWS, COLS, 3), 0.2, np.float32) if image is None else image
    return Photograph(
        **{
            "name": "p",
            "radiance": np.asarray(image, np.float32),
            "variance": np.full(image.shape, 1e-6, np.float32),
            "lens": lens(),
            "rt_cam_canvas": pose_looking_at_origin(eye),
            "lamp": light or lamp(50, 30),
        }
        | more
    )
