r"""Systematic errors of fringe phases on a board, estimated from the board's smoothness.

Over a board the projector coordinate is a smooth function of the pixel. Whatever is not smooth is
error, and two kinds of it are the same function everywhere, so they can be fitted beside the
surface, linearly and robustly, and subtracted. Robustly means more than single pixels: blisters of
the paper are lower than a pixel's noise, and where they lie along the fringes they look like waves
of their period. Averaged over a neighbourhood they stand out, and the whole of it is left out.

The two kinds are

* **The projector's response and the light's unsteadiness.** A periodic error
  :math:`\sum a_m\cos m\varphi + b_m\sin m\varphi`: harmonics of order mN ± 1 fold onto N steps,
  and brightness that changes from frame to frame gives the orders 1 and 2.
* **Blur across edges of the texture.** A camera pixel sees its surroundings through the
  point-spread function G, and where they are brighter on one side, so the mean coordinate is drawn
  to that side. With the reflectance ρ and a coordinate that is linear over the width of G,

  .. math:: \bar x = \frac{G * (\rho x)}{G * \rho}
            = x + \nabla x \cdot \Big(\sum_i w_i\,s_i^2\,\nabla(G_i * \rho)\Big) / (G * \rho),

  exactly, if G is a sum of Gaussians of variances s². The modulation is G * ρ; it is smoothed
  further for the wide parts of G (glare), and their weights are fitted.

On a chessboard in focus the second error is ±0.2 px near every edge, as large as the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from acquisition.correspondence import AxisCoordinate, CorrespondenceMap
from acquisition.patterns import Axis
from acquisition.robust_spread import robust_sigma
from calibration.errors import CalibrationError

ORDERS = (1, 2, 3, 4, 5, 6, 9)
BLUR_WIDTHS_PX = (0.7, 1.5, 3.0, 6.0)
_DEGREE = 8
_TUKEY = 4.7
# Side of the neighbourhoods that lie on the surface as a whole or not: less than a blister.
_NEIGHBOURHOOD_PX = 12
_ROUNDS = 15
_SETTLED = 1e-4
_MOST_PIXELS = 120_000
_LEAST_PIXELS = 2_000
# Modulation below which a gradient over it is noise, over the noise of a sample.
_LEAST_MODULATION = 1.0


@dataclass(frozen=True)
class PhaseErrors:
    """What was subtracted from one axis.

    Attributes
    ----------
    orders : tuple of int
    amplitude_px : (orders,) float64 array
        Amplitude of each order of the periodic error in projector pixels.
    sigma_px : (orders,) float64 array
        Their standard errors.
    blur_px2 : (widths,) float64 array
        Second moments w·s² of the point-spread function's parts, in square camera pixels.
    blur_sigma_px2 : (widths,) float64 array
    """

    orders: tuple[int, ...]
    amplitude_px: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    blur_px2: NDArray[np.float64]
    blur_sigma_px2: NDArray[np.float64]


def compensate_phase_errors(
    correspondence: CorrespondenceMap, corners: NDArray[np.float64], *, name: str = "the view"
) -> tuple[CorrespondenceMap, dict[Axis, PhaseErrors]]:
    """Estimate periodic errors and edge bias on a board, and subtract them everywhere.

    Parameters
    ----------
    correspondence : CorrespondenceMap
        Decoded frames of the board.
    corners : (rows, columns, 2) array
        Its corners in the camera's full frame, NaN where not seen.
    name : str
        What to call the view in an error.

    Returns
    -------
    correspondence : CorrespondenceMap
    errors : dict
        :class:`PhaseErrors` by axis.

    Raises
    ------
    CalibrationError
        Too few pixels decoded on the board.
    """
    u, v, on_board = board_position(correspondence, corners)
    usable = correspondence.valid & on_board
    if usable.sum() < _LEAST_PIXELS:
        raise CalibrationError(
            f"{name}: only {int(usable.sum())} pixels of the board were decoded; check exposure "
            "and focus of the fringes"
        )
    pulls = _edge_pulls(correspondence)
    axes, errors = {}, {}
    for axis, coordinate in correspondence.axes.items():
        axes[axis], errors[axis] = _compensate_axis(coordinate, u, v, usable, pulls)
    return replace(correspondence, axes=axes), errors


def board_position(
    correspondence: CorrespondenceMap, corners: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Position on the board of every pixel, -1 to 1 over the corners, and whether it is on it.

    Parameters
    ----------
    correspondence : CorrespondenceMap
    corners : (rows, columns, 2) array
        In the camera's full frame, NaN where not seen.

    Returns
    -------
    u, v : (rows, cols) float64 arrays
    on_board : (rows, cols) bool array

    Raises
    ------
    CalibrationError
        Corners that no homography explains.
    """
    rows, columns = corners.shape[:2]
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows)), axis=-1)
    seen = np.isfinite(corners).all(axis=-1)
    homography, _ = cv2.findHomography(corners[seen] - correspondence.origin, grid[seen])
    if homography is None:
        raise CalibrationError("the corners of the board are degenerate; detect them again")
    row, col = np.indices(correspondence.shape, dtype=np.float64)
    u, v, w = (h[0] * col + h[1] * row + h[2] for h in homography)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = u / w, v / w
    margin = (1 + 1.4 / (columns - 1), 1 + 1.4 / (rows - 1))
    return u, v, (np.abs(u) < margin[0]) & (np.abs(v) < margin[1])


