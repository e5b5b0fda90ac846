"""How long processing will take: from the stages' last runs, or else from a model of the work.

The model's coefficients were measured on two cores of a server of 2023; they are there to tell a
minute from an hour, and a second run on the same machine knows better.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from acquisition.plan import Purpose
from acquisition.session import Session
from workstation.processing import DECODING, FIGURES, REFLECTANCE, REGISTRATION, RELIEF, SURFACE
from workstation.quality import Quality, expectation

# Seconds: at least, and per million pixels or samples.
_START_S = 0.3
_DECODING_S = 0.02  # per frame
_SURFACE_S = 1.2
_REGISTRATION_S = 1.0  # per place
_READING_S = 0.03  # per frame
_SURVEY_S = 12.0
_FITTING_S = 12.0  # per texel and photograph
# Share of a scan's pixels that become texels.
_ON_CANVAS = 0.4


def expected_seconds(
    session: Session,
    *,
    photographs: Session | None = None,
    quality: Quality = Quality.NORMAL,
    before: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Seconds that each stage is expected to take if it runs, in order.

    Parameters
    ----------
    session : Session
        The scan.
    photographs : Session, optional
    quality : Quality
    before : mapping of str to float, optional
        What stages took at this quality before, by their names.
    """
    megapixels = _megapixels(session)
    found = {
        DECODING: _START_S + _DECODING_S * megapixels * len(session.frames),
        SURFACE: _START_S + _SURFACE_S * megapixels,
        RELIEF: 0.1 * megapixels,
        FIGURES: 0.1 * megapixels,
    }
    if photographs is not None:
        frames = [f.purpose for f in photographs.frames]
        places = max(1, len(photographs.plan.camera_positions))
        pictures = len({f.bracket for f in photographs.frames if f.purpose is Purpose.PHOTOGRAPH})
        size = _megapixels(photographs)
        code = frames.count(Purpose.CODE)
        found[REGISTRATION] = _START_S + places * _REGISTRATION_S + _DECODING_S * size * code
        found[REFLECTANCE] = _READING_S * size * len(frames) + expectation(quality).fit_time * (
            _SURVEY_S + _FITTING_S * _ON_CANVAS * megapixels * pictures
        )
    return {name: (before or {}).get(name, seconds) for name, seconds in found.items()}


def _megapixels(session: Session) -> float:
    crop = session.plan.crop
    return float(np.prod((crop.width, crop.height))) / 1e6
