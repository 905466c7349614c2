"""Inverse kinematics against the paper's neighbourhood search, while dragging and from nothing."""

import numpy as np
import pytest
from brute_force_ik import brute_force_ik
from example_model import example_arrays, example_meta

from jawusd.evaluator import JawRig, search

RIGS = {kind: JawRig(example_arrays(kind), example_meta(kind)) for kind in ("anchored", "additive")}


@pytest.fixture(params=sorted(RIGS))
def rig(request):
    return RIGS[request.param]


def valid_d(rig, count, seed):
    low, high = rig.d_range.T
    return rig.project(np.random.default_rng(seed).uniform(low, high, (count, 3)))


def where(rig, d, handles):
    T = rig.pose(d)
    return np.einsum("...ij,hj->...hi", T[..., :3, :3], handles) + T[..., None, :3, 3]


def test_reachable_targets_are_reached(rig):
    d = valid_d(rig, 200, 0)
    chin = rig.landmarks[0]
    found, distance_mm = rig.ik(chin, where(rig, d, chin[None])[:, 0])
    assert distance_mm.max() < 1e-5
    np.testing.assert_allclose(found, d, atol=1e-4)


@pytest.mark.parametrize("handles", [1, 3])
def test_never_worse_than_the_papers_search_and_always_valid(rig, handles):
    """Random drags of up to 8 mm from a valid pose, many beyond reach."""
    start = valid_d(rig, 100, 1)
    points = rig.landmarks[:handles]
    targets = where(rig, start, points) + np.random.default_rng(2).normal(size=(100, 1, 3)) * 4.0
    brute, brute_mm = brute_force_ik(rig, points, targets, start)
    found, distance_mm = rig.ik(points, targets, start=start)
    assert (rig.margin(found) >= -1e-12).all()
    assert (distance_mm <= brute_mm + 1e-9).all()
    assert (brute_mm > 0.5).any()  # some targets are out of reach: the bound was at work
    left = where(rig, found, points) - targets
    np.testing.assert_allclose(distance_mm, np.sqrt((left**2).sum(-1).mean(-1)), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(RIGS))
def test_a_far_throw_finds_the_better_side_of_a_ripple(kind, monkeypatch):
    """A bound that ripples with opening is full of valleys; the search from the start alone ends in wrong ones."""
    arrays = example_arrays(kind)
    arrays["slice_support"] += 0.3 * np.sin(np.arange(len(arrays["slice_support"])) * np.pi / 2)[:, None]
    rig = JawRig(arrays, example_meta(kind))
    start = valid_d(rig, 300, 0)
    points = rig.landmarks[:1]
    targets = where(rig, start, points) + np.random.default_rng(0).normal(size=(300, 1, 3)) * 6.0
    _, brute_mm = brute_force_ik(rig, points, targets, start)
    found, distance_mm = rig.ik(points, targets, start=start)
    assert (rig.margin(found) >= -1e-12).all()
    assert (distance_mm <= brute_mm + 1e-9).all()
    monkeypatch.setattr(search, "_MAX_DRAG_MM", np.inf)
    _, distance_mm = rig.ik(points, targets, start=start)
    assert (distance_mm > brute_mm + 0.01).any()


def test_dragging_does_not_jump(rig):
    """Along a smooth path of the target, inside and outside reach, the jaw moves at most a few times as far."""
    chin = rig.landmarks[0]
    time = np.linspace(0.0, 2 * np.pi, 400)
    A = rig.T_anatomical_skull
    path = np.stack([14 * np.sin(2 * time), -18 + 16 * np.cos(time), -5 + 9 * np.sin(time)], axis=1)
    targets = rig.T_rest[:3, :3] @ chin + rig.T_rest[:3, 3] + path @ A[:3, :3]
    d = rig.project([2.0, 0.0, 0.0])
    drag = []
    for target in targets:
        d, _ = rig.ik(chin, target, start=d)
        drag.append(d)
    drag = np.array(drag)
    assert (rig.margin(drag) >= -1e-12).all()
    hand = np.linalg.norm(np.diff(targets, axis=0), axis=1).max()
    assert np.linalg.norm(np.diff(drag[1:], axis=0), axis=1).max() < 12 * hand
    assert (rig.margin(drag) < 1e-6).mean() > 0.1


