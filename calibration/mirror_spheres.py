r"""Mirror spheres: where they are, by their outlines, and where light comes from, by highlights.

The outline of a sphere with centre C and radius R is a cone of viewing rays d with
:math:`\hat d \cdot \hat C = \sqrt{1 - R^2/|C|^2}`, which is linear in
:math:`w = \hat C / \sqrt{1 - R^2/|C|^2}`: the rays of its edge satisfy :math:`\hat d \cdot w = 1`.
A highlight is where the ray of its pixel, reflected at the sphere, meets the lamp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import robust_sigma, robust_spread
from calibration.errors import CalibrationError
from calibration.lens import Lens

_RAYS = 240
_LEAST_EDGES = 24
# Of the radius in pixels, how far from a first guess the edge is looked for.
_SEARCH = 0.12
# Between samples of an edge's profile, and the deviation in samples by which it is smoothed.
_SAMPLE_PX = 0.5
_SMOOTHING = 1.5
_OUTLIER = 4.0
_ROUNDS = 5
_STEP_PX = 0.01
# Of a highlight's height, where it ends.
_SPOT_LEVEL = 0.2
# Standard error of its middle times the root of its pixels.
_SPOT_SIGMA = 0.2
_LEAST_SIGMA_PX = 0.005
# Pixels of a spot whose profile is not fitted: its edge tells as much.
_LARGE_SPOT = 150
_LEAST_SAMPLES = 16
# By which a spot's profile differs from the one that is fitted, relative.
_PROFILE_ERROR = 0.05


@dataclass(frozen=True)
class MirrorSphere:
    """A sphere before the camera.

    Attributes
    ----------
    centre : (3,) float64 array
        In the camera's frame, mm.
    radius_mm : float
    covariance : (3, 3) float64 array
        Of the centre, mm².
    outline_px : float
        RMS by which its edge misses a sphere's outline.
    """

    centre: NDArray[np.float64]
    radius_mm: float
    covariance: NDArray[np.float64]
    outline_px: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.centre).all() and self.centre[2] > self.radius_mm > 0):
            raise CalibrationError(
                f"a sphere of radius {self.radius_mm} mm at {self.centre} is not before the camera"
            )

    def reflect(
        self, rays: NDArray[np.float64], *, centre: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where viewing rays (n, 3) meet the sphere, and where they go from there.

        Parameters
        ----------
        rays : (n, 3) array
        centre : (3,) array, optional
            Of a sphere moved a little.

        Returns
        -------
        points, directions : (n, 3) float64 arrays
            Unit directions; NaN for rays that miss it.
        """
        middle = self.centre if centre is None else centre
        along = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        near = along @ middle
        under = near**2 - middle @ middle + self.radius_mm**2
        reach = near - np.sqrt(np.where(under >= 0, under, np.nan))
        points = reach[..., np.newaxis] * along
        normals = (points - middle) / self.radius_mm
        return points, along - 2 * np.sum(along * normals, axis=-1, keepdims=True) * normals


