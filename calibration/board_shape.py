r"""The shape of a real board: where its corners are, off the plane and off the grid.

A printed board is no ideal grid: paper blisters, printers stretch. Left in the observations, that
shape is taken for noise or, worse, for lens distortion. Every view sees the same shape, so it can
be told apart: with the lenses and poses held, each corner's displacement :math:`\delta` follows
from its residuals in all views and lenses by linear least squares,

.. math:: \delta = \Big(\sum w^2 J^T J + \Lambda\Big)^{-1} \sum w^2 J^T r,

and what it does to the pixels is taken out of the observations before the lenses are solved again
(Strobl & Hirzinger 2011, "More accurate pinhole camera calibration with imperfect planar target").
The scale and plane of :math:`\delta` and its parabolic bow are removed: those are the board's
nominal size, its pose and mrcal's warp. Its shear and the difference of scale along rows and
columns stay: paper is seldom printed square, and a thousandth of shear is else taken for focal
lengths and centres. The prior :math:`\Lambda` is the inverse of the displacements' own variance,
which shrinks them to nothing on a good board.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.board_views import BoardView
from calibration.errors import CalibrationError
from calibration.lens import compose, rotation, transform
from calibration.mrcal_solution import LensSolution
from calibration.mrcal_solve import resolve

_ROUNDS = 30
# Change of the displacements that is left, over their standard errors.
_SETTLED = 0.02
_LEAST_EQUATIONS = 8


@dataclass(frozen=True)
class BoardShape:
    """Displacements of a board's corners from the grid, bow apart.

    Attributes
    ----------
    displacement_mm : (rows, columns, 3) float64 array
        In the board's frame; zero where a corner was seen too seldom.
    sigma_mm : (rows, columns, 3) float64 array
        Standard errors.
    """

    displacement_mm: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]

    @property
    def rms_mm(self) -> NDArray[np.float64]:
        """(3,) root mean square displacement along the board's axes."""
        return np.sqrt(np.mean(self.displacement_mm**2, axis=(0, 1)))


def solve_with_shape(
    solution: LensSolution, views: list[BoardView]
) -> tuple[LensSolution, BoardShape]:
    """Solve lenses, poses and the shape of the board in turn until they settle.

    Parameters
    ----------
    solution : LensSolution
        Of the views with a flat or bowed board.
    views : list of BoardView
        What it was solved from.

    Returns
    -------
    solution : LensSolution
        Its observations have the shape taken out.
    shape : BoardShape

    Raises
    ------
    CalibrationError
        Fewer views than tell a shape from noise.
    """
    if len(views) < 3:
        raise CalibrationError("the shape of a board takes three views at least")
    parameters = 0
    shape = BoardShape(*np.zeros((2, *solution.board_points.shape)))
    last: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    for _ in range(_ROUNDS):
        found, parameters = _shape(solution, views)
        change = found.displacement_mm - shape.displacement_mm
        shape = replace(found, displacement_mm=_accelerated(found.displacement_mm, change, last))
        last = found.displacement_mm, change
        solution = resolve(solution, _flattened(solution, views, shape))
        if np.sum(change**2) < _SETTLED**2 * np.sum(shape.sigma_mm**2):
            break
    return _with_parameters(solution, parameters), shape


def _accelerated(
    found: NDArray[np.float64],
    change: NDArray[np.float64],
    last: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
) -> NDArray[np.float64]:
    """The secant step of a fixed-point iteration (Anderson 1965, of depth one).

    Shear and lenses explain much of one another, so that solving them in turn alone creeps.
    """
    if last is None:
        return found
    difference = change - last[1]
    share = np.sum(change * difference) / max(float(np.sum(difference**2)), 1e-30)
    return np.asarray(found - share * (found - last[0]))


