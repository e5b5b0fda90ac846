from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.stats import kstest

from acquisition.errors import SessionError
from acquisition.light_poses import order_by_travel, spread_poses, travel
from devices.interfaces import ArmLimits, ArmPose

FULL = ArmLimits(azimuth=(-math.pi, math.pi), elevation=(math.radians(10), math.radians(85)))
HOME = ArmPose(0.0, math.radians(10))


def directions(poses):
    a = np.array([p.azimuth for p in poses])
    e = np.array([p.elevation for p in poses])
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)


@pytest.mark.parametrize("count", [1, 2, 24, 100])
def test_poses_are_within_the_limits(count):
    half = ArmLimits(azimuth=(-1.0, 1.5), elevation=(0.2, 1.2))
    for limits in (FULL, half):
        poses = spread_poses(limits, count)
        assert len(poses) == count
        for pose in poses:
            limits.check(pose)


def test_poses_share_the_solid_angle_evenly():
    poses = spread_poses(FULL, 96)
    at = directions(poses)
    low, high = (math.sin(e) for e in FULL.elevation)
    assert kstest((at[:, 2] - low) / (high - low), "uniform").pvalue > 0.99
    assert kstest([(p.azimuth / math.pi + 1) / 2 for p in poses], "uniform").pvalue > 0.99
    nearest = cKDTree(at).query(at, k=2)[0][:, 1]
    # A hexagonal packing would have sqrt(2 area / (sqrt(3) n)) everywhere.
    ideal = math.sqrt(2 * 2 * math.pi * (high - low) / (math.sqrt(3) * 96))
    assert nearest.min() > 0.6 * ideal


def test_grazing_lamps_can_be_left_out():
    poses = spread_poses(FULL, 50, least_elevation=math.radians(25))
    assert min(p.elevation for p in poses) > math.radians(25)
    with pytest.raises(SessionError, match="no light pose is left"):
        spread_poses(FULL, 50, least_elevation=math.radians(86))
    for count in (0, 5000):
        with pytest.raises(SessionError, match="cannot be planned"):
            spread_poses(FULL, count)


@pytest.mark.parametrize("seed", range(5))
def test_small_orders_are_near_the_best_of_all(seed):
    random = np.random.default_rng(seed)
    poses = [ArmPose(*random.uniform(0, 1, 2)) for _ in range(7)]
    best = min(travel(list(p), start=HOME) for p in itertools.permutations(poses))
    found = order_by_travel(poses, start=HOME)
    assert sorted(map(str, found)) == sorted(map(str, poses))
    assert travel(found, start=HOME) <= 1.15 * best


def test_large_orders_are_much_shorter_than_the_spiral():
    poses = spread_poses(FULL, 96)
    ordered = order_by_travel(poses, start=HOME)
    assert len(set(map(str, ordered))) == 96
    assert travel(ordered, start=HOME) < 0.2 * travel(poses, start=HOME)
    # No path is shorter than the smallest tree through its points.

    angles = np.array([(p.azimuth, p.elevation) for p in (HOME, *poses)])
    tree = minimum_spanning_tree(np.abs(angles[:, None] - angles).max(axis=2) + 1e-12).sum()
    assert travel(ordered, start=HOME) < 1.35 * tree


def test_orders_of_nothing_and_of_one_are_themselves():
    assert order_by_travel([], start=HOME) == []
    assert order_by_travel([HOME], start=HOME) == [HOME]
