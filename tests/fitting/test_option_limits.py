from __future__ import annotations

import pytest
from synthetic_scan import make_range_image

from fitting.canvas import CanvasOptions, extract_canvas
from fitting.errors import FittingError
from fitting.range_image import RangeOptions
from fitting.relief_classification import ReliefOptions
from fitting.resampling import resample_heights

NAN, INFINITE = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("options", "name", "value"),
    [
        (CanvasOptions, "maximum_slope", NAN),
        (CanvasOptions, "maximum_slope", 0.0),
        (CanvasOptions, "sigmas", -1.0),
        (CanvasOptions, "spike_sigmas", INFINITE),
        (CanvasOptions, "sigma_ratio", 0.0),
        (CanvasOptions, "erosion_px", -1),
        (CanvasOptions, "erosion_px", 5000),
        (CanvasOptions, "seed_window", 0.0),
        (CanvasOptions, "bridge_px", -2),
        (CanvasOptions, "rectangle_fill", 1.5),
        (ReliefOptions, "smallest_mm2", NAN),
        (ReliefOptions, "smallest_mm2", -1.0),
        (ReliefOptions, "noise_share", -0.1),
        (ReliefOptions, "cell", 0),
        (ReliefOptions, "share_of_height", (0.4, 0.2)),
        (ReliefOptions, "share_of_height", (NAN, 0.2)),
        (RangeOptions, "epipolar_tolerance_px", NAN),
        (RangeOptions, "sigmas", -6.0),
        (RangeOptions, "maximum_slope", INFINITE),
        (RangeOptions, "agreeing_share", 1.5),
    ],
)
def test_options_that_make_no_sense_are_named(options, name, value):
    with pytest.raises(FittingError, match=name):
        options(**{name: value})


def test_pitches_and_footprints_that_would_take_for_ever_are_refused():
    scene = make_range_image(lambda x, y: 0.01 * x)
    canvas = extract_canvas(scene.image)
    with pytest.raises(FittingError, match=r"finer than a tenth of the points' spacing"):
        resample_heights(scene.image, canvas, pitch_mm=0.05)
    with pytest.raises(FittingError, match=r"spans more than 50 texels"):
        resample_heights(scene.image, canvas, footprint_mm=1e3)
