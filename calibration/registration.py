"""Registration of photographs to a scan, through the code that the projector shows to both.

The camera of a photograph sees the same projected code as the scan did. Equal projector coordinates
are the same surface point, which gives thousands of pairs of a point in space and a pixel, without
targets (F. Larue, J.-M. Dischler, *Automatic Registration and Calibration for Efficient Surface
Light Field Acquisition*, VAST 2006). :mod:`calibration.code_pairs` makes the pairs and
:mod:`calibration.pose_fit` fits the pose; here it is decided whether to believe it.

Two covariances are told apart. That by the noise of both recordings says how well the photograph
lies on the scan, which is what texture and reflectance need. The calibration of the rig is wrong
alike for all points: its covariance moves the photograph along with the scan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.decoding import DecodingOptions, decode
from acquisition.errors import DecodingError
from acquisition.plan import Purpose
from acquisition.session import Session
from calibration.code_pairs import CodePairs, pair_by_code
from calibration.errors import RegistrationError
from calibration.lens import Lens, compose, invert, transform
from calibration.pose_fit import PoseFit, fit_pose, pixel_covariance
from calibration.rig_geometry import RigGeometry
from calibration.uncertainty import RigCovariance

# Points at which the effects of the rig's calibration, and of the pose on texture, are computed.
_SAMPLES = 400


@dataclass(frozen=True, kw_only=True)
class RegistrationOptions:
    """How photographs are registered, and what is believed.

    Attributes
    ----------
    refine_lens : bool
        Whether the photograph's lens is fitted too.
    least_pairs : int
        Pairs that must agree.
    least_share : float
        Of all the pairs, that must agree.
    agree_px : float
        Farther from where they should be seen, pairs do not agree.
    most_pairs : int
        Used of more.
    largest_turn_deg : float
        Standard error of the camera's direction that is acceptable.
    largest_shift : float
        Standard error of its place, as a share of its distance, that is acceptable.
    """

    refine_lens: bool = False
    least_pairs: int = 60
    least_share: float = 0.3
    agree_px: float = 3.0
    most_pairs: int = 20_000
    largest_turn_deg: float = 0.5
    largest_shift: float = 0.02

    def __post_init__(self) -> None:
        if self.least_pairs < 10 or self.most_pairs < self.least_pairs:
            raise RegistrationError(
                "a registration needs ten pairs or more, and may use no fewer than it needs"
            )
        if not 0 < self.least_share <= 1:
            raise RegistrationError(f"a share of pairs is in 0 to 1, not {self.least_share}")


@dataclass(frozen=True)
class RegisteredView:
    """Where a photograph was taken, relative to a scan.

    Attributes
    ----------
    lens : Lens
        Of the photograph's camera, refined if that was asked for.
    rt_cam_rig : (6,) float64 array
        Takes points of the rig's frame, that of the scan's camera, to the photograph's camera.
    covariance : (n, n) float64 array
        By the noise of both recordings: of a small turn (rad) and shift (mm) of the photograph's
        camera frame, then of the lens's parameters if it was refined.
    rig_covariance : (n, n) float64 array
        What the covariance of the rig's calibration adds; it moves the scan alike. Zero where the
        rig has none.
    pairs, inliers : int
        Pairs used, and how many agreed.
    residual_px : float
        RMS of the pairs that agreed.
    inflation : float
        By which variances were scaled, since residuals were larger than noise explains; 1 if not.
    texture_px : float
        RMS over the surface of by how many pixels an error of the pose misplaces texture.
    """

    lens: Lens
    rt_cam_rig: NDArray[np.float64]
    covariance: NDArray[np.float64]
    rig_covariance: NDArray[np.float64]
    pairs: int
    inliers: int
    residual_px: float
    inflation: float
    texture_px: float

    def rt_cam_canvas(self, rt_rig_canvas: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pose (6,) from the canvas's frame, whose pose in the rig's frame is given.

        The covariances are of the camera's frame, and hold as they are.
        """
        return compose(self.rt_cam_rig, rt_rig_canvas)

    @property
    def position(self) -> NDArray[np.float64]:
        """(3,) mm: the photograph's centre of projection in the rig's frame."""
        return np.asarray(invert(self.rt_cam_rig)[3:])

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (..., 2) of points (..., 3) in the rig's frame."""
        return self.lens.project(transform(self.rt_cam_rig, points))

    def texture_covariance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance (k, 2, 2), px², of where points (k, 3) of the rig's frame are looked up."""
        return pixel_covariance(self.lens, self.rt_cam_rig, self.covariance, points)


def register_photographs(
    session: Session,
    scan: CorrespondenceMap,
    rig: RigGeometry,
    *,
    lens: Lens | None = None,
    options: RegistrationOptions | None = None,
    decoding: DecodingOptions | None = None,
) -> dict[str | None, RegisteredView]:
    """Register every place of the camera from which a session has photographs and a code.

    Parameters
    ----------
    session : Session
        As recorded by :func:`~acquisition.photograph_plan.plan_photographs`.
    scan : CorrespondenceMap
        Decoded from the scan that gave the surface.
    rig : RigGeometry
        Of the scan.
    lens : Lens, optional
        Of the photographs' camera; by default that of the scan.
    options : RegistrationOptions, optional
    decoding : DecodingOptions, optional

    Returns
    -------
    dict of str or None to RegisteredView
        By the name of the place; None where the plan names none.

    Raises
    ------
    RegistrationError
        A place cannot be registered; the message names it.
    SessionError
        The session holds no code.
    """
    places = session.plan.camera_positions or (None,)
    found: dict[str | None, RegisteredView] = {}
    for place in places:
        plan = session.plan_of(Purpose.CODE, camera_position=place)
        try:
            photograph = decode(plan, session.read_frame, decoding)
            found[place] = register_view(photograph, scan, rig, lens=lens, options=options)
        except (DecodingError, RegistrationError) as error:
            where = "" if place is None else f" from {place!r}"
            raise RegistrationError(f"{session.path}: photographs{where}: {error}") from error
    return found


