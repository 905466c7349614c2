"""Parts of the segmentation against independent references: exact cuts, known colours, known masks."""

import cv2
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from jawusd.base.errors import CaptureError
from jawusd.geometry import Camera
from jawusd.segmentation.arches import (
    LOWER,
    UPPER,
    Expectation,
    Seeds,
    cut_arches,
    cut_three_ways,
    refine_borders,
    separate_arches,
)
from jawusd.segmentation.camera import Example, Scene, learn_numbers
from jawusd.segmentation.colours import ColourModel, ColourStates, SegmentationConfig, state_files
from jawusd.segmentation.files import KeyMasks, mask_path, write_mask
from jawusd.segmentation.picture import PictureFrame, Window


def exact_two_way_cut(cost, edge):
    """Return where label 1 is cheaper, by SciPy's maximum flow; cost (2, h, w), edge (2, h, w), multiples of 1/100."""
    h, w = cost.shape[1:]
    node = np.arange(h * w).reshape(h, w)
    source, sink = h * w, h * w + 1
    links = []
    for y in range(h):
        for x in range(w):
            links.append((source, node[y, x], cost[0, y, x]))  # cut if the pixel takes label 0
            links.append((node[y, x], sink, cost[1, y, x]))
            for dy, dx, k in ((0, 1, 0), (1, 0, 1)):
                if y + dy < h and x + dx < w:
                    other = node[y + dy, x + dx]
                    links += [(node[y, x], other, edge[k, y, x]), (other, node[y, x], edge[k, y, x])]
    a, b, c = zip(*links)
    graph = coo_array((np.round(100 * np.array(c)).astype(np.int32), (a, b)), [h * w + 2] * 2).tocsr()
    rest = graph - maximum_flow(graph, source, sink).flow
    rest.data[rest.data < 0] = 0
    rest.eliminate_zeros()
    reached = breadth_first_order(rest, source, return_predecessors=False)
    return np.isin(node, reached)


@pytest.mark.parametrize("seed", range(4))
def test_the_cut_is_the_minimal_one(seed):
    rng = np.random.default_rng(seed)
    cost = np.round(rng.uniform(0, 2, (2, 9, 11)), 2)
    edge = np.round(rng.uniform(0.1, 1.0, (2, 9, 11)), 2)
    three = np.concatenate([cost, np.full((1, 9, 11), 50.0)]).astype(np.float32)
    start = np.zeros((3, 9, 11), np.float32)
    start[0] = 1
    shares = cut_three_ways(three, edge.astype(np.float32), start, np.ones((9, 11), bool), 4000)
    assert np.array_equal(shares[1] > 0.5, exact_two_way_cut(cost, edge))
    assert np.allclose(shares.sum(0), 1, atol=1e-5)


def test_pixels_that_are_not_free_keep_their_label():
    cost = np.zeros((3, 6, 8), np.float32)
    cost[0] = 5
    start = np.zeros((3, 6, 8), np.float32)
    start[0] = 1
    free = np.zeros((6, 8), bool)
    free[2:4, 3:6] = True
    shares = cut_three_ways(cost, np.full((2, 6, 8), 0.01, np.float32), start, free, 200)
    assert np.array_equal(shares[0] < 0.5, free)


def painted(rng, shape, colour, spread=6):
    return np.clip(np.array(colour) + rng.normal(0, spread, (*shape, 3)), 0, 255).astype(np.uint8)


def test_lips_over_crowns_are_not_teeth():
    rng = np.random.default_rng(1)
    rgb = painted(rng, (100, 100), (160, 98, 90))  # lips
    rgb[40:60] = painted(rng, (20, 100), (205, 196, 176))  # teeth
    rgb[52:60] = painted(rng, (8, 100), (113, 108, 97))  # teeth in shadow
    under = np.zeros((100, 100), bool)
    under[20:60] = True  # half of the crowns lie under the lip
    beyond = np.zeros((100, 100), bool)
    beyond[70:] = beyond[:10] = True
    model = ColourModel(10.0)
    assert not model.is_trained()
    model.learn(rgb, under, beyond)
    odds = model.log_odds(rgb)
    assert model.is_trained()
    assert (odds[40:60] > 0).mean() > 0.98
    assert (odds[20:40] < 0).mean() > 0.98
    reach = model.surroundings_quantile(0.9)
    assert (odds[beyond] <= reach).mean() == pytest.approx(0.9, abs=0.05)


