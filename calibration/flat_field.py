r"""Flat field: how a camera's answer to even light falls off over its picture.

The smooth part is vignetting: a polynomial of the squared distance from a centre that is found too,
:math:`v(r) = 1 + a_1 r^2 + a_2 r^4 + a_3 r^6` with r in half diagonals. What is left is fixed
pattern, pixel by pixel, and is told with its noise taken out. Light that falls off by itself must
have been divided out before (:class:`~calibration.lamp.Lamp` says how a lamp's does).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError

_BLOCKS = 48
_LEAST_SIDE = 16
_ROUNDS = 12
_LEAST_GAIN = 0.02
_TERMS = 3


@dataclass(frozen=True)
class FlatField:
    """A camera's fall-off.

    Attributes
    ----------
    centre : (2,) float64 array
        Column and row about which it is round.
    centre_sigma : (2,) float64 array
    coefficients : (3,) float64 array
        a_1 to a_3.
    covariance : (3, 3) float64 array
    width, height : int
        Of the picture, pixels.
    fixed_pattern : float
        Standard deviation of the pixels' sensitivity, relative, beyond vignetting and noise.
    fixed_pattern_sigma : float
    excess : float
        Mean square of what the smooth part leaves of block means over their errors.
    """

    centre: NDArray[np.float64]
    centre_sigma: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    covariance: NDArray[np.float64]
    width: int
    height: int
    fixed_pattern: float
    fixed_pattern_sigma: float
    excess: float

    @classmethod
    def of_vignetting(
        cls,
        centre: NDArray[np.float64],
        coefficients: NDArray[np.float64],
        covariance: NDArray[np.float64],
        *,
        width: int,
        height: int,
    ) -> FlatField:
        """A smooth fall-off about a known centre, without the pixels' own pattern."""
        return cls(
            np.array(centre, np.float64),
            np.zeros(2),
            coefficients,
            covariance,
            width,
            height,
            0.0,
            0.0,
            1.0,
        )

    def gain(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Answer (...) at pixels (..., 2), 1 at the centre."""
        return 1 + _powers(pixels, self.centre, self.width, self.height) @ self.coefficients

    def gain_sigma(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Its standard error (...)."""
        terms = _powers(pixels, self.centre, self.width, self.height)
        return np.sqrt(np.einsum("...i,ij,...j->...", terms, self.covariance, terms))

    def gain_picture(
        self, *, origin: tuple[int, int] = (0, 0), shape: tuple[int, int]
    ) -> NDArray[np.float32]:
        """Answer (rows, cols) of a part of the picture.

        Parameters
        ----------
        origin : (int, int)
            Column and row of its first pixel.
        shape : (int, int)
            Its rows and columns.
        """
        row, col = (np.arange(n, dtype=np.float64) for n in shape)
        grid = np.stack(np.meshgrid(col + origin[0], row + origin[1]), axis=-1)
        return self.gain(grid).astype(np.float32)

    def corrected(self, picture: NDArray[np.float64]) -> NDArray[np.float64]:
        """A picture (rows, cols[, channels]), black subtracted, without the fall-off."""
        if picture.shape[:2] != (self.height, self.width):
            raise CalibrationError(
                f"a picture of {picture.shape[1]} × {picture.shape[0]}, and the flat field is of "
                f"{self.width} × {self.height}"
            )
        col, row = np.meshgrid(np.arange(float(self.width)), np.arange(float(self.height)))
        gain = self.gain(np.stack([col, row], axis=-1))
        return np.asarray(picture / gain.reshape(gain.shape + (1,) * (picture.ndim - 2)))


def _powers(
    pixels: NDArray[np.float64], centre: NDArray[np.float64], width: int, height: int
) -> NDArray[np.float64]:
    squared = np.sum((pixels - centre) ** 2, axis=-1) / (0.25 * (width**2 + height**2))
    return np.stack([squared ** (power + 1) for power in range(_TERMS)], axis=-1)


def measure_flat_field(frames: Sequence[NDArray[np.generic]], *, black: float) -> FlatField:
    """Measure the fall-off from frames of even light.

    Parameters
    ----------
    frames : sequence of (rows, cols) arrays
        Two or more, of one light; sensor numbers of one colour, none saturated.
    black : float
        Black level.

    Raises
    ------
    CalibrationError
        Too few or too small frames, samples that are not finite, no light, or a fall-off that has
        no centre near the picture.
    """
    if len(frames) < 2:
        raise CalibrationError(f"{len(frames)} flat frames: two or more tell noise from pattern")
    if len({np.shape(frame) for frame in frames}) != 1 or np.ndim(frames[0]) != 2:
        raise CalibrationError("flat frames are pictures of one size")
    stack = np.stack([np.asarray(frame, np.float64) - black for frame in frames])
    if min(stack.shape[1:]) < _LEAST_SIDE or not np.isfinite(stack).all():
        raise CalibrationError(
            f"flat frames are finite and {_LEAST_SIDE} pixels wide and high or more"
        )
    mean = stack.mean(axis=0)
    if not np.percentile(mean, 1) > 0:
        raise CalibrationError("a hundredth of the flat frame or more is black: was there light?")
    height, width = mean.shape
    places, values, sigmas = _block_means(mean)
    numbers, covariance, excess = _fit(places, values, sigmas, width, height)
    level, centre = numbers[0], numbers[1:3]
    scale = np.diag([1.0, 1.0, *[1 / level] * _TERMS])
    shared = scale @ covariance[1:, 1:] @ scale
    field = FlatField(
        centre,
        np.sqrt(np.diagonal(shared)[:2]),
        numbers[3:] / level,
        shared[2:, 2:],
        width,
        height,
        0.0,
        0.0,
        excess,
    )
    return _with_pattern(field, stack, level)


def _block_means(
    mean: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Centres (n, 2), means and standard errors (n,) of blocks."""
    height, width = mean.shape
    size = max(4, max(height, width) // _BLOCKS)
    rows, cols = height // size, width // size
    blocks = mean[: rows * size, : cols * size].reshape(rows, size, cols, size).swapaxes(1, 2)
    flat = blocks.reshape(rows * cols, size, size)
    # Differences of neighbours: the fall-off within a block is not its scatter.
    scatter = np.diff(flat, axis=2).reshape(len(flat), -1).std(axis=1) / np.sqrt(2)
    usual = np.maximum(np.median(scatter), 1e-9) * np.ones(len(flat))
    col, row = np.meshgrid(np.arange(cols), np.arange(rows))
    places = np.stack([col.ravel(), row.ravel()], axis=1) * size + (size - 1) / 2
    return places, flat.mean(axis=(1, 2)), np.maximum(scatter, 0.3 * usual) / size


def _fit(
    places: NDArray[np.float64],
    values: NDArray[np.float64],
    sigmas: NDArray[np.float64],
    width: int,
    height: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Level, centre and level times coefficients, by Gauss and Newton."""
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    unit = 0.25 * (width**2 + height**2)
    for _ in range(_ROUNDS):
        terms = _powers(places, centre, width, height)
        linear = np.column_stack([np.ones(len(places)), terms]) / sigmas[:, np.newaxis]
        found = np.linalg.lstsq(linear, values / sigmas, rcond=None)[0]
        # Derivative of the fall-off by the squared radius, and of that by the centre.
        inner = np.column_stack([np.ones(len(places)), 2 * terms[:, 0], 3 * terms[:, 0] ** 2])
        by_centre = (inner @ found[1:])[:, np.newaxis] * (-2 * (places - centre) / unit)
        jacobian = np.column_stack(
            [linear[:, :1], by_centre / sigmas[:, np.newaxis], linear[:, 1:]]
        )
        residuals = values / sigmas - linear @ found
        step = np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
        limit = 0.1 * np.sqrt(unit)
        centre = centre + np.clip(step[1:3], -limit, limit)
        if np.abs(step[1:3]).max() < 1e-3:
            break
    if not (np.abs(centre - [width / 2, height / 2]) < [width, height]).all():
        raise CalibrationError(
            "the fall-off is not round about a point near the picture: the light was uneven"
        )
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0] = 1.0
    normal = (jacobian / scale).T @ (jacobian / scale)
    covariance = np.linalg.pinv(normal, hermitian=True) / np.outer(scale, scale)
    excess = float(residuals @ residuals) / max(len(places) - 6, 1)
    numbers = np.concatenate([found[:1], centre, found[1:]])
    return numbers, covariance * max(1.0, excess), excess


def _with_pattern(field: FlatField, stack: NDArray[np.float64], level: float) -> FlatField:
    col, row = np.meshgrid(np.arange(float(field.width)), np.arange(float(field.height)))
    gain = np.maximum(field.gain(np.stack([col, row], axis=-1)), _LEAST_GAIN) * level
    relative = stack / gain
    relative = relative / relative.mean(axis=(1, 2), keepdims=True)
    half = len(stack) // 2
    one, other = relative[:half].mean(axis=0), relative[half:].mean(axis=0)
    one, other = one - one.mean(), other - other.mean()
    # Noise of both halves is independent: what they share is the pattern.
    product = one * other
    variance = float(product.mean())
    error = float(product.std()) / np.sqrt(product.size)
    pattern = float(np.sqrt(max(variance, 0.0)))
    sigma = error / (2 * max(pattern, np.sqrt(error)))
    return replace(field, fixed_pattern=pattern, fixed_pattern_sigma=float(sigma))


def vignetting_of(
    pixels: NDArray[np.float64],
    gains: NDArray[np.float64],
    *,
    centre: NDArray[np.float64],
    width: int,
    height: int,
) -> FlatField:
    r"""Vignetting about a known centre from gains at some pixels, known up to one factor.

    Two terms of the polynomial are fitted: natural vignetting, :math:`\cos^4` of the angle from
    the axis, needs no more up to 25°. The gains' scatter about it tells the errors.

    Parameters
    ----------
    pixels : (n, 2) array
        Columns and rows.
    gains : (n,) array
        Positive.
    centre : (2,) array
        The lens's principal point.
    width, height : int
        Of the picture.

    Raises
    ------
    CalibrationError
        Too few gains, or such as are not positive.
    """
    gains = np.asarray(gains, np.float64)
    if len(gains) < 2 * _TERMS or not (np.isfinite(gains).all() and (gains > 0).all()):
        raise CalibrationError(f"{len(gains)} positive, finite gains tell no vignetting")
    terms = _powers(pixels, np.asarray(centre, np.float64), width, height)[:, :2]
    design = np.column_stack([np.ones(len(gains)), terms])
    found, *_ = np.linalg.lstsq(design, gains, rcond=None)
    variance = float(np.sum((gains - design @ found) ** 2)) / (len(gains) - 3)
    covariance = np.zeros((_TERMS, _TERMS))
    covariance[:2, :2] = variance * np.linalg.inv(design.T @ design)[1:, 1:] / found[0] ** 2
    return FlatField.of_vignetting(
        centre, np.append(found[1:] / found[0], 0.0), covariance, width=width, height=height
    )
