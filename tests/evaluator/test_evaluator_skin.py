"""Maps from skin to d: against the textbook's formulas, sampled head motion, and damaged files."""

import json

import numpy as np
import pytest

import jawusd
from jawusd.base.errors import FormatError
from jawusd.evaluator.skin import Skin
from jawusd.formats.atomic import write_npz_atomic

META = {
    "format": "jawusd-skin/1",
    "units": {"length": "mm", "angle": "rad"},
    "twist_order": ["omega", "v"],
    "actor": "anna",
}


def example_arrays(frames=40, columns=18, count=8, seed=0):
    """Return the arrays of a map made from random columns of a curved relation, and the training columns."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(frames, columns)) * np.linspace(3, 0.2, columns)
    mean = X.mean(axis=0)
    basis = np.linalg.svd(X - mean, full_matrices=False)[2][:count]
    scale = ((X - mean) @ basis[0]).std()
    root = rng.normal(size=(3, 3))
    arrays = {
        "mean": mean,
        "basis": basis,
        "scale": np.array(scale),
        "features": (X - mean) @ basis.T / scale,
        "d": np.stack([X[:, 0] + 0.2 * X[:, 1] ** 2, X[:, 1], X[:, 2] * X[:, 0]], axis=1) + [5, 0, 1],
        "noise": rng.uniform(0.01, 0.05, frames),
        "kernel": np.array([1.5, 2.0, 0.4, 0.02]),
        "spread": root @ root.T + 0.1 * np.eye(3),
        "head_error": 0.05 * rng.normal(size=(6, count)),
        "smooth_count": np.array(4),
        "familiar_count": np.array(6),
        "familiar_limit": np.array([0.5, 0.2]),
    }
    return arrays, X


def textbook(arrays, x):
    """Return the mean and the variance of the process at columns x (K,), entry by entry with solves.

    Beyond the limit of a familiar face, the variance grows with the squared distance from the components.
    """
    length, smooth, linear, new = arrays["kernel"]

    def parts(y):
        centred = (y - arrays["mean"]) / arrays["scale"]
        f = arrays["basis"] @ centred
        return f, centred @ centred - f @ f

    def k(f, g):
        near = f[: arrays["smooth_count"]] - g[: arrays["smooth_count"]]
        return smooth * np.exp(-near @ near / (2 * length**2)) + linear * f @ g

    train, d = arrays["features"], arrays["d"]
    K = np.array([[k(a, b) for b in train] for a in train]) + np.diag(arrays["noise"])
    f, left_out = parts(x)
    row = np.array([k(f, g) for g in train])
    mean = d.mean(axis=0) + row @ np.linalg.solve(K, d - d.mean(axis=0))
    variance = k(f, f) + linear * left_out + new - row @ np.linalg.solve(K, row)
    outside = left_out + np.sum(f[arrays["familiar_count"] :] ** 2)
    return mean, variance * max(1.0, outside / arrays["familiar_limit"][1])


def test_means_and_covariances_are_those_of_the_textbook():
    arrays, X = example_arrays()
    still = Skin({**arrays, "head_error": np.zeros((0, 8))}, META)
    for x in (X[3] + 0.1, 0.5 * (X[1] + X[2]), 4 * X[0]):
        found = still(x)
        mean, variance = textbook(arrays, x)
        np.testing.assert_allclose(found.d, mean, rtol=1e-9)
        np.testing.assert_allclose(found.covariance, variance * arrays["spread"], rtol=1e-8)


def test_an_error_of_the_head_adds_the_covariance_of_the_moved_columns():
    arrays, X = example_arrays()
    skin, still = Skin(arrays, META), Skin({**arrays, "head_error": np.zeros((0, 8))}, META)
    x, step = X[5] + 0.2, 1e-5
    moves = arrays["head_error"] @ arrays["basis"] * arrays["scale"]  # of the columns, by one sigma
    changes = (still(x + step * moves).d - still(x - step * moves).d) / (2 * step)
    added = skin(x).covariance - still(x).covariance
    np.testing.assert_allclose(added, changes.T @ changes, rtol=1e-6, atol=1e-9)
    assert np.trace(added) > 0.01


def test_batches_points_and_missing_columns():
    arrays, X = example_arrays()
    skin = Skin(arrays, META)
    one, many = skin(X[0]), skin(X[:6].reshape(2, 3, 18))
    assert one.d.shape == (3,) and one.covariance.shape == (3, 3) and one.familiar.shape == ()
    assert many.d.shape == (2, 3, 3) and many.covariance.shape == (2, 3, 3, 3) and many.familiar.shape == (2, 3)
    np.testing.assert_allclose(many.d[0, 0], one.d, rtol=1e-12)
    np.testing.assert_array_equal(skin(X[:4].reshape(4, 6, 3)).d, skin(X[:4]).d)  # six points
    X[1, 7] = np.nan
    found = skin(X[:3])
    assert np.isnan(found.d[1]).all() and np.isnan(found.covariance[1]).all() and not found.familiar[1]
    np.testing.assert_allclose(found.d[[0, 2]], skin(X[[0, 2]]).d, rtol=1e-12)
    assert skin(np.zeros((0, 18))).d.shape == (0, 3)
    with pytest.raises(ValueError, match="18"):
        skin(np.zeros((5, 17)))
    long = np.tile(X[:3], (1500, 1))
    np.testing.assert_allclose(skin(long).d[-3:], found.d, rtol=1e-12)


def test_faces_far_from_the_training_frames_are_unfamiliar():
    arrays, X = example_arrays()
    skin = Skin({**arrays, "familiar_limit": np.array([1.0, 4.0])}, META)
    assert skin(X).familiar.all()
    assert not skin(X[0] + 30 * arrays["basis"][0]).familiar  # beyond the range: the variance
    aside = np.linalg.svd(arrays["basis"])[2][-1]
    assert not skin(X[0] + 30 * aside).familiar  # a direction never seen


def write(path, arrays, **changes):
    """Write a file."""
    write_npz_atomic(path, {**arrays, "meta": np.array(json.dumps({**META, **changes}))})
    return path


def test_files_hold_the_map(tmp_path):
    arrays, X = example_arrays()
    skin = jawusd.load_skin(write(tmp_path / "skin.npz", arrays))
    assert skin.actor == "anna" and skin.points and skin.columns == 18 and skin.errors_mm == {}
    bad = {"errors_mm": {"skin": 0.5, "chin": "x"}, "actor": None}
    other = jawusd.load_skin(write(tmp_path / "other.npz", arrays, **bad))
    assert other.errors_mm == {"skin": 0.5} and other.actor == ""
    np.testing.assert_array_equal(skin(X).d, Skin(arrays, META)(X).d)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"mean": np.zeros(17)}, '"basis" has shape'),
        ({"d": np.zeros((40, 2))}, '"d" has shape'),
        ({"features": np.zeros((0, 8))}, '"features" has shape'),
        ({"features": np.full((40, 8), np.nan)}, '"features" has values that are not finite'),
        ({"d": np.full((40, 3), 1e13)}, "larger than"),
        ({"noise": np.zeros(40)}, '"noise" must be positive'),
        ({"scale": np.array(0.0)}, '"scale" must be positive'),
        ({"smooth_count": np.array(9)}, "from 1 to 8"),
        ({"familiar_count": np.array(1.5)}, "whole number"),
        ({"spread": np.diag([1.0, 1.0, -1.0])}, "positive definite"),
        ({"features": np.zeros((2001, 8)), "d": np.zeros((2001, 3)), "noise": np.ones(2001)}, "at most 2000"),
        ({"d": np.array([["x"] * 3] * 40)}, "expected numbers"),
    ],
)
def test_damaged_files_are_refused(tmp_path, change, said):
    with pytest.raises(FormatError, match=said) as error:
        jawusd.load_skin(write(tmp_path / "skin.npz", {**example_arrays()[0], **change}))
    assert "skin.npz" in str(error.value)


def test_files_without_an_array_or_of_another_kind_are_refused(tmp_path):
    arrays, _ = example_arrays()
    less = {name: value for name, value in arrays.items() if name != "kernel"}
    with pytest.raises(FormatError, match='no array "kernel"'):
        jawusd.load_skin(write(tmp_path / "skin.npz", less))
    with pytest.raises(FormatError, match="jawusd-model/2"):
        jawusd.load_skin(write(tmp_path / "skin.npz", arrays, format="jawusd-model/2"))