def test_weights_decide_between_handles(rig):
    points = rig.landmarks[[0, 3]]
    start = rig.project([15.0, 0.0, 1.0])
    targets = where(rig, start, points) + [[[1.0, -2.0, 0.5]], [[0.0, 3.0, 0.0]]][0]
    targets[1] += [0.0, 4.0, 0.0]
    first, _ = rig.ik(points, targets, start=start, weights=[100.0, 1.0])
    second, _ = rig.ik(points, targets, start=start, weights=[1.0, 100.0])
    miss_first = np.linalg.norm(where(rig, first, points) - targets, axis=-1)
    miss_second = np.linalg.norm(where(rig, second, points) - targets, axis=-1)
    assert miss_first[0] < miss_second[0]
    assert miss_second[1] < miss_first[1]


def test_a_start_outside_is_brought_inside(rig):
    chin = rig.landmarks[0]
    found, _ = rig.ik(chin, where(rig, [5.0, 0.0, 0.0], chin[None])[0] + 40.0, start=[100.0, 30.0, 30.0])
    assert rig.margin(found) >= -1e-12


def test_targets_and_starts_with_nan_give_nan(rig):
    chin = rig.landmarks[0]
    targets = np.tile(where(rig, [5.0, 0.0, 0.0], chin[None]), (3, 1))
    targets[1, 0] = np.nan
    for start in (None, [1.0, 0.0, 0.0]):
        found, distance_mm = rig.ik(chin, targets, start=start)
        assert np.isnan(found[1]).all() and np.isnan(distance_mm[1])
        assert np.isfinite(found[[0, 2]]).all()
    assert np.isnan(rig.ik(chin, targets[0], start=[np.nan, 0.0, 0.0])[0]).all()


@pytest.mark.parametrize("handles", [1, 3])
def test_a_sight_frees_the_depth_of_a_handle(rig, handles):
    """Never worse across the sight than any of a fine scan, which does not know the path; and on the path in depth."""
    A, points = rig.T_anatomical_skull[:3, :3], rig.landmarks[:handles]
    scan = valid_d(rig, 4000, 5)
    seen = where(rig, scan, points)
    rng = np.random.default_rng(6)
    for row in range(8):
        start = rig.project([12.0 + row, rng.uniform(-2, 2), 0.5])
        look = np.array([rng.normal(), 0.2 * rng.normal(), -1.0])
        sight = np.zeros((handles, 3))
        sight[0] = 300.0 * look @ A
        targets = where(rig, start, points) + rng.normal(size=(1, 3)) * 2.0
        found, distance_mm = rig.ik(points, targets, start=start, sight=sight)
        unit = np.zeros((handles, 3))
        unit[0] = sight[0] / np.linalg.norm(sight[0])

        def apart(places, targets=targets, unit=unit):
            left = places - targets
            left = left - unit * (unit * left).sum(-1, keepdims=True)
            return np.sqrt((left**2).sum(-1).mean(-1))

        np.testing.assert_allclose(distance_mm, apart(where(rig, found, points)), atol=1e-12)
        assert rig.margin(found) >= -1e-12 and distance_mm <= apart(seen).min() + 0.02
        if handles == 1 and distance_mm < 1e-6:
            assert abs(look[0] * found[1] + look[2] * found[2]) < 1e-5
    for offset in ([0.0, -4.0, 0.0], [2.0, -3.0, 0.0]):  # from the front: no protrusion, whatever the depth asked for
        target = where(rig, [12.0, 0.0, 0.0], points[:1])[0] + (np.array(offset) + [0.0, 0.0, 3.0]) @ A
        found, _ = rig.ik(points[0], target, start=[12.0, 0.0, 0.0], sight=[0.0, 0.0, -1.0] @ A)
        assert abs(found[2]) < 1e-5
        scanned, _ = rig.ik(points[0], target, sight=[0.0, 0.0, -1.0] @ A)
        np.testing.assert_allclose(scanned, found, atol=1e-4)


@pytest.mark.parametrize("sight", [[0.0, 0.0], [[0.0, 0.0, 1.0]], [0.0, np.nan, 1.0]])
def test_a_wrong_sight_is_refused(rig, sight):
    with pytest.raises(ValueError, match="sight"):
        rig.ik(rig.landmarks[0], np.zeros(3), sight=sight)


@pytest.mark.parametrize(
    ("points", "weights", "message"),
    [([1.0, 2.0], None, "p_mandible"), ([[0.0] * 3] * 2, [1.0], "weights"), ([[0.0] * 3] * 2, [0.0, 0.0], "weights")],
)
def test_wrong_handles_are_refused(rig, points, weights, message):
    with pytest.raises(ValueError, match=message):
        rig.ik(points, np.zeros((2, 3)), weights=weights)