def test_dark_lips_under_crowns_do_not_make_darkness_teeth():
    rng = np.random.default_rng(4)
    rgb = painted(rng, (100, 100), (170, 104, 96))  # lips
    rgb[40:60] = painted(rng, (20, 100), (205, 196, 176))  # teeth
    rgb[30:40] = painted(rng, (10, 100), (64, 42, 38), 3)  # lips in shadow, only under crowns
    under = np.zeros((100, 100), bool)
    under[30:60] = True
    model = ColourModel(10.0)
    model.learn(rgb, under, ~under)
    assert np.median(model.log_odds(rgb)[30:40]) < 0
    assert (model.log_odds(rgb)[40:60] > 0).mean() > 0.95


def test_borders_settle_where_the_picture_changes():
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:80, :120]
    away = np.hypot((x - 60.3) / 1.5, y - 40.2) - 24.0  # an ellipse of teeth amid gum
    tooth = np.clip(0.5 - away, 0, 1)[..., None]
    shade = (1.0 - 0.4 * x / 120)[..., None]
    clean = shade * (tooth * (205, 196, 176) + (1 - tooth) * (176, 112, 108))
    rgb = np.clip(clean + rng.normal(0, 4, clean.shape), 0, 255).astype(np.uint8)
    small = (away < -2).astype(np.float32)
    small[4:14, 100:112] = 1.0  # a part without any border in the picture
    shares, clear = refine_borders(np.stack([small, np.zeros_like(small)]), rgb, SegmentationConfig(), 7.2)
    assert shares[1].max() == 0
    assert not (shares[0][:16, 98:] > 0.5).any()
    found = np.abs(shares[0].sum() - tooth.sum()) / tooth.sum()
    assert found < 0.05  # initially 16 % too small
    assert clear[np.abs(away) < 1].mean() > 0.95
    assert (np.abs(away)[(shares[0] > 0.5) != (tooth[..., 0] > 0.5)] < 1.5).all()


def test_what_has_no_border_in_the_picture_is_no_tooth():
    rgb = painted(np.random.default_rng(3), (60, 80), (150, 140, 130), 2)
    shares = np.zeros((2, 60, 80), np.float32)
    shares[0, 20:40, 20:60] = 1.0
    settled, clear = refine_borders(shares, rgb, SegmentationConfig(), 7.2)
    assert not (settled > 0.5).any()
    assert not clear[15:45].any()


def test_masks_come_back_to_the_recorded_picture():
    camera = Camera(
        "cam", (640, 480), [[900, 0, 320], [0, 900, 240], [0, 0, 1]], [-0.25, 0.08, 0.001, -0.001, 0.0], np.eye(4)
    )
    frame = PictureFrame(camera, np.array([0, 0, 200.0]), 3.0)
    mask = np.zeros((480, 640), np.uint8)
    cv2.ellipse(mask, (400, 300), (110, 60), 20, 0, 360, 255, -1)
    corners = np.array([[x, y, 200.0] for x in (-20, 50) for y in (-15, 35)])
    window = frame.window(np.zeros((480, 640, 3), np.uint8), corners, 2.0)
    back = frame.recorded(frame.given(mask, window).astype(np.float32) / 255, window)
    both, either = ((back > 0) & (mask > 0)).sum(), ((back > 0) | (mask > 0)).sum()
    assert set(np.unique(back)) == {0, 255}
    assert both / either > 0.985
    assert frame.window(np.zeros((480, 640, 3), np.uint8), np.array([[0, 0, -5.0]]), 2.0) is None