def _edge_pulls(
    correspondence: CorrespondenceMap,
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """∇(G_i * ρ) / (G * ρ) along columns and rows, for each width."""
    signal = np.mean([a.modulation for a in correspondence.axes.values()], axis=0)
    signal = np.nan_to_num(np.asarray(signal, np.float64))
    least = max(_LEAST_MODULATION * correspondence.noise_sigma, 1e-6)
    below = np.maximum(gaussian_filter(signal, BLUR_WIDTHS_PX[0]), least)
    pulls = []
    for width in BLUR_WIDTHS_PX:
        down, across = np.gradient(gaussian_filter(signal, width))
        pulls.append((across / below, down / below))
    return pulls


def _compensate_axis(
    axis: AxisCoordinate,
    u: NDArray[np.float64],
    v: NDArray[np.float64],
    usable: NDArray[np.bool_],
    pulls: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> tuple[AxisCoordinate, PhaseErrors]:
    usable = usable & np.isfinite(axis.coordinate)
    stride = max(1, int(np.ceil(np.sqrt(usable.sum() / _MOST_PIXELS))))
    sampled = np.zeros_like(usable)
    sampled[::stride, ::stride] = usable[::stride, ::stride]
    across, down = _slopes(axis.coordinate, sampled)
    edge = [across * a + down * d for a, d in pulls]
    observed = axis.coordinate[sampled]
    smooth = _polynomials(u[sampled], v[sampled], _DEGREE)
    waves = _waves(2 * np.pi * observed / axis.period_px)
    design = np.hstack([smooth, waves, np.stack([e[sampled] for e in edge], axis=1)])
    weight = 1 / np.sqrt(np.asarray(axis.variance[sampled], np.float64))
    row, col = np.nonzero(sampled)
    neighbourhoods = np.stack([row, col]) // _NEIGHBOURHOOD_PX
    _, member = np.unique(neighbourhoods, axis=1, return_inverse=True)
    solution, sigma = _robust_fit(design, observed, weight, member.ravel())
    start, stop = smooth.shape[1], smooth.shape[1] + waves.shape[1]
    error = np.tensordot(solution[stop:], np.stack(edge), axes=1)
    phase = 2 * np.pi * axis.coordinate / axis.period_px
    for number, order in enumerate(ORDERS):
        a, b = solution[start + 2 * number : start + 2 * number + 2]
        error += a * np.cos(order * phase) + b * np.sin(order * phase)
    periodic = solution[start:stop].reshape(-1, 2)
    found = PhaseErrors(
        ORDERS,
        np.hypot(*periodic.T),
        np.sqrt(np.mean(sigma[start:stop].reshape(-1, 2) ** 2, axis=1)),
        solution[stop:],
        sigma[stop:],
    )
    return replace(axis, coordinate=axis.coordinate - error), found


def _slopes(
    coordinate: NDArray[np.float64], sampled: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slope of the coordinate along camera columns and rows, from a quadratic over the board."""
    rows, cols = coordinate.shape
    y, x = np.indices(coordinate.shape, dtype=np.float64)
    x, y = x / cols - 0.5, y / rows - 0.5
    xs, ys = x[sampled], y[sampled]
    terms = np.stack([np.ones_like(xs), xs, ys, xs * xs, xs * ys, ys * ys], axis=1)
    c = np.linalg.lstsq(terms, coordinate[sampled], rcond=None)[0]
    return (c[1] + 2 * c[3] * x + c[4] * y) / cols, (c[2] + c[4] * x + 2 * c[5] * y) / rows


def _polynomials(
    u: NDArray[np.float64], v: NDArray[np.float64], degree: int
) -> NDArray[np.float64]:
    across = np.polynomial.legendre.legvander(u / 1.3, degree)
    down = np.polynomial.legendre.legvander(v / 1.3, degree)
    terms = [across[:, p] * down[:, q] for p in range(degree + 1) for q in range(degree + 1 - p)]
    return np.stack(terms, axis=1)


def _waves(phase: NDArray[np.float64]) -> NDArray[np.float64]:
    columns = [wave(order * phase) for order in ORDERS for wave in (np.cos, np.sin)]
    return np.stack(columns, axis=1)


def _robust_fit(
    design: NDArray[np.float64],
    observed: NDArray[np.float64],
    weight: NDArray[np.float64],
    member: NDArray[np.int_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted least squares with Tukey's function, and the solution's standard errors.

    The function is asked of each observation, and of each neighbourhood's mean; ``member`` tells
    which one an observation is of.
    """
    robust, scale = weight, np.inf
    known = np.sqrt(np.bincount(member, weight**2))
    for _ in range(_ROUNDS):
        before = scale
        weighted = design * robust[:, np.newaxis]
        normal = weighted.T @ weighted
        solution = np.linalg.lstsq(normal, weighted.T @ (observed * robust), rcond=1e-12)[0]
        residual = (observed - design @ solution) * weight
        mean = np.bincount(member, weight * residual) / known
        scale = _scale(residual)
        if abs(scale - before) < _SETTLED * scale:
            break
        robust = weight * _tukey(residual / scale) * _tukey(mean / _scale(mean))[member]
    return solution, scale * np.sqrt(np.diag(np.linalg.pinv(normal, rcond=1e-12)))


def _scale(residual: NDArray[np.float64]) -> float:
    return robust_sigma(residual) + 1e-12


def _tukey(residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Square root of Tukey's weight of a residual in standard deviations."""
    return np.clip(1 - (residual / _TUKEY) ** 2, 0, None)
