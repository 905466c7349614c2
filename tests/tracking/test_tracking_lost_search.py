"""Teeth that were lost in masks are searched for in the frames in which they are visible again."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from bumpy_teeth import jaw_poses, render_masks, vertex_error_mm
from small_take import CAMERAS, MESHES, ROWS, make_capture, png, track, write_masks

from jawusd.base.errors import TrackingError
from jawusd.formats.tracks import LOST
from jawusd.geometry import se3_exp, transform_point
from jawusd.tracking.follow import TwoWays
from jawusd.tracking.initialization.footage import MaskSurvey
from jawusd.tracking.initialization.start_search import _OPENINGS_MM, _opened
from jawusd.tracking.sequence.passes import LostSearch

FRAMES = 13
# Counted from the first frame. After so many lost frames, the tracker itself seldom searches.
NOISE, AFTER = range(5, 11), range(11, 13)
OPENED = se3_exp([0.35, 0.0, 0.0, 0.0, -14.0, 3.0])  # how far the mouth opens while the masks are noise


def wrecked_take(folder):
    """Write masks that are noise for a while, after which the mouth is wide open; return the capture, true poses."""
    rng = np.random.default_rng(2)
    write_masks(folder, FRAMES)
    truth = jaw_poses(FRAMES)
    truth[AFTER.start :, 1] = truth[AFTER.start :, 1] @ OPENED
    for camera in CAMERAS:
        for k in (*NOISE, *AFTER):
            masks = render_masks(MESHES, truth[k], camera, (7.5, -60.0))
            for row, mask in zip(ROWS, masks, strict=True):
                mask = mask > 127 if k in AFTER else rng.random(mask.shape) < 0.5
                cv2.imwrite(str(png(folder, camera.name, row, k)), mask.astype(np.uint8) * 255)
    return make_capture(folder, FRAMES), truth


def test_teeth_are_found_again_although_the_mouth_opened_while_masks_were_wrong(tmp_path, monkeypatch):
    capture, truth = wrecked_take(tmp_path)
    tracks = track(capture)
    lost = (tracks.status == LOST).any(1)
    assert np.flatnonzero(lost).tolist() == list(NOISE)
    off_mm = [vertex_error_mm(MESHES[1], tracks.raw_T_world_lower[k], truth[k, 1]) for k in AFTER]
    assert max(off_mm) < 0.1
    monkeypatch.setattr(TwoWays, "recover", lambda *given: None)
    assert (track(capture).status[AFTER.start :, 1] == LOST).all(), "the tracker itself finds them"


@pytest.mark.parametrize(
    ("upper", "chosen"),
    [((), [11, 10, 9]), ((9, 10), [10, 9, 11]), ((8,), [11, 10, 9])],
)
def test_frames_with_large_masks_and_one_arch_found_are_searched_first(upper, chosen):
    """Masks of frame 8 are noise, those of frame 7 are missing; masks grow from 9 to 11. Frames below 7 are tracked."""
    area = {**dict.fromkeys(range(5), 100.0), 5: 200.0, 6: 100.0, 7: 0.0, 8: 2000.0, 9: 50.0, 10: 120.0, 11: 300.0}

    def survey(frames, count):
        numbers = np.arange(*(frames or (0, 12)))
        areas = np.array([np.full((2, 3), area[frame]) for frame in numbers.tolist()])
        return MaskSurvey(numbers, np.zeros((*areas.shape, 2)), areas, np.zeros((3, 3, 4)), np.zeros((3, 3)))

    records = {frame: SimpleNamespace(found=np.array([frame < 7 or frame in upper, frame < 7])) for frame in area}
    search = LostSearch(None, SimpleNamespace(survey=survey))
    assert search.frames(range(7, 12), records) == chosen


@pytest.mark.parametrize(("near", "anywhere", "found"), [(0.5, 0.5, "near"), (0.2, 0.5, "at"), (0.2, None, None)])
def test_teeth_are_searched_everywhere_unless_they_fit_clearly_near_known_poses(near, anywhere, found):
    def result(name, fit):
        def search(*given):
            if fit is None:
                raise TrackingError("impossible poses")
            return SimpleNamespace(fit=fit, poses=name)

        return search

    lost = LostSearch(lambda: SimpleNamespace(near=result("near", near), at=result("at", anywhere)), None)
    assert lost.at(7, np.zeros((2, 4, 4)), everywhere=True) == found
    assert lost.at(7, np.zeros((2, 4, 4)), everywhere=False) == (found if found == "near" else None)


@pytest.mark.parametrize(("front", "condyles"), [((-20.7, -2.0), (-4.9, 8.3)), ((-37.8, -4.6), (-6.8, 12.1))])
def test_the_jaw_is_searched_where_condyles_slide_forward(front, condyles):
    """Compare candidates with the motion of front teeth and condyles in wide openings, upward and forward [mm].

    The solver converges if points of the jaw are off by a few millimetres.
    """
    places = np.array([[0.0, 0.0, 0.0], [0.0, 40.0, -90.0]])
    moved = places + [[0.0, *front], [0.0, *condyles]]
    jaws = _opened(places[:1], np.eye(4), _OPENINGS_MM)
    off_mm = [np.linalg.norm(transform_point(T, places) - moved, axis=1).max() for T in jaws]
    assert min(off_mm) < 6.0
