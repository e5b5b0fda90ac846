r"""Colour: the matrix that takes a camera's linear RGB to that of a viewer, from a ColorChecker.

The chart is found in the picture by OpenCV's mcc, its 24 patches are measured in the linear picture
itself, and the matrix is fitted to the published colours of the patches by least squares, weighted
so that errors count as they are seen: about in proportion to the cube root of luminance. What it
does is told by CIEDE2000 (G. Sharma, W. Wu, E. N. Dalal, *The CIEDE2000 color-difference formula*,
Color Research and Application 30, 2005).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import robust_sigma
from calibration.errors import CalibrationError

# CIE L*a*b* (D50, 2°) of the ColorChecker Classic's patches, row by row from dark skin, as X-Rite
# published them for charts made from November 2014 on.
PATCHES_LAB = np.array(
    [
        [37.54, 14.37, 14.92],
        [64.66, 19.27, 17.50],
        [49.32, -3.82, -22.54],
        [43.46, -12.74, 22.72],
        [54.94, 9.61, -24.79],
        [70.48, -32.26, -0.37],
        [62.73, 35.83, 56.50],
        [39.43, 10.75, -45.17],
        [50.57, 48.64, 16.67],
        [30.10, 22.54, -20.87],
        [71.77, -24.13, 58.19],
        [71.51, 18.24, 67.37],
        [28.37, 15.42, -49.80],
        [54.38, -39.72, 32.27],
        [42.43, 51.05, 28.62],
        [81.80, 2.67, 80.41],
        [50.63, 51.28, -14.12],
        [49.57, -29.71, -28.32],
        [95.19, -1.03, 2.93],
        [81.29, -0.57, 0.44],
        [66.89, -0.75, -0.06],
        [50.76, -0.13, 0.14],
        [35.63, -0.46, -0.48],
        [20.64, 0.07, -0.46],
    ]
)
_NEUTRAL = slice(18, 24)
_D50 = np.array([0.96422, 1.0, 0.82521])
# Linear sRGB from XYZ under D50, by way of Bradford's adaptation (IEC 61966-2-1; B. Lindbloom).
_RGB_FROM_XYZ = np.array(
    [
        [3.1338561, -1.6168667, -0.4906146],
        [-0.9787684, 1.9161415, 0.0334540],
        [0.0719453, -0.2289914, 1.4052427],
    ]
)
# Of a patch's side, around its middle, that is measured.
_INNER = 0.5
_LEAST_PIXELS = 9


@dataclass(frozen=True)
class ChartPatches:
    """What a picture shows of a chart.

    Attributes
    ----------
    rgb : (24, 3) float64 array
        Linear.
    sigma : (24, 3) float64 array
        Standard error of each.
    corners : (24, 4, 2) float64 array
        Columns and rows.
    """

    rgb: NDArray[np.float64]
    sigma: NDArray[np.float64]
    corners: NDArray[np.float64]


@dataclass(frozen=True)
class ColourMatrix:
    """A camera's colour correction.

    Attributes
    ----------
    matrix : (3, 3) float64 array
        Linear sRGB of a column of the camera's RGB; a perfect white is 1, 1, 1.
    sigma : (3, 3) float64 array
        Standard errors, by the scatter of the patches.
    delta_e_before, delta_e_after : (24,) float64 array
        CIEDE2000 with white balance alone, and with the matrix.
    delta_e_held_out : (24,) float64 array
        Of each patch with a matrix that was fitted to the others.
    """

    matrix: NDArray[np.float64]
    sigma: NDArray[np.float64]
    delta_e_before: NDArray[np.float64]
    delta_e_after: NDArray[np.float64]
    delta_e_held_out: NDArray[np.float64]

    def apply(self, rgb: NDArray[np.float64]) -> NDArray[np.float64]:
        """Linear sRGB (..., 3) of the camera's linear RGB (..., 3)."""
        return np.asarray(rgb @ self.matrix.T)