def align_turned_views(solution: LensSolution, views: list[BoardView]) -> list[BoardView]:
    """Count corners of a symmetric board from the same end in every view.

    A chessboard of odd size looks the same turned by half a turn, so its corners may be counted
    from either end; its shape tells. Views are turned to agree with the first.
    """
    if len({view.pixels[0].shape for view in views}) != 1:
        raise CalibrationError("views of different boards cannot be compared")
    heights = [_height(solution, view, n) for n, view in enumerate(views)]
    total = np.nan_to_num(heights[0])
    aligned = [views[0]]
    for view, height in zip(views[1:], heights[1:], strict=True):
        height = np.nan_to_num(height)
        turn = np.sum(total * height[::-1, ::-1]) > np.sum(total * height)
        total = total + (height[::-1, ::-1] if turn else height)
        aligned.append(view.turned() if turn else view)
    return aligned


def _height(solution: LensSolution, view: BoardView, number: int) -> NDArray[np.float64]:
    """Height of each corner off the board's plane as one view sees it, slow shape removed."""
    if solution.residuals_px.shape[1] < 2:
        return np.full(solution.board_points.shape[:2], np.nan)
    normal, right = _normal_equations(solution, [view], views=[number])
    good = np.linalg.cond(normal) < 1e8
    height = np.full(good.shape, np.nan)
    height[good] = np.linalg.solve(normal[good], right[good][..., np.newaxis])[..., 2, 0]
    slow = _monomials(height.shape, 2)
    seen = np.isfinite(height.ravel())
    if seen.sum() <= slow.shape[1]:
        return height
    fit = np.linalg.lstsq(slow[seen], height.ravel()[seen], rcond=None)[0]
    return height - (slow @ fit).reshape(height.shape)


def _shape(solution: LensSolution, views: list[BoardView]) -> tuple[BoardShape, int]:
    normal, right = _normal_equations(solution, views, views=list(range(len(views))))
    equations = 2 * solution.inliers.sum(axis=(0, 1))
    told = (equations >= _LEAST_EQUATIONS) & (np.linalg.cond(normal) < 1e10)
    displacement = np.zeros((*told.shape, 3))
    covariance = np.zeros((*told.shape, 3, 3))
    if not told.any():
        return BoardShape(displacement, displacement.copy()), 0
    askew = _askew(normal[told], right[told], told)
    right[told] -= np.einsum("nab,nb->na", normal[told], askew)
    noise = solution.sigma0**2
    prior = np.full(3, np.inf)
    for _ in range(10):
        full = normal[told] + np.diag(noise / prior)
        inverse = np.linalg.inv(full)
        displacement[told] = (inverse @ right[told][..., np.newaxis])[..., 0]
        displacement = _without_slow(displacement, told)
        covariance[told] = noise * inverse
        # The displacements' variance is what they show and what the prior hides of it.
        own = np.mean(displacement[told] ** 2, axis=0)
        own += np.mean(np.diagonal(covariance[told], axis1=-2, axis2=-1), axis=0)
        if np.isinf(prior).all():
            own = np.maximum(own - 2 * np.mean(np.diagonal(covariance[told], 0, -2, -1), 0), 1e-12)
        prior = own
    displacement[told] += askew
    # Effective number of parameters: the trace of the smoother.
    parameters = float(np.trace(normal[told] @ np.linalg.inv(full), axis1=-2, axis2=-1).sum())
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return BoardShape(displacement, sigma), round(parameters)


