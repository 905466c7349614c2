"""The search for teeth in footage ends, and reports the frames tried."""

from types import SimpleNamespace

import numpy as np
import pytest

from jawusd.base.errors import TrackingError
from jawusd.geometry import Camera, make_transform, so3_exp
from jawusd.pipeline.picture_search import PictureSearch, least_fit, orientations
from jawusd.pipeline.state import no_progress
from jawusd.segmentation.rows import Rows

TAKE = range(10, 2410)  # ten parts
LEAST_FIT = least_fit(2)


def camera(name, yaw_deg, quarters=0):
    """Return a camera at the level of the teeth in whose image upright heads are turned clockwise."""
    turn = so3_exp(np.array([0.0, 0.0, quarters * np.pi / 2])) @ so3_exp(np.radians([0.0, yaw_deg, 0.0]))
    return Camera(name, (640, 480), np.diag([900.0, 900.0, 1.0]), np.zeros(5), make_transform(turn, np.zeros(3)))


CAMERAS = {name: camera(name, yaw) for name, yaw in (("cam0", 0.0), ("cam1", 40.0))}


class _Footage:
    """Detect arches on every frame."""

    def __init__(self):
        self.looked_at = []

    def walk(self, frames):
        for frame in frames:
            self.looked_at.append(frame)
            yield frame, {"cam0": frame, "cam1": frame}

    def number(self, name, frame):
        return frame


@pytest.fixture
def searched(monkeypatch):
    """Search with a given fit per frame; return the outcome and the frames tried.

    `seen` returns how many pixels of each arch are visible in a frame; `alone` is the fit of starts from the masks of
    one camera of two, by camera.
    """

    def run(fit_of, upright=0, progress=no_progress, seen=lambda frame: (0, 0), cameras=tuple(CAMERAS), alone=None):
        def rows(picture, turns):
            masks = np.where(np.arange(16).reshape(4, 4) < np.reshape(seen(int(picture)), (2, 1, 1)), 255, 0)
            return Rows(masks.astype(np.uint8), 0.05) if upright in (turns, None) else None

        monkeypatch.setattr("jawusd.pipeline.picture_search.tooth_rows", rows)
        footage, tried, fits = _Footage(), [], []

        def near(sources, cameras, offsets, frame):
            tried.append(frame)
            fits.append(fit_of(frame) if alone is None or len(sources) > 1 else alone[sources[0].name])
            return None if fits[-1] is None else "pose"

        near_rows = SimpleNamespace(at=near)
        offsets = dict.fromkeys(CAMERAS, 0)
        used = {name: CAMERAS[name] for name in cameras}
        search = PictureSearch(footage, used, offsets, near_rows, lambda frame, pose: (pose, fits[-1]))
        try:
            return search.run(TAKE, progress), tried, footage
        except TrackingError as error:
            return error.message, tried, footage

    return run


def test_a_long_take_without_teeth_ends_and_says_what_was_tried(searched):
    words, tried, footage = searched(lambda frame: None)
    assert len(tried) == 30 and max(footage.looked_at) < 10 + 10 * 240
    assert "not found in 30 frames with a visible gap between the arches (10, 18," in words


def test_the_best_poor_fit_is_told(searched):
    words, _, _ = searched(lambda frame: 0.5 * LEAST_FIT if frame == 18 else 0.01)
    assert f"at best {0.5 * LEAST_FIT:.0%} of the contour in sight fits" in words


def test_teeth_in_a_later_part_are_found(searched):
    begin, tried, _ = searched(lambda frame: 0.9 if frame > 900 else None)
    assert begin.frame > 900 and begin.pose == "pose" and len(tried) < 24


def test_frames_looked_at_and_starts_tried_are_reported(searched):
    steps = []
    _, tried, _ = searched(lambda frame: 0.9 if frame == 26 else None, progress=lambda *step: steps.append(step))
    assert steps[:2] == [("search", 1, 30), ("search", 2, 30)]
    assert [step for step in steps if step[0] == "try starts"] == [("try starts", k, 3) for k in (1, 2, 3)]
    assert tried == [10, 18, 26]