def find_chart(picture: NDArray[np.floating], *, saturation: float = np.inf) -> ChartPatches:
    """Find a ColorChecker Classic in a picture and measure its patches.

    Parameters
    ----------
    picture : (rows, cols, 3) array
        Linear RGB, black subtracted.
    saturation : float
        Value from which a sample is saturated.

    Raises
    ------
    CalibrationError
        No chart, a patch that is too small, or one that is saturated.
    """
    import cv2

    image = np.asarray(picture, np.float64)
    if image.ndim != 3 or image.shape[2] != 3 or not np.isfinite(image).all():
        raise CalibrationError("a chart is looked for in a picture of finite linear RGB")
    top = float(np.percentile(image, 99.5))
    if not top > 0:
        raise CalibrationError("the picture of the colour chart is black")
    shown = 255 * np.clip(image / top, 0, 1) ** (1 / 2.2)
    detector = cv2.mcc.CCheckerDetector.create()
    bgr = np.ascontiguousarray(np.round(shown).astype(np.uint8)[..., ::-1])
    if not detector.process(bgr, cv2.mcc.MCC24, 1):
        raise CalibrationError(
            "no ColorChecker found in the picture: it must lie flat, unshaded and in focus, and "
            "take up a tenth of the width or more"
        )
    corners = np.asarray(detector.getBestColorChecker().getColorCharts(), np.float64)
    corners = corners.reshape(24, 4, 2)
    means, sigmas = zip(*(_measure(image, one, saturation) for one in corners), strict=True)
    return ChartPatches(np.array(means), np.array(sigmas), corners)