def _askew(
    normal: NDArray[np.float64], right: NDArray[np.float64], told: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """What shear and stretch alone explain, (corners, 3): no prior says that they are small."""
    places = np.argwhere(told)[:, ::-1].astype(np.float64)
    terms = np.zeros((len(places), 3, 2))
    if len(places) <= 4:
        return terms[..., 0]
    terms[:, :2] = shears(places)
    inner = np.einsum("nai,nab,nbj->ij", terms, normal, terms)
    found = np.linalg.lstsq(inner, np.einsum("nai,na->i", terms, right), rcond=1e-12)[0]
    return np.asarray(terms @ found)


def _normal_equations(
    solution: LensSolution, observed: list[BoardView], *, views: list[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    points = solution.board_points
    normal = np.zeros((*points.shape[:2], 3, 3))
    right = np.zeros((*points.shape[:2], 3))
    for view, number in zip(observed, views, strict=True):
        for k, lens in enumerate(solution.lenses):
            pose = compose(solution.rt_lens_ref[k], solution.rt_ref_board[number])
            pixels, gradient = lens.project_with_gradient(transform(pose, points))
            gradient = gradient @ rotation(pose)
            used = solution.inliers[number, k]
            weight = np.where(used, 1 / view.sigma_px[k], 0.0) ** 2
            residual = np.where(used[..., None], view.pixels[k] - pixels, 0.0)
            normal += np.einsum("rc,rcia,rcib->rcab", weight, gradient, gradient)
            right += np.einsum("rc,rcia,rci->rca", weight, gradient, residual)
    return normal, right


def _flattened(
    solution: LensSolution, views: list[BoardView], shape: BoardShape
) -> list[BoardView]:
    points = solution.board_points
    moved = solution.project_board(points + shape.displacement_mm) - solution.project_board(points)
    return [view.moved(-shift) for view, shift in zip(views, moved, strict=True)]


def similarities(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Displacements in the board's plane that are none: shifts, a turn and a change of scale.

    The first three are the board's pose, the last its nominal size. Shear and a difference of scale
    along rows and columns are the print's own: every view sees them alike.

    Parameters
    ----------
    places : (n, 2) array
        Of the corners, in any unit.

    Returns
    -------
    (n, 2, 4) float64 array
        Orthonormal over all the numbers of a displacement.
    """
    x, y = (places - places.mean(axis=0)).T
    one, nothing = np.ones_like(x), np.zeros_like(x)
    terms = np.array([[one, nothing, x, -y], [nothing, one, y, x]]).transpose(2, 0, 1)
    return np.linalg.qr(terms.reshape(-1, 4))[0].reshape(terms.shape)


def shears(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Displacements by which a board is printed askew: shear, and rows stretched against columns.

    Returns
    -------
    (n, 2, 2) float64 array
        Orthonormal, as of :func:`similarities`.
    """
    x, y = (places - places.mean(axis=0)).T
    terms = np.array([[y, x], [x, -y]]).transpose(2, 0, 1)
    return np.linalg.qr(terms.reshape(-1, 2))[0].reshape(terms.shape)


def _without_slow(
    displacement: NDArray[np.float64], told: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Displacements without what scale, pose and bow of the board stand for."""
    cleaned = displacement.copy()
    flat = displacement[told]
    if len(flat) > 4:
        places = np.argwhere(told)[:, ::-1].astype(np.float64)
        same = similarities(places).reshape(-1, 4)
        plane = flat[:, :2].ravel()
        flat[:, :2] = (plane - same @ (same.T @ plane)).reshape(-1, 2)
    bow = np.delete(_monomials(told.shape, 2), 4, axis=1)[told.ravel()]  # the twist stays
    if len(flat) > bow.shape[1]:
        flat[:, 2] -= bow @ np.linalg.lstsq(bow, flat[:, 2], rcond=None)[0]
    cleaned[told] = flat
    return cleaned


def _monomials(shape: tuple[int, ...], degree: int) -> NDArray[np.float64]:
    """1, u, v and, of degree 2, u², uv, v² over the corners, (corners, terms)."""
    v, u = (a.ravel() for a in np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij"))
    terms = [np.ones_like(u), u, v]
    if degree == 2:
        terms += [u * u, u * v, v * v]
    return np.stack(terms, axis=1)


def _with_parameters(solution: LensSolution, parameters: int) -> LensSolution:
    """The solution with the shape's parameters counted in its ``sigma0``."""
    left = max(1, solution.degrees - parameters)
    sigma0 = solution.sigma0 * float(np.sqrt(solution.degrees / left))
    return replace(solution, sigma0=sigma0, degrees=left)
