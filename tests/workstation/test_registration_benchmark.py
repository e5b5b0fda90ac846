from __future__ import annotations

import numpy as np

from calibration.registration import register_view
from workstation.benchmarks.registration_bound import pose_bound
from workstation.benchmarks.simulated_photographs import OTHER_LENS, RIG, VIEWS, photograph


def test_no_registration_is_predicted_to_err_less_than_the_bound():
    pose = VIEWS["right"]
    view = register_view(photograph(pose, seed=5), photograph(np.zeros(6), seed=0), RIG)
    bound = pose_bound(RIG.camera, pose)
    # In every direction, not along the axes alone.
    excess = np.linalg.eigvals(np.linalg.solve(bound, view.covariance)).real
    assert (excess > 1).all()
    # Blocks give their middles alone, of fits that spend most of the information on bends.
    assert (excess < 3**2).all()


def test_a_lens_that_is_unknown_leaves_the_pose_unknown():
    pose = VIEWS["front"]
    known, unknown = (pose_bound(OTHER_LENS, pose, free_lens=free) for free in (False, True))
    assert np.sqrt(unknown[5, 5] / known[5, 5]) > 1000
