"""The glide surface: envelope of the contact, low-rank factors, and a model whose d1 starts at tooth contact."""

import numpy as np
import pytest
from example_rig import example_rig
from scipy.ndimage import gaussian_filter

from jawusd.evaluator import JawRig
from jawusd.fitting import glide
from jawusd.formats.model import JawModel

D2, D3 = np.arange(-6.0, 6.1, 0.5), np.arange(-2.0, 6.1, 0.5)


def rough(seed=0):
    surface = gaussian_filter(np.random.default_rng(seed).normal(size=(len(D2), len(D3))), 1.5) * 4.0
    return surface - surface[D2 == 0][:, D3 == 0]


def test_a_surface_of_limited_slopes_lies_on_or_above_the_contact():
    down = rough()
    found = glide._dilated(down, (1.0, 0.7))
    assert (found >= down - 1e-12).all()
    assert np.abs(np.diff(found, axis=0)).max() <= 0.5 * 1.0 + 1e-9
    assert np.abs(np.diff(found, axis=1)).max() <= 0.5 * 0.7 + 1e-9
    # the lowest such surface: every point is supported by a contact point
    away = np.abs(D2[:, None, None, None] - D2[:, None]) * 1.0 + np.abs(D3[:, None, None] - D3) * 0.7
    np.testing.assert_allclose(found, (down - away).max(axis=(2, 3)), atol=1e-9)


def test_the_smooth_hull_is_zero_at_rest_and_above_the_contact_elsewhere():
    down = rough(1)
    found = glide._hull(D2, D3, down, (1.5, 1.0))
    assert found[D2 == 0][:, D3 == 0] == pytest.approx(0.0, abs=1e-12)
    far = np.hypot(D2[:, None], D3) > glide._REST_MM
    assert np.quantile((down - found)[far], 0.99) < 0.15


def test_factors_give_the_surface_at_its_knots():
    surface = rough(2)
    table = glide._factored(D2, D3, surface)
    side, front = np.meshgrid(D2, D3, indexing="ij")
    np.testing.assert_allclose(table.at_arrays(side, front)[0], surface, atol=2 * glide._RANK_ERROR_MM)
    assert table.at_floats(0.0, 0.0)[0] == pytest.approx(0.0, abs=1e-12)


class FlatTeeth:
    """Teeth that touch where a mandible point rises above a plane that is inclined along d3."""

    closed_mm = 0.3

    def __init__(self, rig):
        self.pair, self._incisor = self, rig.incisor

    def depth(self, T):
        moved = (T @ np.append(self._incisor, 1.0))[:, :3] - self._incisor
        return self.closed_mm + moved[:, 1] + 0.4 * moved[:, 2]

    def is_deeper(self, T, limit_mm):
        return self.depth(T) > limit_mm


def test_d1_counts_from_contact_and_poses_stay():
    rig = example_rig()
    d = rig.captured_d
    meta = {"kind": "anchored", "config": {"alpha": 0.3}}
    model = JawModel(rig.arrays, np.arange(len(d)), d, np.zeros(len(d)), np.ones(len(d), bool), meta)
    found = glide.follow_teeth(model, FlatTeeth(rig))
    new = JawRig(found.arrays, found.meta)
    np.testing.assert_allclose(new.pose(found.d), rig.pose(d), atol=1e-9)
    # at d1 = 0 the incisal point is on the plane
    side = np.random.default_rng(0).uniform([-3, -0.5], [3, 3], (50, 2))
    at = new.model.gauge.displacement(np.column_stack([np.zeros(50), side]))
    far = np.hypot(*side.T) > 2.5
    np.testing.assert_allclose((at[:, 1] + 0.4 * at[:, 2])[far], 0.0, atol=0.1)
    # the bound starts there, and contains the closed bite
    assert new.margin([0.0, 0.0, 0.0]) >= 0
    assert new.margin([-0.2, 0.0, 0.3]) < 0
    assert found.arrays["d_range"][0, 0] == pytest.approx(-0.05)


def test_an_additive_model_stays_what_it_is():
    rig = example_rig("additive")
    d = rig.captured_d
    meta = {"kind": "additive"}
    model = JawModel(rig.arrays, np.arange(len(d)), d, np.zeros(len(d)), np.ones(len(d), bool), meta)
    assert glide.follow_teeth(model, FlatTeeth(rig)) is model