@pytest.mark.parametrize("upright", [1, 2, 3])
def test_teeth_are_found_by_cameras_that_are_turned(searched, upright):
    begin, tried, _ = searched(lambda frame: 0.9, upright)
    assert begin.pose == "pose" and len(tried) == 1


def test_an_unclear_fit_is_compared_with_the_other_orientations(searched):
    """Arches that hang upside down in the images may fit a little."""
    fits = iter([LEAST_FIT + 0.01] * 4 + [LEAST_FIT + 0.05] + [0.01] * 7)
    begin, tried, _ = searched(lambda frame: next(fits), upright=None, alone=dict.fromkeys(CAMERAS, 0.01))
    assert begin.fit == LEAST_FIT + 0.05 and len(tried) == 12 + 2


def test_a_clear_fit_is_compared_with_those_in_other_frames(searched):
    """Arches that are shifted by a tooth may fit clearly."""
    fits = iter([0.65, 0.89])
    begin, tried, _ = searched(lambda frame: next(fits))
    assert (begin.fit, begin.frame, len(tried)) == (0.89, tried[1], 2)


def test_frames_that_show_most_of_both_arches_are_tried_first(searched):
    """In frame 50, only the upper arch is large."""
    large = {34: (2, 3), 42: (2, 2), 50: (4, 0)}
    _, tried, _ = searched(lambda frame: 0.01, seen=lambda frame: large.get(frame, (1, 1)))
    assert tried[:3] == [34, 42, 10]


def test_one_camera_needs_a_better_fit_to_end_the_search(searched):
    """With several cameras, 55 % of the contour in sight is clear, and other orientations are not tried."""
    tried = [searched(lambda frame: 0.55, None, cameras=names)[1] for names in (["cam0", "cam1"], ["cam0"])]
    assert list(map(len, tried)) == [3, 12]
    words, _, _ = searched(lambda frame: LEAST_FIT, cameras=["cam0"])
    assert f"at best {LEAST_FIT:.0%} of the contour in sight fits; at least {least_fit(1):.0%} is needed" in words


def test_starts_of_single_cameras_are_tried_if_those_of_several_do_not_fit(searched):
    fits = {"cam0": 0.01, "cam1": LEAST_FIT + 0.01}
    begin, tried, _ = searched(lambda frame: 0.5 * LEAST_FIT if frame == 18 else 0.01, alone=fits)
    assert (begin.frame, begin.fit) == (18, fits["cam1"]) and tried[-2:] == [18, 18]
    words, _, _ = searched(lambda frame: 0.01, alone=dict.fromkeys(fits, 0.9 * LEAST_FIT))
    assert f"at best {0.9 * LEAST_FIT:.0%} of the contour in sight fits" in words


@pytest.mark.parametrize("quarters", [(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3), (1, 1, 1), (2, 2, 2), (3, 1, 0)])
def test_one_of_four_orientations_makes_all_images_upright(quarters):
    """An image turned clockwise needs as many counter-clockwise turns; most cameras are upright in the first guess."""
    names, yaws = ("front", "left", "right"), (0.0, 40.0, -35.0)
    cameras = {name: camera(name, yaw, turn) for name, yaw, turn in zip(names, yaws, quarters, strict=True)}
    found = orientations(cameras)
    wanted = {name: turn for name, turn in zip(names, quarters, strict=True)}
    assert wanted in found and len(found) == 4
    if quarters.count(0) >= 2:
        assert found[0] == wanted


def test_a_camera_along_the_vertical_is_not_used():
    up = Camera(
        "up",
        (640, 480),
        np.diag([900.0, 900.0, 1.0]),
        np.zeros(5),
        make_transform(so3_exp(np.array([np.pi / 2, 0, 0])), np.zeros(3)),
    )
    assert [sorted(turns) for turns in orientations({"front": camera("front", 0.0), "up": up})].count(["front"]) == 2
