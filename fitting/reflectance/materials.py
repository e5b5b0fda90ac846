"""Materials: what the texels of one kind of paint have in common, as priors of the solver."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FittingError
from fitting.reflectance.batch_kernels import MaterialTable
from fitting.reflectance.lobe import LobeVariant

Floats = NDArray[np.float64]

EXPONENT_RANGE = (1.0, 3000.0)
RATIO_RANGE = (0.4, 2.5)
_HELD = 1e8  # precision of a shape parameter that a variant does not free


def shape_bounds() -> Floats:
    """Ranges of ln k, ln r and ln c, (3, 2)."""
    return np.log(np.array([EXPONENT_RANGE, RATIO_RANGE, RATIO_RANGE]))


def _neutral_shape() -> Floats:
    return np.array([math.log(30.0), 0.0, 0.0])


@dataclass(frozen=True, kw_only=True)
class Material:
    """Prior of the texels of one material.

    Attributes
    ----------
    variant : LobeVariant
        Which shape parameters the texels' lobes have.
    shape_mean : (3,) array
        Of ln k, ln r, ln c.
    shape_covariance : (3, 3) array or None
        None: nothing is known of the lobe.
    specular_mean : (3,) array
        Of ρ_s, 1/sr.
    specular_sd : (3,) array or None
        None: nothing is known of the highlight's strength.
    misfit_floor : float
        What the model itself is off by, as radiance over irradiance: added in quadrature to the
        samples' own error.
    misfit_relative : float
        The same as a share of the sample's radiance.
    """

    variant: LobeVariant = LobeVariant.FREE
    shape_mean: Floats = field(default_factory=_neutral_shape)
    shape_covariance: Floats | None = None
    specular_mean: Floats = field(default_factory=lambda: np.zeros(3))
    specular_sd: Floats | None = None
    misfit_floor: float = 0.0
    misfit_relative: float = 0.0

    @property
    def shape_precision(self) -> Floats:
        """Inverse covariance of the free parameters; what is not free is held at the mean."""
        precision = np.zeros((3, 3))
        if self.shape_covariance is not None:
            free = int(self.variant)
            precision[:free, :free] = np.linalg.inv(self.shape_covariance[:free, :free])
            for p in range(free, 3):
                precision[p, p] = _HELD
        return precision

    @property
    def specular_precision(self) -> Floats:
        """Inverse variance of ρ_s per channel."""
        if self.specular_sd is None:
            return np.zeros(3)
        return 1.0 / np.asarray(self.specular_sd, dtype=np.float64) ** 2


def material_table(materials: list[Material]) -> MaterialTable:
    """Rows of the compiled solver, one per material.

    Raises
    ------
    FittingError
        A material's numbers are not finite or not positive.
    """
    if not materials:
        raise FittingError("no materials: give the solver at least one, Material() says nothing")
    table = MaterialTable(
        np.array([int(m.variant) for m in materials], dtype=np.int32),
        np.array([m.shape_mean for m in materials], dtype=np.float64),
        np.array([m.shape_precision for m in materials]),
        np.array([m.specular_mean for m in materials], dtype=np.float64),
        np.array([m.specular_precision for m in materials]),
        np.array([m.misfit_floor for m in materials], dtype=np.float64),
        np.array([m.misfit_relative for m in materials], dtype=np.float64),
    )
    for name, array in table._asdict().items():
        if not np.all(np.isfinite(array)):
            bad = int(np.flatnonzero(~np.isfinite(array).reshape(len(materials), -1).all(1))[0])
            raise FittingError(f"{name} of material {bad} is not finite")
    return table