def _measure(
    image: NDArray[np.float64], corners: NDArray[np.float64], saturation: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    import cv2

    middle = corners.mean(axis=0)
    inner = middle + _INNER * (corners - middle)
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.fillConvexPoly(mask, np.round(inner).astype(np.int32), (1,))
    samples = image[mask.astype(bool)]
    if len(samples) < _LEAST_PIXELS:
        raise CalibrationError("the colour chart's patches are too small: come nearer")
    if (samples >= saturation).any():
        raise CalibrationError("a patch of the colour chart is saturated: expose for less time")
    # A speck of dust is no colour.
    usual = np.median(samples, axis=0)
    spread = robust_sigma(samples - usual, axis=0)
    keep = (np.abs(samples - usual) <= 4 * spread + 1e-12).all(axis=1)
    kept = samples[keep] if keep.sum() >= _LEAST_PIXELS else samples
    return kept.mean(axis=0), kept.std(axis=0, ddof=1) / np.sqrt(len(kept))


def fit_colour_matrix(
    rgb: NDArray[np.float64], *, patches_lab: NDArray[np.float64] = PATCHES_LAB
) -> ColourMatrix:
    """Fit the matrix from the camera's RGB to linear sRGB.

    Parameters
    ----------
    rgb : (24, 3) array
        Linear, of the patches in their order.
    patches_lab : (24, 3) array
        Colours of this very chart, if they were measured.

    Raises
    ------
    CalibrationError
        Not the RGB of 24 patches, or colours that determine no matrix.
    """
    rgb = np.asarray(rgb, np.float64)
    if rgb.shape != (24, 3) or not np.isfinite(rgb).all():
        raise CalibrationError("a colour matrix is fitted to finite RGB of 24 patches")
    if not (rgb[_NEUTRAL].sum(axis=0) > 0).all():
        raise CalibrationError("the chart's grey patches are black in some channel")
    xyz = xyz_of_lab(patches_lab)
    wanted = xyz @ _RGB_FROM_XYZ.T
    # The derivative of lightness by luminance: errors of dark patches are seen more.
    weight = np.maximum(xyz[:, 1], 0.02) ** (-2 / 3)
    matrix, sigma = _least_squares(rgb, wanted, weight)
    balance = np.sum(wanted[_NEUTRAL], axis=0) / np.sum(rgb[_NEUTRAL], axis=0)
    held_out = []
    for number in range(24):
        rest = np.arange(24) != number
        other, _ = _least_squares(rgb[rest], wanted[rest], weight[rest])
        held_out.append(_delta_e(rgb[number] @ other.T, patches_lab[number]))
    return ColourMatrix(
        matrix,
        sigma,
        _delta_e(rgb * balance, patches_lab),
        _delta_e(rgb @ matrix.T, patches_lab),
        np.array(held_out),
    )


def _least_squares(
    rgb: NDArray[np.float64], wanted: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    known, right = rgb * weight[:, np.newaxis], wanted * weight[:, np.newaxis]
    if np.linalg.cond(known) > 1e4:
        raise CalibrationError("the chart's colours are all alike: is it the chart, in colour?")
    normal = np.linalg.inv(known.T @ known)
    columns = normal @ (known.T @ right)
    variance = np.sum((right - known @ columns) ** 2, axis=0) / (len(rgb) - 3)
    return columns.T, np.sqrt(np.outer(variance, np.diagonal(normal)))


def _delta_e(rgb: NDArray[np.float64], lab: NDArray[np.float64]) -> NDArray[np.float64]:
    xyz = rgb @ np.linalg.inv(_RGB_FROM_XYZ).T
    return delta_e_2000(lab_of_xyz(xyz), lab)


def lab_of_xyz(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIE L*a*b* (..., 3) of XYZ (..., 3) under D50, white at Y = 1."""
    share = xyz / _D50
    limit = 6 / 29
    f = np.where(share > limit**3, np.cbrt(np.maximum(share, 0)), share / (3 * limit**2) + 4 / 29)
    lightness = 116 * f[..., 1] - 16
    return np.stack(
        [lightness, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1
    )


def xyz_of_lab(lab: NDArray[np.float64]) -> NDArray[np.float64]:
    """XYZ (..., 3) under D50 of CIE L*a*b* (..., 3)."""
    y = (lab[..., 0] + 16) / 116
    f = np.stack([y + lab[..., 1] / 500, y, y - lab[..., 2] / 200], axis=-1)
    limit = 6 / 29
    return np.asarray(_D50 * np.where(f > limit, f**3, 3 * limit**2 * (f - 4 / 29)))


def linear_rgb_of_lab(lab: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear sRGB (..., 3) of CIE L*a*b* (..., 3) under D50."""
    return np.asarray(xyz_of_lab(lab) @ _RGB_FROM_XYZ.T)


def delta_e_2000(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIEDE2000 between colours (..., 3) of L*a*b*, with all weights 1."""
    chroma = np.hypot(one[..., 1], one[..., 2]), np.hypot(other[..., 1], other[..., 2])
    seventh = ((chroma[0] + chroma[1]) / 2) ** 7
    stretch = 1.5 - 0.5 * np.sqrt(seventh / (seventh + 25.0**7))
    a1, a2 = stretch * one[..., 1], stretch * other[..., 1]
    c1, c2 = np.hypot(a1, one[..., 2]), np.hypot(a2, other[..., 2])
    h1 = np.degrees(np.arctan2(one[..., 2], a1)) % 360
    h2 = np.degrees(np.arctan2(other[..., 2], a2)) % 360
    grey = c1 * c2 == 0
    turn = np.where(grey, 0.0, (h2 - h1 + 180) % 360 - 180)
    lightness, chroma_step = other[..., 0] - one[..., 0], c2 - c1
    hue_step = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2))
    mean_l, mean_c = (one[..., 0] + other[..., 0]) / 2, (c1 + c2) / 2
    mean_h = np.where(grey, h1 + h2, (h1 + turn / 2) % 360)
    tone = 1 - 0.17 * np.cos(np.radians(mean_h - 30)) + 0.24 * np.cos(np.radians(2 * mean_h))
    tone += 0.32 * np.cos(np.radians(3 * mean_h + 6)) - 0.20 * np.cos(np.radians(4 * mean_h - 63))
    square = (mean_l - 50) ** 2
    scale_l = 1 + 0.015 * square / np.sqrt(20 + square)
    scale_c, scale_h = 1 + 0.045 * mean_c, 1 + 0.015 * mean_c * tone
    seventh = mean_c**7
    blue = np.radians(60 * np.exp(-(((mean_h - 275) / 25) ** 2)))
    skew = -2 * np.sqrt(seventh / (seventh + 25.0**7)) * np.sin(blue)
    dl, dc, dh = lightness / scale_l, chroma_step / scale_c, hue_step / scale_h
    return np.asarray(np.sqrt(np.maximum(dl**2 + dc**2 + dh**2 + skew * dc * dh, 0)))
