from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic_scan import bumps, correspond

from calibration.lens import invert, transform
from fitting.calibration_uncertainty import propagate_calibration
from fitting.canvas import extract_canvas
from fitting.range_image import RangeOptions, triangulate


@pytest.fixture
def covariance(rig_geometry):
    """Focal lengths to half a pixel, centres to one, a pose to a milliradian and 0.3 mm."""
    lens = [0.5, 0.5, 1.0, 1.0, 1e-3, 2e-3, 1e-4, 1e-4, 0.0]
    sigma = np.array([*lens, *lens, 1e-3, 1e-3, 1e-3, 0.3, 0.3, 0.3])
    correlation = np.eye(len(sigma))
    correlation[0, 1] = correlation[1, 0] = 0.9
    assert len(sigma) == len(rig_geometry.parameters)
    return correlation * np.outer(sigma, sigma)


def test_a_rig_without_covariance_leaves_its_uncertainty_unknown(rig_geometry):
    exact, _ = correspond(rig_geometry, bumps)
    canvas = extract_canvas(triangulate(exact, rig_geometry))
    assert propagate_calibration(exact, rig_geometry, canvas) is None


def test_the_predicted_error_is_what_wrong_calibrations_make(rig_geometry, covariance):
    exact, _ = correspond(rig_geometry, bumps, sigma=0.0)
    rig = dataclasses.replace(rig_geometry, covariance=covariance)
    base = triangulate(exact, rig)
    canvas = extract_canvas(base)
    predicted = propagate_calibration(exact, rig, canvas)
    local = transform(invert(canvas.rt_cam_canvas), base.points[canvas.mask])
    plane = np.concatenate([np.ones((len(local), 1)), local[:, :2]], axis=1)
    random = np.random.default_rng(0)
    root = np.linalg.cholesky(covariance + 1e-18 * np.eye(len(covariance)))
    squares = []
    loose = RangeOptions(epipolar_tolerance_px=100, repair_orders=False)
    for _ in range(60):
        moved = rig.moved(root @ random.normal(size=len(covariance)))
        wrong = triangulate(exact, moved, loose).points[canvas.mask]
        error = transform(invert(canvas.rt_cam_canvas), wrong)[:, 2] - local[:, 2]
        error -= plane @ np.linalg.lstsq(plane, error, rcond=None)[0]
        squares.append(np.mean(error**2))
    # The few parameters that matter leave the mean of sixty squares uncertain by a fifth.
    assert np.sqrt(np.mean(squares)) == pytest.approx(predicted.height_mm, rel=0.25)
    assert predicted.height_mm > 0.005
    assert min(predicted.shape_mm) > 0


def test_certain_parameters_make_no_error(rig_geometry, covariance):
    exact, _ = correspond(rig_geometry, bumps)
    rig = dataclasses.replace(rig_geometry, covariance=0 * covariance)
    found = propagate_calibration(exact, rig, extract_canvas(triangulate(exact, rig)))
    assert found.height_mm == 0
