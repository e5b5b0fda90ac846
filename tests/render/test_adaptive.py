from __future__ import annotations

import numpy as np
import pytest
from synthetic_copy import make_copy, strokes

from render.adaptive import AdaptiveOptions, box_alpha
from render.errors import RenderError
from render.painting_node import Mode
from render.views import NamedView, View, named_view


@pytest.fixture(scope="module")
def copy():
    return make_copy(strokes(), cell=12, smallest_mm2=2.0)


def test_box_alpha_by_hand(copy):
    boxes = copy.relief.boxes
    options = AdaptiveOptions(K=2.0, epsilon_min=0.01, epsilon_max=0.03)
    camera = np.array([5.0, -80.0, 120.0])
    alpha = box_alpha(copy, camera, options)
    for n in range(len(boxes)):
        row, col = boxes.peak[n]
        top = np.array(
            [
                copy.height_field.texel_x_mm()[col],
                copy.height_field.texel_y_mm()[row],
                boxes.h_max[n],
            ]
        )
        ray = top - camera
        foot = camera + ray * (copy.relief.delta0_mm - camera[2]) / ray[2]
        r = np.linalg.norm(foot - top) / np.linalg.norm(ray)
        assert alpha[n] == pytest.approx(np.clip((2 * r - 0.01) / 0.02, 0, 1), abs=1e-6)
    assert 0 < alpha.mean() < 1


def test_box_alpha_never_jumps_as_the_camera_moves(copy):
    heights = np.linspace(4.0, 4000.0, 40_000)
    alpha = np.array([box_alpha(copy, np.array([5.0, -80.0, h])) for h in heights])
    assert alpha.max() == 1
    assert alpha.min() == 0
    assert np.abs(np.diff(alpha, axis=0)).max() < 0.01
    assert (np.diff(alpha, axis=0) <= 0).all()


def test_a_camera_below_the_peaks_sees_their_boxes_whole_unless_k_is_zero(copy):
    camera = np.array([0.0, -30.0, copy.relief.delta0_mm])
    assert (box_alpha(copy, camera) == 1).all()
    assert (box_alpha(copy, camera, AdaptiveOptions(K=0.0)) == 0).all()


@pytest.mark.parametrize(
    "wrong",
    [
        {"K": -1.0},
        {"K": float("nan")},
        {"epsilon_min": 0.1, "epsilon_max": 0.1},
        {"epsilon_min": -0.1},
        {"epsilon_max": float("inf")},
    ],
)
def test_thresholds_out_of_order_are_refused(wrong):
    with pytest.raises(RenderError):
        AdaptiveOptions(**wrong)


def paint(painter, copy, mode, view, **options):
    return painter.paint(copy, view, mode=mode, width=240, height=180, **options)


def test_adaptive_runs_from_bump_to_hybrid(painter, copy):
    view = named_view(copy, NamedView.INSHOT_GRAZING, aspect=4 / 3)
    hybrid, bump = (paint(painter, copy, mode, view) for mode in (Mode.HYBRID, Mode.BUMP))
    eager, lazy = (
        paint(painter, copy, Mode.ADAPTIVE, view, adaptive=AdaptiveOptions(K=k)) for k in (1e6, 0.0)
    )
    np.testing.assert_allclose(eager.radiance, hybrid.radiance, atol=1e-6)
    np.testing.assert_allclose(lazy.radiance, bump.radiance, atol=1e-6)


@pytest.mark.parametrize("azimuth", [-130.0, -90.0, 20.0])
def test_blended_boxes_mix_bump_and_hybrid_and_nothing_else(painter, copy, azimuth):
    view = View(np.deg2rad(azimuth), np.deg2rad(14.0), 110.0)
    hybrid, bump = (paint(painter, copy, mode, view) for mode in (Mode.HYBRID, Mode.BUMP))
    # Wide thresholds leave every box between 0 and 1.
    highest = float(box_alpha(copy, view.position, _linear()).max())
    mixed = paint(
        painter,
        copy,
        Mode.ADAPTIVE,
        view,
        adaptive=AdaptiveOptions(K=0.6 / highest, epsilon_min=0.0, epsilon_max=1.0),
    )
    change, whole = mixed.radiance - bump.radiance, hybrid.radiance - bump.radiance
    clear = np.abs(whole[..., 0]) > 0.05
    assert clear.mean() > 0.004
    share = change[clear] / whole[clear]
    assert np.quantile(share, 0.01) > 0
    assert np.quantile(share, 0.99) < 0.6 + 1e-3


def _linear():
    return AdaptiveOptions(K=1.0, epsilon_min=0.0, epsilon_max=1.0)