def test_key_masks_are_found_by_the_cameras_own_frames(tmp_path):
    drawn = np.zeros((20, 30), np.uint8)
    drawn[5:9, 5:20] = 255
    path = mask_path(tmp_path, "cam1", "lower", 12)
    path.parent.mkdir(parents=True)
    write_mask(path, drawn)
    keys = KeyMasks(tmp_path, {"cam0": (30, 20), "cam1": (30, 20)})
    upper, lower = keys.of("cam1", 12)
    assert upper is None
    assert lower.finished
    assert np.array_equal(lower.mask, drawn)
    assert (lower.known == 255).all()
    assert keys.frames("cam1") == [12]
    assert keys.of("cam1", 11) == [None, None]
    assert keys.of("cam0", 12) == [None, None]
    assert KeyMasks(None, {"cam0": (30, 20)}).of("cam0", 12) == [None, None]


def test_strokes_say_something_only_where_they_are(tmp_path):
    drawn = np.full((20, 30), 128, np.uint8)
    drawn[5:9, 5:12] = 255
    drawn[15, 3:20] = 0
    path = mask_path(tmp_path, "cam0", "upper", 4)
    path.parent.mkdir(parents=True)
    write_mask(path, drawn)
    key = KeyMasks(tmp_path, {"cam0": (30, 20)}).of("cam0", 4)[0]
    assert not key.finished
    assert np.array_equal(key.mask == 255, drawn == 255)
    assert np.array_equal(key.known == 255, drawn != 128)
    with pytest.raises(CaptureError, match="strokes are 30 x 20 px"):
        KeyMasks(tmp_path, {"cam0": (60, 40)}).of("cam0", 4)


def expect_disks():
    """Return the expected and true position of two disks of teeth in a picture of 90 x 120 px."""
    y, x = np.mgrid[:90, :120]
    inside = np.stack([22.0 - np.hypot(x - cx, y - 45) for cx in (32, 88)]).astype(np.float32)
    labels = np.select([inside[0] > 0, inside[1] > 0], [UPPER, LOWER]).astype(np.uint8)
    return Expectation(labels, inside), inside > 0


def taught(rgb, teeth):
    model = ColourModel(10.0)
    model.learn(rgb, teeth, ~teeth)
    return model


def test_strokes_overcome_every_colour():
    rng = np.random.default_rng(5)
    expected, true = expect_disks()
    rgb = painted(rng, (90, 120), (170, 104, 96))
    rgb[true.any(0)] = painted(rng, (int(true.sum()),), (205, 196, 176))
    known, share = np.zeros((2, 90, 120), bool), np.zeros((2, 90, 120), np.float32)
    known[0, 40:50, 25:40] = True  # annotated against the upper row, contrary to all other evidence
    known[1, 2:6, 2:6], share[1, 2:6, 2:6] = True, 1.0  # annotated as the lower row, contrary to all other evidence
    seeds = Seeds(known, share)
    model = taught(rgb, true.any(0))
    free = cut_arches(rgb, expected, model, SegmentationConfig(), 7.2, 1.0)
    found = seeds.pinned(cut_arches(rgb, expected, model, SegmentationConfig(), 7.2, 1.0, seeds))
    assert (free[0, 40:50, 25:40] > 0.5).all() and not (free[1, 2:6, 2:6] > 0.5).any()
    assert not (found[0, 40:50, 25:40] > 0.5).any()
    assert (found[1, 2:6, 2:6] > 0.5).all()
    assert ((found[0] > 0.5) == true[0])[:, :22].mean() > 0.98