def register_view(
    photograph: CorrespondenceMap,
    scan: CorrespondenceMap,
    rig: RigGeometry,
    *,
    lens: Lens | None = None,
    options: RegistrationOptions | None = None,
) -> RegisteredView:
    """Register one place of the camera by its code.

    Parameters
    ----------
    photograph, scan : CorrespondenceMap
        Decoded, both along both axes; the projector stood still in between.
    rig : RigGeometry
        Of the scan.
    lens : Lens, optional
        Of the photograph's camera; by default that of the scan.
    options : RegistrationOptions, optional

    Returns
    -------
    RegisteredView

    Raises
    ------
    RegistrationError
        Too few pairs, none that agree, or a pose that they do not determine.
    """
    options = options or RegistrationOptions()
    lens = lens or rig.camera
    rows, cols = photograph.shape
    column, row = photograph.origin
    if column + cols > lens.width or row + rows > lens.height:
        raise RegistrationError(
            f"the photograph has pixels up to {column + cols} × {row + rows}, its lens is that of "
            f"a picture of {lens.width} × {lens.height}"
        )
    pairs = pair_by_code(photograph, scan, rig)
    if len(pairs) < options.least_pairs:
        raise RegistrationError(
            f"photograph and scan share {len(pairs)} pieces of decoded surface, and "
            f"{options.least_pairs} are needed: do they show the same part of the painting, lit by "
            "a projector that stood still?"
        )
    if len(pairs) > options.most_pairs:
        chosen = np.linspace(0, len(pairs) - 1, options.most_pairs).astype(int)
        pairs = pairs.chosen(chosen)
    fit = fit_pose(pairs, lens, refine_lens=options.refine_lens)
    _check(fit, pairs, options)
    return _view(fit, pairs, rig)


def _check(fit: PoseFit, pairs: CodePairs, options: RegistrationOptions) -> None:
    near = np.linalg.norm(fit.residuals_px, axis=1) < options.agree_px
    agree = int((fit.inliers & near).sum())
    if agree < options.least_pairs or agree < options.least_share * len(pairs):
        raise RegistrationError(
            f"only {agree} of {len(pairs)} pairs of photograph and scan agree on a pose: their "
            "codes contradict one another; was the projector or the painting moved in between, or "
            "is the lens another one?"
        )
    distance = float(np.median(np.linalg.norm(transform(fit.rt_cam_ref, pairs.points), axis=1)))
    sigma = np.sqrt(np.diagonal(fit.covariance))
    turn, shift = np.degrees(sigma[:3].max()), sigma[3:6].max() / distance
    if not (turn <= options.largest_turn_deg and shift <= options.largest_shift):
        instead = "; calibrate the lens and do not refine it" if options.refine_lens else ""
        raise RegistrationError(
            f"the {agree} pairs do not determine the pose: standard errors of {turn:.2g}° and "
            f"{100 * shift:.2g} % of the distance; show more of the surface{instead}"
        )


def _view(fit: PoseFit, pairs: CodePairs, rig: RigGeometry) -> RegisteredView:
    chosen = np.flatnonzero(fit.inliers)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), _SAMPLES)).astype(int)]
    points = pairs.points[chosen]
    spread = pixel_covariance(fit.lens, fit.rt_cam_ref, fit.covariance, points)
    residuals = fit.residuals_px[fit.inliers]
    return RegisteredView(
        lens=fit.lens,
        rt_cam_rig=fit.rt_cam_ref,
        covariance=fit.covariance,
        rig_covariance=_by_rig(fit, pairs, rig, chosen),
        pairs=len(pairs),
        inliers=int(fit.inliers.sum()),
        residual_px=float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))),
        inflation=fit.inflation,
        texture_px=float(np.sqrt(np.mean(np.trace(spread, axis1=1, axis2=2)))),
    )


def _by_rig(
    fit: PoseFit, pairs: CodePairs, rig: RigGeometry, chosen: NDArray[np.intp]
) -> NDArray[np.float64]:
    """What errors of the rig's calibration, shared by all points, do to the fit."""
    if rig.covariance is None:
        return np.zeros_like(fit.covariance)
    moves = RigCovariance(rig, rig.covariance, 0.0).point_jacobian(pairs.points[chosen])
    # Derivatives are smooth over the surface: as known at some points, by a cubic for all.
    at = _cubic(pairs.points, pairs.points)
    some = np.linalg.lstsq(at[chosen], moves.reshape(len(chosen), -1), rcond=None)[0]
    everywhere = (at @ some).reshape(len(pairs), 3, -1)
    lever = np.einsum("pnk,nkq->pq", fit.by_points, everywhere)
    return np.asarray(lever @ rig.covariance @ lever.T)


def _cubic(points: NDArray[np.float64], of: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = ((points - of.mean(axis=0)) / of.std(axis=0)).T
    plane = [x**i * y**j for i in range(4) for j in range(4 - i)]
    return np.stack([*plane, z, x * z, y * z], axis=1)