def sphere_from_outline(
    edges: NDArray[np.float64], lens: Lens, *, radius_mm: float
) -> MirrorSphere:
    """The sphere whose outline passes through pixels, without those that lie far off it.

    Parameters
    ----------
    edges : (n, 2) array
        Columns and rows, sub-pixel, in their order about the sphere: neighbours err alike.
    lens : Lens
    radius_mm : float

    Raises
    ------
    CalibrationError
        Too few edges, or none of them on an outline.
    """
    edges = np.asarray(edges, np.float64)
    edges = edges[np.isfinite(edges).all(axis=1)]
    if not (np.isfinite(radius_mm) and radius_mm > 0):
        raise CalibrationError(f"a sphere has a positive radius, not {radius_mm} mm")
    rays = lens.unproject(edges)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    use = np.isfinite(rays).all(axis=1)
    for _ in range(_ROUNDS):
        if use.sum() < _LEAST_EDGES:
            raise CalibrationError(
                f"{int(use.sum())} edges of a sphere agree, {_LEAST_EDGES} are needed: put it "
                "before an even background, wholly in the picture and in focus"
            )
        w, *_ = np.linalg.lstsq(rays[use], np.ones(int(use.sum())), rcond=None)
        off = rays @ w - 1
        spread = robust_spread(off[use])
        kept = np.abs(off) <= _OUTLIER * max(spread, 1e-12)
        if (kept == use).all():
            break
        use = kept
    length = float(np.linalg.norm(w))
    if not length > 1 + 1e-9:
        raise CalibrationError("the edges do not form the outline of a sphere")

    def centre_of(w: NDArray[np.float64]) -> NDArray[np.float64]:
        size = np.linalg.norm(w)
        return np.asarray(w / size * radius_mm / np.sqrt(1 - 1 / size**2))

    variance = float(np.sum(off[use] ** 2)) / (int(use.sum()) - 3) * _correlation(off[use])
    of_w = variance * np.linalg.inv(rays[use].T @ rays[use])
    step = 1e-7 * length
    jacobian = np.stack(
        [(centre_of(w + d) - centre_of(w - d)) / (2 * step) for d in np.eye(3) * step], axis=1
    )
    # Off the cone by ``off`` is off the outline by that over the sine of its opening.
    sine = np.sqrt(1 - 1 / length**2)
    outline = float(np.sqrt(np.mean(off[use] ** 2))) / (sine * length) * float(lens.focal_px.mean())
    return MirrorSphere(centre_of(w), radius_mm, jacobian @ of_w @ jacobian.T, outline)


def _correlation(off: NDArray[np.float64]) -> float:
    """By which the variance of a mean of residuals (n,) about a circle exceeds that of noise.

    Pixels of the edge serve several lines, and their steps repeat: neighbours err alike. The sum of
    the correlations is taken to where it is lost in noise (Geyer 1992, initial positive sequence).
    """
    power = np.abs(np.fft.rfft(off - off.mean())) ** 2
    correlation = np.fft.irfft(power, len(off))
    correlation = correlation / max(float(correlation[0]), 1e-300)
    total, half = 1.0, len(off) // 2
    for lag in range(1, half - 1, 2):
        pair = float(correlation[lag] + correlation[lag + 1])
        if pair <= 0:
            break
        total += 2 * pair
    return total


