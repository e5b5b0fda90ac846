from __future__ import annotations

import numpy as np

from calibration.lens import transform
from fitting.range_image import triangulate
from workstation.benchmarks.analytic_scans import relief, scan_of, surface_rig


def test_the_scan_is_that_of_the_relief():
    rig = surface_rig(200)
    image = triangulate(scan_of(rig), rig)
    assert image.valid.mean() > 0.97
    x, y, z = image.points[image.valid].T
    error = (z - (450 - relief(x, y))) / np.sqrt(image.depth_variance[image.valid])
    assert abs(np.std(error) - 1) < 0.03
    assert abs(np.mean(error)) < 0.05
    panel = rig.projector.project(transform(rig.rt_proj_cam, image.points[image.valid]))
    assert (panel > 0).all()
    assert (panel < [rig.projector.width, rig.projector.height]).all()
