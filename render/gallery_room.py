"""The room of a gallery: bays of wall and floor, skirting, ceiling, and walls at the ends.

Axes are those of the canvases on the wall: x to the right along it, y up from the floor, z from the
wall into the room. Everything is as large as the paintings ask: lengths are in units of the largest
side of any copy on the wall.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from render.captions import font
from render.opengl import pyrender

HEIGHT, DEPTH = 5.0, 6.5
_TILE = 2.0  # side of what the textures show
_TEXTURE = 1024
_SKIRTING = (0.16, 0.022)  # height and thickness
_CEILING = (0.30, 0.30, 0.295)
_WHITE = (0.62, 0.615, 0.60)
_CARD_LINE = 456  # pixels of a label's 512 that its title may take


def room_nodes(borders: NDArray[np.float64], unit: float) -> list[pyrender.Node]:
    """A room whose long wall is divided into bays.

    Each bay is a node of its own, because only the nearest lights reach a mesh.

    Parameters
    ----------
    borders : (bays + 1,) array
        Where bays begin and end along the wall, mm.
    unit : float
        Of all other lengths, mm.

    Returns
    -------
    list of pyrender.Node
    """
    plaster, oak = _textured(_plaster(), 0.95), _textured(_parquet(), 0.5)
    white, ceiling = _plain(_WHITE), _plain(_CEILING)
    nodes = []
    for left, right in pairwise(borders):
        middle, half = 0.5 * (left + right), 0.5 * (right - left) / unit
        along, away = 2 * half, DEPTH
        foot, thick = _SKIRTING
        bay = [
            _rectangle((-half, 0, 0), (along, 0, 0), (0, HEIGHT, 0), plaster, left / unit),
            _rectangle((-half, 0, away), (along, 0, 0), (0, 0, -away), oak, left / unit),
            _rectangle((-half, HEIGHT, 0), (along, 0, 0), (0, 0, away), ceiling),
            _rectangle((-half, 0, thick), (along, 0, 0), (0, foot, 0), white),
            _rectangle((-half, foot, thick), (along, 0, 0), (0, 0, -thick), white),
        ]
        nodes.append(_node(bay, middle, unit))
    ends = (
        (borders[0], _rectangle((0, 0, DEPTH), (0, 0, -DEPTH), (0, HEIGHT, 0), plaster)),
        (borders[-1], _rectangle((0, 0, 0), (0, 0, DEPTH), (0, HEIGHT, 0), plaster)),
    )
    nodes += [_node([wall], x, unit) for x, wall in ends]
    return nodes


def label_mesh(title: str, width: float) -> pyrender.Mesh:
    """A card with a title, its lower left corner at the origin, twice as wide as high; mm."""
    shown = Image.new("RGB", (512, 256), (236,) * 3)
    draw, letters = ImageDraw.Draw(shown), font(46)
    title = " ".join(title.split())
    while draw.textlength(title, font=letters) > _CARD_LINE:
        title = title.rstrip(".")[:-1] + "..."
    draw.text((28, 104), title, font=letters, fill=(40,) * 3, anchor="ls")
    card = np.array(shown)
    for row, end in ((150, 420), (182, 380), (214, 300)):
        cv2.line(card, (30, row), (end, row), (176,) * 3, 3, cv2.LINE_AA)
    paper = _textured(card, 0.9)
    part = _rectangle(
        (0, 0, 0), (width, 0, 0), (0, width / 2, 0), paper, per_tile=(width, width / 2)
    )
    return pyrender.Mesh([part])


def _node(parts: list[pyrender.Primitive], x: float, unit: float) -> pyrender.Node:
    pose = np.diag([unit, unit, unit, 1.0])
    pose[0, 3] = x
    return pyrender.Node(mesh=pyrender.Mesh(parts), matrix=pose)


def _rectangle(
    corner: tuple[float, float, float],
    right: tuple[float, float, float],
    up: tuple[float, float, float],
    material: pyrender.Material,
    shift: float = 0.0,
    per_tile: tuple[float, float] = (_TILE, _TILE),
) -> pyrender.Primitive:
    """A rectangle seen from where ``right`` is to the right and ``up`` is up.

    Textures go on from one rectangle to the next where ``shift`` is how far along it begins.
    """
    start, across, along = (np.array(vector, np.float64) for vector in (corner, right, up))
    corners = np.array([start, start + across, start + across + along, start + along])
    normal = np.cross(across, along)
    normal /= np.linalg.norm(normal)
    x = np.array([0, 1, 1, 0]) * np.linalg.norm(across) + shift
    y = np.array([0, 0, 1, 1]) * np.linalg.norm(along)
    return pyrender.Primitive(
        corners.astype(np.float32),
        normals=np.tile(normal.astype(np.float32), (4, 1)),
        texcoord_0=np.column_stack([x / per_tile[0], y / per_tile[1]]).astype(np.float32),
        indices=np.array([(0, 1, 2), (0, 2, 3)]),
        material=material,
    )


def _plain(colour: tuple[float, float, float]) -> pyrender.Material:
    return pyrender.MetallicRoughnessMaterial(
        baseColorFactor=[*colour, 1.0], metallicFactor=0.0, roughnessFactor=0.8
    )


def _textured(picture: NDArray[np.uint8], roughness: float) -> pyrender.Material:
    """A material of a picture in sRGB."""
    texture = pyrender.Texture(source=picture, source_channels="RGB")
    return pyrender.MetallicRoughnessMaterial(
        baseColorTexture=texture, metallicFactor=0.0, roughnessFactor=roughness
    )


@cache
def _plaster() -> NDArray[np.uint8]:
    """Painted plaster: one colour, and the unevenness that a roller leaves."""
    random = np.random.default_rng(1)
    uneven = np.zeros((_TEXTURE, _TEXTURE))
    for radius, share in ((1.5, 2.0), (12.0, 1.6), (60.0, 1.2)):
        noise = _periodic_blur(random.standard_normal(uneven.shape), radius, radius)
        uneven += share * noise / noise.std()
    colour = np.array([172.0, 170.5, 164.0])
    return np.clip(colour + uneven[..., np.newaxis], 0, 255).round().astype(np.uint8)


@cache
def _parquet() -> NDArray[np.uint8]:
    """Oak planks along x, each of its own tone, with grain and dark joints."""
    random = np.random.default_rng(2)
    rows, length = 16, _TEXTURE
    high = _TEXTURE // rows
    tone = np.zeros((_TEXTURE, _TEXTURE))
    joint = np.zeros_like(tone)
    for row in range(rows):
        band = slice(row * high, (row + 1) * high)
        cuts = np.sort((random.integers(0, length) + np.array([0, 450, 780])) % length)
        which = np.searchsorted(cuts, np.arange(length), side="right") % len(cuts)
        tone[band] = random.uniform(-1, 1, len(cuts))[which]
        joint[band.start] = 1.0
        joint[band, cuts] = 1.0
    grain = _periodic_blur(random.standard_normal(tone.shape), 90.0, 0.8)
    bands = _periodic_blur(random.standard_normal(tone.shape), 160.0, 4.0)
    light = 1 + 0.11 * tone + 0.05 * grain / grain.std() + 0.05 * bands / bands.std()
    light *= 1 - 0.45 * _periodic_blur(joint, 0.7, 0.7) / 0.6
    oak = np.array([132.0, 98.0, 66.0])
    return np.clip(oak * light[..., np.newaxis], 0, 255).round().astype(np.uint8)


def _periodic_blur(values: NDArray[np.float64], x: float, y: float) -> NDArray[np.float64]:
    """A Gaussian blur that lets the tile be repeated without a seam."""
    rows, cols = values.shape
    along, across = np.fft.rfftfreq(cols), np.fft.fftfreq(rows)[:, np.newaxis]
    kept = np.exp(-2 * np.pi**2 * ((x * along) ** 2 + (y * across) ** 2))
    return np.asarray(np.fft.irfft2(np.fft.rfft2(values) * kept, s=values.shape))
