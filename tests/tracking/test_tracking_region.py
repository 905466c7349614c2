"""Tooth borders by colour in images with known borders."""

from types import SimpleNamespace

import numpy as np
import pytest

from jawusd.geometry import Camera
from jawusd.tracking.contour.samples import COLUMNS, INVERSE_DEPTH, LENGTH, NX, NY, U, V, X, Y
from jawusd.tracking.contour.scan import CROWN
from jawusd.tracking.contour.views import Drawn
from jawusd.tracking.region.appearance import Picture
from jawusd.tracking.region.colours import BINS, PATCHES, TABLES, Areas, CameraColours, colour_bins
from jawusd.tracking.region.edges import _light, search_borders, sharpen
from jawusd.tracking.region.search import fraction_in_sight
from jawusd.tracking.region.view import Counts, RegionView, measure_in_sight, search_creases

TOOTH, LIP = np.array([215.0, 205.0, 185.0]), np.array([150.0, 75.0, 80.0])
SIZE, MIDDLE, RADIUS = 120, 60.3, 30.4
LIMITS = (8.0, 0.4, 0.7)


def disc(seed=0, noise=4.0, radius=RADIUS):
    """Return an anti-aliased tooth-coloured disc on lip colour, (h, w, 3)."""
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    share = np.clip(radius - np.hypot(x - MIDDLE, y - MIDDLE) + 0.5, 0, 1)[..., None]
    picture = share * TOOTH + (1 - share) * LIP + np.random.default_rng(seed).normal(0, noise, (SIZE, SIZE, 3))
    return np.clip(picture, 0, 255).astype(np.uint8), share[..., 0]


def test_colours_share_a_bin_if_their_upper_four_bits_agree():
    picture = np.array([[[0, 0, 0], [15, 15, 15], [255, 255, 255], [16, 0, 0], [0, 16, 0], [0, 0, 16]]], np.uint8)
    assert colour_bins(picture).tolist() == [[0, 0, BINS - 1, 256, 16, 1]]


