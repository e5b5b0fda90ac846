"""By which a flat target departs from Lambert's law, as a smooth function of the incidence.

Light that enters a dull surface through an interface is less the more it grazes (Fresnel), and
pigment that is coarse returns more of it (M. Oren and S. K. Nayar, 1994). Both depend on the angle
between normal and lamp almost alone, as long as the view stays: a polynomial of its cosine tells
what any of them does, and leaves what else the lamp's place does to the target's shading.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Powers of one less the cosine: Schlick's approximation of Fresnel's law has five, and four follow
# it to a thousandth up to 60° from the normal.
TERMS = 4


def incidence_factor(
    cosine: NDArray[np.float64],
    logarithm: NDArray[np.float64],
    weight: NDArray[np.float64],
    *,
    by_point: bool,
) -> NDArray[np.float64]:
    """Factor of a target's radiance by the incidence that explains best what it is off by.

    Parameters
    ----------
    cosine : (poses, points) array
        Between the target's normal and the direction to the lamp.
    logarithm : (poses, points) array
        Of the radiance seen over that of a matt target.
    weight : (poses, points) array
        One over its variance; 0 where nothing was seen.
    by_point : bool
        Whether each point has a factor of its own, so that it is compared with itself only.

    Returns
    -------
    (poses, points) float64 array
        Positive, and 1 on average: whether lamp or target is brighter it does not say.
    """
    powers = np.stack([(1 - cosine) ** (k + 1) for k in range(TERMS)])
    over = (1,) if by_point else (1, 2)
    total = np.maximum(weight.sum(axis=0 if by_point else None), 1e-300)

    def centred(values: NDArray[np.float64]) -> NDArray[np.float64]:
        mean = (weight * values).sum(axis=over, keepdims=True) / total
        return np.asarray(values - mean)

    terms = centred(powers).reshape(TERMS, -1)
    seen = centred(logarithm[np.newaxis]).ravel()
    weighted = terms * weight.ravel()
    found = np.linalg.pinv(weighted @ terms.T, rcond=1e-12, hermitian=True) @ (weighted @ seen)
    law = np.einsum("k,kpn->pn", found, powers)
    return np.exp(law - (weight * law).sum() / np.maximum(weight.sum(), 1e-300))
