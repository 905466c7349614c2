"""Smooth outline errors are eliminated as generalised least squares would."""

import numpy as np
import pytest

from jawusd.tracking.config import SmoothErrors
from jawusd.tracking.contour.correspondences import without_smooth_errors


def drawn(seed, count=120):
    """Return random rows (n, 3), weights (n,) and pixels (n, 2)."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)), rng.uniform(0.2, 3.0, count), rng.uniform(0.0, 70.0, (count, 2))


def interpolation(pixels, spacing):
    """Return the bilinear interpolation weights of the samples over all nodes of the image, shape (n, nodes)."""
    grid = np.arange(8) * spacing
    hats = [np.clip(1 - np.abs(pixels[:, k, None] - grid) / spacing, 0, None) for k in (0, 1)]
    return np.einsum("ni,nj->nij", *hats).reshape(len(pixels), -1)


@pytest.mark.parametrize("prior_px", [0.3, 2.0])
def test_the_rest_gives_the_equations_of_generalised_least_squares(prior_px):
    """The covariance of the errors is that of white noise plus nodes with a variance of 1 / prior."""
    rows, weights, pixels = drawn(1)
    rest = without_smooth_errors(rows, weights, pixels, SmoothErrors(12.0, prior_px, 1.0))
    B = interpolation(pixels, 12.0)
    inverse = np.linalg.inv(np.diag(1.0 / weights) + B @ B.T / prior_px)
    np.testing.assert_allclose(rows.T @ (weights[:, None] * rest), rows.T @ inverse @ rows, rtol=1e-9, atol=1e-9)
    scaled = without_smooth_errors(rows, weights, pixels, SmoothErrors(12.0, prior_px, 2.5))
    np.testing.assert_allclose(scaled, 2.5 * rest)


def test_a_smooth_error_is_removed_and_a_sudden_one_is_not():
    """Of an error common to both sides of a gap, far less is left than of one with opposite signs."""
    t = np.arange(0.0, 60.0, 0.5)
    pixels = np.concatenate([np.column_stack([t, np.full_like(t, y)]) for y in (36.0, 39.0)])
    weights, side = np.full(len(pixels), 0.5), np.repeat([1.0, -1.0], len(t))
    rows = np.column_stack([np.ones(len(pixels)), side])
    rest = without_smooth_errors(rows, weights, pixels, SmoothErrors(noise_ratio=1.0))
    common, opposite = (rest**2).mean(0)
    assert 20 * common < opposite


def test_without_samples_nothing_is_left():
    nothing = without_smooth_errors(np.empty((0, 10)), np.empty(0), np.empty((0, 2)), SmoothErrors())
    assert nothing.shape == (0, 10)