def test_rows_part_where_teeth_meet_and_not_where_they_were_expected():
    rng = np.random.default_rng(8)
    y = np.arange(90)[:, None] * np.ones((1, 120))
    teeth = (y > 15) & (y < 75)
    clean = np.where(teeth[..., None], np.array((205, 196, 176)), (140, 70, 66))  # lips have a much stronger edge
    clean = np.where((teeth & (np.abs(y - 43) < 1.5))[..., None], (165, 158, 142), clean)  # where the rows meet
    rgb = np.clip(clean + rng.normal(0, 3, clean.shape), 0, 255).astype(np.uint8)
    expected_y = 47.0  # half a millimetre off
    inside = np.stack([np.minimum(y - 15, expected_y - y), np.minimum(75 - y, y - expected_y)]).astype(np.float32)
    labels = np.select([inside[0] > 0, inside[1] > 0], [UPPER, LOWER]).astype(np.uint8)
    shares = np.stack([teeth & (y <= expected_y), teeth & (y > expected_y)]).astype(np.float32)
    found = separate_arches(shares, rgb, Expectation(labels, inside), SegmentationConfig(), 7.2)
    assert np.allclose(found.sum(0), shares.sum(0), atol=1e-5)
    edge = (found[0] > 0.5).sum(0) + 16
    assert edge.min() >= 42 and edge.max() <= 46  # it would be 48 at the prediction


def test_numbers_are_learned_from_wider_drawn_masks():
    rng = np.random.default_rng(6)
    expected, true = expect_disks()
    tooth = np.clip(expected.inside_px.max(0) / 2 + 0.5, 0, 1)[..., None]
    clean = tooth * (205, 196, 176) + (1 - tooth) * (170, 104, 96)
    rgb = np.clip(clean + rng.normal(0, 4, clean.shape), 0, 255).astype(np.uint8)
    window = Window(Camera("cam", (120, 90), np.eye(3), [], np.eye(4)), rgb, (0, 0))
    wide = (expected.inside_px > -1.0).astype(np.float32)
    example = Example(Scene(window, expected, taught(rgb, true.any(0)), 7.2), wide)
    config, learned = learn_numbers([example], SegmentationConfig())
    before, after = learned["disagreement"]
    assert after < 0.9 * before
    assert min(config.wider) > 0 or learned["numbers"]
    found = example.cut(config) > 0.5
    assert 1 - np.mean([(f & w).sum() / (f | w).sum() for f, w in zip(found, wide > 0.5)]) == pytest.approx(after)


def test_colours_go_on_where_they_stopped(tmp_path):
    rng = np.random.default_rng(7)
    _, true = expect_disks()
    rgb = painted(rng, (90, 120), (170, 104, 96))
    model = taught(rgb, true.any(0))
    for frame in (5, 6):
        ColourStates(tmp_path, {"cam0": model}).save(frame, 1)
    fresh = ColourModel(10.0)
    states = ColourStates(tmp_path, {"cam0": fresh})
    assert states.restore(9, 1) is None
    assert states.restore(5, -1) is None
    assert not fresh.is_trained()
    assert states.restore(7, 1) == 6  # frame 7 is recorded, but its colours are not saved
    assert states.restore(5, 1) == 5
    assert np.array_equal(fresh.log_odds(rgb), model.log_odds(rgb))


def test_damaged_colours_are_done_again(tmp_path):
    model = taught(painted(np.random.default_rng(7), (90, 120), (170, 104, 96)), expect_disks()[1].any(0))
    states = ColourStates(tmp_path, {"cam0": model})
    for frame in (5, 6):
        states.save(frame, 1)
    assert states.restore(6, 1) == 6
    for path in state_files(tmp_path):  # first only that of frame 6, then both
        path.write_bytes(path.read_bytes()[:-40])
        assert states.restore(6, 1) == (5 if path == state_files(tmp_path)[0] else None)


def test_a_folder_without_key_masks_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="no masks of cam0"):
        KeyMasks(tmp_path, {"cam0": (30, 20)})
    path = mask_path(tmp_path, "cam0", "upper", 3)
    path.parent.mkdir(parents=True)
    write_mask(path, np.full((10, 10), 255, np.uint8))
    with pytest.raises(CaptureError, match="10 x 10 px"):
        KeyMasks(tmp_path, {"cam0": (30, 20)}).of("cam0", 3)
