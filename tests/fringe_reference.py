"""Fringe decoding in plain NumPy, float64: what the compiled kernels are held against."""

from __future__ import annotations

import numpy as np

from acquisition.fringes import Fringe


def fit(
    fringe: Fringe, stack: np.ndarray, *, read: float, gain: float, black: float = 0.0
) -> dict[str, np.ndarray]:
    """Least squares per pixel: turns in [0, 1), their variance, modulation, ambient, squares."""
    steps = len(stack)
    samples = stack.reshape(steps, -1).astype(np.float64)
    shifts = fringe.shifts_rad
    design = np.stack([np.ones(steps), np.cos(shifts), -np.sin(shifts)], axis=1)
    solution = np.linalg.pinv(design)
    a, c, s = solution @ samples
    modelled = design @ np.stack([a, c, s])
    b = np.hypot(c, s)
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = (c / b) * solution[2][:, np.newaxis] - (s / b) * solution[1][:, np.newaxis]
        light = (slope**2 * (modelled - black)).sum(axis=0)
        variance = (read * (slope**2).sum(axis=0) + gain * np.maximum(light, 0)) / b**2
    turns = (np.arctan2(s, c) / (2 * np.pi) - fringe.origin_rad / (2 * np.pi)) % 1
    return {
        "turns": turns,
        "variance": variance / (2 * np.pi) ** 2,
        "modulation": b,
        "ambient": a,
        "squares": ((samples - modelled) ** 2).sum(axis=0),
        "top": samples.max(axis=0),
    }


def unwrap(
    turns: np.ndarray, near: np.ndarray, period: float, spread: np.ndarray, *, allowed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Coordinate of the order nearest to ``near``, and where it is farther off than allowed."""
    candidates = period * (np.arange(-2, 200)[:, np.newaxis] + turns)
    best = np.abs(candidates - near).argmin(axis=0)
    coordinate = np.take_along_axis(candidates, best[np.newaxis], axis=0)[0]
    return coordinate, np.abs(coordinate - near) > allowed


def gray_cells(bits: np.ndarray) -> np.ndarray:
    """Cell numbers of Gray words (bits, ...), most significant bit first."""
    cells = np.zeros(bits.shape[1:], np.int64)
    parity = np.zeros(bits.shape[1:], np.int64)
    for bit in bits:
        parity = parity ^ bit
        cells = 2 * cells + parity
    return cells


def merge(exposures: list[dict[str, np.ndarray]], saturation: float) -> tuple[np.ndarray, ...]:
    """Phase and variance of several exposures by inverse variance, saturated ones left out."""
    weight = np.stack([(e["top"] < saturation) / e["variance"] for e in exposures])
    phasor = sum(
        w * np.exp(2j * np.pi * e["turns"]) for w, e in zip(weight, exposures, strict=True)
    )
    with np.errstate(divide="ignore"):
        return (np.angle(phasor) / (2 * np.pi)) % 1, 1 / weight.sum(axis=0)