def find_outline(
    picture: NDArray[np.generic], *, near: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Edges of a sphere, to a fraction of a pixel, along lines from its middle.

    Parameters
    ----------
    picture : (rows, cols) array
    near : (float, float, float)
        Column and row of the sphere's middle, and its radius, in pixels, to a tenth of the radius.

    Returns
    -------
    (n, 2) float64 array
        Columns and rows; lines on which no edge stands out are left out.
    """
    from scipy.ndimage import gaussian_filter1d, map_coordinates

    image = np.asarray(picture, np.float64)
    if image.ndim != 2 or not np.isfinite(image).all():
        raise CalibrationError("a sphere is looked for in a grey picture of finite numbers")
    column, row, radius = near
    if not (np.isfinite(near).all() and radius > 4):
        raise CalibrationError(f"a sphere of {radius} pixels is too small for its outline")
    turn = np.linspace(0, 2 * np.pi, _RAYS, endpoint=False)
    away = np.arange(radius * (1 - _SEARCH), radius * (1 + _SEARCH), _SAMPLE_PX)
    cols = column + away * np.cos(turn)[:, np.newaxis]
    rows = row + away * np.sin(turn)[:, np.newaxis]
    profile = map_coordinates(image, [rows, cols], order=1, mode="constant", cval=np.nan)
    slope = np.abs(np.gradient(gaussian_filter1d(profile, _SMOOTHING, axis=1), axis=1))
    slope = np.nan_to_num(slope, nan=0.0)
    peak = slope[:, 2:-2].argmax(axis=1) + 2
    line = np.arange(_RAYS)
    before, at, after = (slope[line, peak + k] for k in (-1, 0, 1))
    bend = before - 2 * at + after
    clear = (bend < 0) & (at > 4 * np.median(slope, axis=1)) & (at > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        place = away[peak] + _SAMPLE_PX * (0.5 * (before - after) / bend)
        # A Gaussian's top is bent by its height over its variance, between samples a little less.
        width = -(_SAMPLE_PX**2) * (at / bend + 0.25)
    # Of a blurred disc the steepest place is within its edge, by half the variance times curvature.
    blur = np.median(width[clear]) - (_SAMPLE_PX * _SMOOTHING) ** 2 if clear.any() else 0.0
    place = place + max(float(blur), 0.0) / (2 * radius)
    found = np.stack([column + place * np.cos(turn), row + place * np.sin(turn)], axis=1)
    return found[clear]


def find_highlight(
    picture: NDArray[np.generic], *, inside: tuple[float, float, float], saturation: float
) -> tuple[NDArray[np.float64], float]:
    """The middle of the brightest spot on a sphere.

    Parameters
    ----------
    picture : (rows, cols) array
        Sensor numbers.
    inside : (float, float, float)
        Column and row of the sphere's middle, and its radius, pixels.
    saturation : float
        Sensor number from which samples are saturated.

    Returns
    -------
    pixel : (2,) float64 array
        Column and row.
    sigma_px : float
        Its standard error on either axis.

    Raises
    ------
    CalibrationError
        No spot, several alike, or one at the sphere's edge.
    """
    from scipy.ndimage import center_of_mass, label

    image = np.asarray(picture, np.float64)
    column, row, radius = inside
    rows, cols = np.indices(image.shape)
    disc = np.hypot(cols - column, rows - row) < 0.97 * radius
    if not disc.any() or not np.isfinite(image[disc]).all():
        raise CalibrationError("no finite picture of the sphere where it was said to be")
    floor = float(np.median(image[disc]))
    noise = robust_sigma(image[disc] - floor)
    top = min(float(image[disc].max()), saturation)
    level = floor + _SPOT_LEVEL * (top - floor)
    if top - floor < 12 * max(noise, 1e-12):
        raise CalibrationError("no highlight stands out on the sphere: is the lamp lit?")
    spots, count = label(disc & (image >= level))
    sizes = np.bincount(spots.ravel(), minlength=count + 1)[1:]
    largest = int(sizes.argmax()) + 1
    if count > 1 and np.sort(sizes)[-2] > 0.5 * sizes.max():
        raise CalibrationError(
            f"{count} highlights on the sphere: cover every other light and what reflects it"
        )
    # Weights that vanish at the spot's edge: pixels there do not matter whole or not at all.
    weight = np.where(spots == largest, np.minimum(image, saturation) - level, 0.0)
    middle = center_of_mass(weight)
    pixel = np.array([middle[1], middle[0]])
    size = float(sizes.max())
    if np.hypot(*(pixel - [column, row])) > 0.93 * radius:
        raise CalibrationError("the highlight is at the edge of the sphere, where it is distorted")
    fitted = _fit_spot(np.where(disc, image, np.nan), pixel, size, saturation, floor, noise, inside)
    if fitted is not None:
        return fitted
    return pixel, float(max(_LEAST_SIGMA_PX, _SPOT_SIGMA / np.sqrt(size)))


def _fit_spot(
    image: NDArray[np.float64],
    pixel: NDArray[np.float64],
    size: float,
    saturation: float,
    floor: float,
    noise: float,
    inside: tuple[float, float, float],
) -> tuple[NDArray[np.float64], float] | None:
    """Middle of a small spot by an elliptic Moffat profile, and its error; None if it is none.

    The profile, (1 + r²)^-β, is that of stars and of rough mirrors (A. F. J. Moffat, 1969), with r
    in the directions of the sphere's normals: a rough mirror's lobe and the picture of a lamp are
    alike to all sides there, and in pixels they are pressed together towards the sphere's edge,
    which pulls their middle inwards.
    """
    from scipy.optimize import least_squares

    if size > _LARGE_SPOT:
        return None
    reach = np.ceil(1.6 * np.sqrt(size / np.pi) + 2)
    rows, cols = np.indices(image.shape)
    known = np.isfinite(image) & (image < saturation)
    known &= np.hypot(cols - pixel[0], rows - pixel[1]) <= reach
    if known.sum() < _LEAST_SAMPLES:
        return None
    at = np.stack([cols[known], rows[known]], axis=1)
    tangent = _TangentPlane.at(pixel, inside)
    (x, y), facing = tangent.coordinates(at), tangent.facing(at)
    # What a rough mirror sends is its lobe's density over the cosine of the viewing angle.
    seen = (image[known] - floor) * facing
    top = float(seen.max())
    error = np.hypot(max(noise, 1e-3 * top), _PROFILE_ERROR * np.maximum(seen, 0))
    width = np.sqrt(size / np.pi) / 1.3

    def profile(p: NDArray[np.float64]) -> NDArray[np.float64]:
        u, v = x - p[0], y - p[1]
        along, across = (p[4] * u + p[5] * v), p[6] * v
        return np.asarray(p[2] * (1 + along**2 + across**2) ** -p[3])

    start = np.array([0, 0, top, 2.0, 1 / width, 0, 1 / width])
    low = np.array([-reach, -reach, 0.1 * top, 1.0, 0.05, -5.0, 0.05])
    high = np.array([reach, reach, 1e4 * top, 8.0, 5.0, 5.0, 5.0])
    found = least_squares(
        lambda p: (profile(p) - seen) / error,
        start,
        bounds=(low, high),
        x_scale=np.abs(start) + 0.1,
    )
    freedom = len(seen) - len(start)
    excess = 2 * found.cost / freedom
    covariance = np.linalg.pinv(found.jac.T @ found.jac, hermitian=True)[:2, :2] * max(excess, 1.0)
    sigma = float(np.sqrt(0.5 * np.trace(covariance)))
    if not (found.success and sigma < _SPOT_SIGMA / np.sqrt(size)):
        return None
    return tangent.pixel(found.x[:2]), max(_LEAST_SIGMA_PX, sigma)


@dataclass(frozen=True)
class _TangentPlane:
    """Normals about one of a sphere's, in pixels across the sphere's middle.

    Attributes
    ----------
    middle : (2,) float64 array
        Of the sphere, pixels.
    radius : float
        Pixels.
    axes : (3, 3) float64 array
        Rows: towards the sphere's edge, along it, and the normal; z is towards the camera.
    """

    middle: NDArray[np.float64]
    radius: float
    axes: NDArray[np.float64]

    @classmethod
    def at(cls, pixel: NDArray[np.float64], circle: tuple[float, float, float]) -> _TangentPlane:
        middle, radius = np.array(circle[:2]), circle[2]
        normal = _normals((pixel - middle) / radius)
        out = normal[:2] / max(float(np.linalg.norm(normal[:2])), 1e-9)
        if not out.any():
            out = np.array([1.0, 0.0])
        along = np.array([-out[1], out[0], 0.0])
        return cls(middle, radius, np.stack([np.cross(along, normal), along, normal]))

    def coordinates(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """(2, n) coordinates of pixels (n, 2), 0 in the plane's middle."""
        turned = _normals((pixels - self.middle) / self.radius) @ self.axes.T
        return np.asarray(self.radius * (turned[:, :2] / turned[:, 2:]).T)

    def facing(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cosines (n,) of normals against the camera, over that of the middle."""
        return np.asarray(_normals((pixels - self.middle) / self.radius)[:, 2] / self.axes[2, 2])

    def pixel(self, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixel (2,) of coordinates (2,)."""
        normal = np.r_[coordinates / self.radius, 1.0] @ self.axes
        return np.asarray(self.middle + self.radius * normal[:2] / np.linalg.norm(normal))


def _normals(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normals (..., 3) of a sphere, seen from afar, at offsets (..., 2) in radii; inside of it."""
    offset = np.asarray(offset, np.float64)
    length = np.linalg.norm(offset, axis=-1, keepdims=True)
    offset = offset * np.minimum(1.0, 0.999 / np.maximum(length, 1e-9))
    up = np.sqrt(1 - np.sum(offset**2, axis=-1, keepdims=True))
    return np.concatenate([offset, up], axis=-1)


def highlight_direction_sigma(
    sphere: MirrorSphere, lens: Lens, pixel: NDArray[np.float64], sigma_px: float
) -> float:
    """Standard error, rad, of the direction that a highlight tells, by that of its pixel."""
    steps = np.asarray(pixel) + np.array([[0, 0], [_STEP_PX, 0], [0, _STEP_PX]])
    _, directions = sphere.reflect(lens.unproject(steps))
    moved = np.linalg.norm(directions[1:] - directions[0], axis=1) / _STEP_PX
    return float(np.sqrt(np.mean(moved**2)) * sigma_px)