@pytest.mark.parametrize("cut", [0, 1])
def test_coarse_pictures_show_a_point_at_half_the_position(cut):
    """The disc's middle and area are those of its projection, for even and odd image sizes."""
    K = np.array([[300.0, 0, MIDDLE], [0, 300.0, MIDDLE], [0, 0, 1]])
    picture = disc(noise=0.0)[0][: SIZE - cut, : SIZE - cut]
    camera = Camera("cam", picture.shape[1::-1], K, np.zeros(0), np.eye(4))
    halved = Picture(camera, picture).coarse()
    assert halved.rgb.shape[1::-1] == halved.camera.size_px == (SIZE // 2 - cut, SIZE // 2 - cut)
    bright = (halved.rgb[..., 1] - LIP[1]) / (TOOTH[1] - LIP[1])
    y, x = np.mgrid[0 : SIZE // 2 - cut, 0 : SIZE // 2 - cut]
    middle = np.array([(bright * x).sum(), (bright * y).sum()]) / bright.sum()
    np.testing.assert_allclose(middle, halved.camera.project_pinhole(np.array([[0, 0, 100.0]]))[0], atol=0.03)
    assert np.sqrt(bright.sum() / np.pi) == pytest.approx(RADIUS * halved.camera.K[0, 0] / 300.0, abs=0.05)


def samples_at(radius):
    angles = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    out = np.zeros((len(angles), COLUMNS))
    out[:, NX], out[:, NY] = np.cos(angles), np.sin(angles)
    out[:, U], out[:, V] = MIDDLE + radius * out[:, NX], MIDDLE + radius * out[:, NY]
    out[:, LENGTH], out[:, INVERSE_DEPTH] = 1.0, 1 / 200
    return out


def searched(picture, share, samples, reach=LIMITS[0], other_depth=None):
    bins = colour_bins(picture)
    inside, outside = share > 0.99, share < 0.01
    colours = CameraColours(bins, Areas(inside, outside, np.zeros_like(inside), np.zeros_like(inside)))
    y, x = np.mgrid[0:SIZE, 0:SIZE]  # the crown rendered at its assumed position
    radius = np.hypot(samples[0, U] - MIDDLE, samples[0, V] - MIDDLE)
    own = (np.hypot(x - MIDDLE, y - MIDDLE) <= radius).astype(np.uint8) * CROWN
    other = np.zeros((SIZE, SIZE), np.uint8)
    depth = np.zeros((SIZE, SIZE), np.float32) if other_depth is None else other_depth
    distances, weights = np.empty(len(samples)), np.empty(len(samples))
    tables = np.zeros(len(samples), np.int64)
    limits = (reach, *LIMITS[1:])
    search_borders(samples, tables, bins, colours.ratio[0], own, other, depth, *limits, distances, weights)
    return distances, weights


@pytest.mark.parametrize("off", [-5.0, -1.3, 0.0, 2.6, 6.0])
def test_borders_are_found_from_either_side(off):
    picture, share = disc()
    samples = samples_at(RADIUS + off)
    distances, weights = searched(picture, share, samples)
    assert (weights > 0.3).mean() > 0.95
    found = weights > 0
    assert np.abs(distances[found] + off).mean() < 0.6
    sharpen(samples, picture, np.zeros(len(samples)), distances, weights)
    assert np.abs(distances[found] + off).mean() < 0.12


def weights_after(motion_px, counts):
    """Return the border weights of a disc that moves to the right, and the normals."""
    picture, share = disc()
    samples = samples_at(RADIUS)
    samples[:, X], samples[:, Y] = samples[:, U], samples[:, V]
    areas = Areas(share > 0.99, share < 0.01, np.zeros_like(share, bool), np.zeros_like(share, bool))
    bins = colour_bins(picture)
    before = np.tile([[1.0, 0, 0, -motion_px], [0, 1, 0, 0], [0, 0, 0, 1]], (2, 1, 1))
    ratio, patches = CameraColours(bins, areas).ratio, np.zeros((2, PATCHES, 2))
    view = RegionView(picture, bins, ratio, patches, np.eye(3), before, counts)
    other, depth = np.zeros((SIZE, SIZE), np.uint8), np.zeros((SIZE, SIZE), np.float32)
    drawn = Drawn((share > 0.5).astype(np.uint8) * CROWN, other, depth)
    return view.search(samples, len(samples), 0, drawn, LIMITS)[1], samples[:, [NX, NY]]


def test_borders_that_move_count_less_in_the_last_alignment():
    rest, normals = weights_after(0.0, Counts.zeros())
    fast, _ = weights_after(40.0, Counts.zeros())
    found = rest > 0.3
    along, across = found & (np.abs(normals[:, 0]) > 0.9), found & (np.abs(normals[:, 0]) < 0.05)
    assert along.sum() > 10 and across.sum() > 1
    assert (fast[along] < 0.3 * rest[along]).all()
    np.testing.assert_allclose(fast[across], rest[across], rtol=0.02)
    earlier, _ = weights_after(40.0, None)  # before the final alignment, which decides whether teeth are lost
    assert (earlier[along] > 0.9 * rest[along]).all()


def test_borders_behind_the_other_arch_are_not_found():
    picture, share = disc()
    nearer = np.full((SIZE, SIZE), 1 / 190, np.float32)
    distances, weights = searched(picture, share, samples_at(RADIUS), other_depth=nearer)
    assert np.isnan(distances).all() and np.isnan(weights).all()


def test_contours_without_tooth_colours_inside_are_not_in_sight():
    picture, share = disc()
    picture[: int(MIDDLE)] = LIP  # lips hide the upper half
    bins = colour_bins(picture)
    whole = CameraColours(bins, Areas(share > 0.99, share < 0.01, np.zeros_like(share, bool), share < 0))
    tables = np.zeros(90, np.int64)
    clearness = np.where(np.arange(90) < 10, np.nan, 0.0)  # the other arch hides ten samples of the lower half
    seen = [measure_in_sight(samples_at(RADIUS), tables, bins, whole.ratio[0], c) for c in (np.zeros(90), clearness)]
    np.testing.assert_allclose(seen, [45, 35], atol=2)
    assert measure_in_sight(samples_at(RADIUS + 8), tables, bins, whole.ratio[0], np.zeros(90)) == 0


@pytest.mark.parametrize(("in_sight_px", "expected"), [(80.0, 0.5), (20.0, 40 / 60), (0.0, 40 / 60)])
def test_a_fit_counts_the_contour_in_sight_but_not_too_little_of_it(in_sight_px, expected):
    counts = Counts.zeros()
    counts.in_sight_px[:] = in_sight_px
    view = RegionView(None, None, None, None, None, None, counts)
    matched = SimpleNamespace(score_px=np.full((2, 1), 40.0))
    solution = SimpleNamespace(outline=matched, visible_px=np.full((2, 1), 200.0))
    np.testing.assert_allclose(fraction_in_sight(solution, [SimpleNamespace(edges=view)]), expected)


def test_without_teeth_no_border_is_found():
    picture, share = disc()
    lips = np.broadcast_to(LIP, picture.shape) + np.random.default_rng(1).normal(0, 4, picture.shape)
    bins = colour_bins(picture)
    colours = CameraColours(bins, Areas(share > 0.99, share < 0.01, np.zeros_like(share, bool), share < 0))
    samples = samples_at(RADIUS)
    distances, weights = np.empty(len(samples)), np.empty(len(samples))
    empty = np.zeros((SIZE, SIZE), np.uint8)
    own = (share > 0.01).astype(np.uint8) * CROWN
    depth = np.zeros((SIZE, SIZE), np.float32)
    flesh = colour_bins(np.clip(lips, 0, 255).astype(np.uint8))
    tables = np.zeros(len(samples), np.int64)
    search_borders(samples, tables, flesh, colours.ratio[0], own, empty, depth, *LIMITS, distances, weights)
    assert np.isnan(distances).all() and not weights.any()


def test_crowns_before_crowns_end_at_the_dark_line():
    picture = np.broadcast_to(TOOTH, (SIZE, SIZE, 3)).copy()
    x = np.arange(SIZE)
    shade = np.clip(1 - 0.6 * np.exp(-0.5 * ((x - 70.0) / 1.0) ** 2), 0, 1)
    picture = np.clip(picture * shade[None, :, None], 0, 255).astype(np.uint8)
    samples = np.zeros((1, COLUMNS))
    samples[0, [U, V, NX, LENGTH]] = 68.0, 60.0, 1.0, 1.0
    own, other = np.zeros((SIZE, SIZE), np.uint8), np.zeros((SIZE, SIZE), np.uint8)
    own[:, :69], other[:, 69:] = CROWN, CROWN
    distances, weights = np.full(1, np.nan), np.zeros(1)
    search_creases(samples, picture, own, other, 5.0, distances, weights)
    # Half the darkness of the line is reached sqrt(2 ln 2) = 1.18 px before its centre.
    assert weights[0] == 0.5 and distances[0] == pytest.approx(2.0 - 1.18, abs=0.3)


def test_colours_follow_what_borders_show():
    picture, share = disc()
    areas = Areas(share > 0.99, share < 0.01, np.zeros_like(share, bool), np.zeros_like(share, bool))
    colours = CameraColours(colour_bins(picture), areas)
    blue = int(colour_bins(np.full((1, 1, 3), (30, 60, 200), np.uint8))[0, 0])
    assert colours.ratio[1, 4, blue] < 0  # unseen colour
    tooth, outside = np.zeros((2, TABLES, BINS)), np.zeros((2, TABLES, BINS))
    tooth[1, 4, blue] = 1000.0  # lower arch, patch 2
    outside[1, :, int(colour_bins(LIP[None, None].astype(np.uint8))[0, 0])] = 1000.0
    colours.learn(tooth, outside, (0.5, 0.5))
    assert colours.ratio[1, 4, blue] > 1.0 and colours.ratio[1, 5, blue] > 1.0  # the same teeth
    assert colours.ratio.shape == (2, 2 * PATCHES, BINS)


def test_light_of_codes_is_their_power():
    codes = np.linspace(0.0, 255.0, 5001)
    np.testing.assert_allclose([_light(code) for code in codes], (codes / 255) ** 2.2, atol=1e-7)
