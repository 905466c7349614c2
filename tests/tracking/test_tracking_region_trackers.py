"""The trackers that follow the teeth by colour: starts, searches, and teeth that are lost and found again."""

import weakref
from collections import deque
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from package_copy import ROOT

from jawusd.formats.capture import load_capture
from jawusd.geometry import make_transform, relative_pose
from jawusd.pipeline.cameras import open_footage
from jawusd.pipeline.segment_guide import known_guide, save_guide
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.videos import Follower
from jawusd.segmentation.picture import ColourFootage
from jawusd.tracking.contour.equations import translation
from jawusd.tracking.contour.quality import score_px
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.performance.coordinates import Pose
from jawusd.tracking.region import rig_tracker
from jawusd.tracking.region import tracker as region_tracker
from jawusd.tracking.region.rig_tracker import RigTracker
from jawusd.tracking.region.search import THOROUGH, PoseSearch
from jawusd.tracking.sequence.guided import GuidedTracker
from jawusd.tracking.sequence.history import MotionPredictor


def prepared(teeth):
    return [prepare_scan(mesh, arch) for mesh, arch in zip(teeth, ("upper", "lower"), strict=True)]


@pytest.mark.parametrize(
    ("cameras", "fit", "searched", "others"),
    [(1, 0.4, True, 4), (1, 0.4, False, 0), (1, 0.7, True, 0), (2, 0.4, True, 0)],
)
def test_unclear_starts_of_one_camera_are_also_aligned_from_elsewhere(monkeypatch, cameras, fit, searched, others):
    tried = []

    def begun(cut, pose, jaw):
        tried.append(pose.head[:3, 3].tolist())
        use, views = np.ones((2, cameras), bool), [SimpleNamespace(eye=np.array([0.0, 0.0, -200.0]))] * cameras
        look = SimpleNamespace(use=use, views=views, fit=lambda *_: SimpleNamespace(found=None))
        aligned = SimpleNamespace(pose=pose)
        own = 0.9 if pose.head[0, 3] < 0 else fit
        rough = SimpleNamespace(solution=None)
        return SimpleNamespace(look=look, found=aligned, rough=rough, fit=own, share=0.2, colours=None, expected=None)

    monkeypatch.setattr(rig_tracker, "fitting_share", lambda solution: np.full(2, 0.2))
    monkeypatch.setattr(rig_tracker, "Prediction", lambda *_, **__: None)
    tracker = RigTracker.__new__(RigTracker)
    tracker._colours, tracker._coordinates = SimpleNamespace(axes=np.eye(3)), SimpleNamespace(pivot=np.zeros(3))
    tracker._head, tracker._free_focal, tracker._usual, tracker._begun = 1.0, False, deque(), begun
    tracker.begin(None, Pose(np.eye(4), np.array([5.0, 1.0, 1.0])), searched=searched)
    elsewhere = [[-8, 0, 0], [8, 0, 0], [0, 0, -7], [0, 0, 7]]
    assert tried == [[0, 0, 0]] * (2 if cameras == 1 else 1) + elsewhere[:others]
    assert tracker.first_fit == (0.9 if others else fit)


def test_the_example_is_followed_by_its_colours(tmp_path):
    capture = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    with np.load(capture.folder / "truth" / "truth.npz") as truth:
        offsets = dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))
        frames, poses = truth["frames"], np.stack([truth["T_world_upper"], truth["T_world_lower"]], axis=1)
    meshes = load_meshes(capture)
    teeth = meshes["upper_teeth"], meshes["lower_teeth"]
    cameras, videos = open_footage(capture)
    start = capture.bootstrap.frame
    picked = GuidedTracker(*teeth, lambda *_: [], 1).picked(capture.bootstrap, cameras)
    chosen = range(max(start - 2, int(frames[0])), start + 9)
    done = []
    footage, subject = Counted(videos, offsets), subject_of_capture(capture, meshes)
    follower = Follower(footage, cameras, prepared(teeth), subject)
    assert follower.start_at(start, picked)[1] > 0.3
    guide = follower.run(chosen, NotSearched, lambda *step: done.append(step))
    assert 1 <= footage.most <= 6  # of 8 frames; otherwise long takes exhaust the memory
    assert sorted(guide) == list(chosen) and done[-1] == ("follow", len(chosen), len(chosen))
    for frame, found in guide.items():
        true = poses[list(frames).index(frame)]
        for r, mesh in enumerate(teeth):
            points = np.c_[mesh.vertices[::50], np.ones(len(mesh.vertices[::50]))]
            off = np.linalg.norm((points @ (found.poses[r] - true[r]).T)[:, :3], axis=1)
            assert found.found[r] and off.mean() < 0.4
    save_guide(tmp_path, "abc", guide)
    again = known_guide(tmp_path, "abc")
    assert all(np.array_equal(again[frame].poses, guide[frame].poses) for frame in guide)
    assert known_guide(tmp_path, "other inputs") == {} == known_guide(tmp_path / "empty", "abc")


def test_directions_followed_at_the_same_time_learn_separately(monkeypatch):
    """Both start from the colours of the first frame, here a list, to which each frame adds its own."""

    class Learning:
        def __init__(self, search, colours, share, poses):
            self.colours = colours

        def follow(self, cuts):
            for cut in cuts:
                self.colours.append(cut)
                yield list(self.colours)

    monkeypatch.setattr(region_tracker, "_DirectionTracker", Learning)
    tracker = region_tracker.RegionTracker.__new__(region_tracker.RegionTracker)
    tracker._search, tracker._colours, tracker._first_share = None, ["first"], None
    ahead, back = tracker.follow(iter("ab"), None), tracker.follow(iter("c"), None)
    assert [next(ahead), next(back), next(ahead)] == [["first", "a"], ["first", "c"], ["first", "a", "b"]]
    assert tracker._colours == ["first"] and tracker._latest == ["first", "a", "b"]


class Counted(ColourFootage):
    """Count the instants whose images are in memory when the next one is requested, going forwards."""

    most = 0

    def walk(self, frames):
        shown = []
        for frame, pictures in super().walk(frames):
            shown.append([weakref.ref(image) for image in pictures.values()])
            yield frame, pictures
            del pictures
            if frames.step > 0:
                self.most = max(self.most, sum(any(one() is not None for one in held) for held in shown))


class Covered(ColourFootage):
    """Replace some frames by others, or by uniform skin, as under closed lips."""

    SHOWN: ClassVar = {22: None, 23: 48, 24: 49}

    def walk(self, frames):
        for frame in frames:
            instead = self.SHOWN.get(frame, frame)
            for _, pictures in super().walk(range(instead or frame, (instead or frame) + 1)):
                skin = {name: np.full_like(image, (190, 130, 110)) for name, image in pictures.items()}
                yield frame, skin if instead is None else pictures


def test_a_jaw_that_is_lost_slowly_does_not_get_usual():
    """A pose that drifts away fits less and less, which must not lower the usual share."""
    tracker = RigTracker.__new__(RigTracker)
    tracker._usual, tracker._first = deque([np.array([0.5, 0.4])] * 3, maxlen=15), np.array([0.5, 0.3])
    for share in np.linspace(0.2, 0.14, 30):
        tracker._remember(np.array([0.5, share]))
    np.testing.assert_allclose(tracker._usual_share(), [0.5, 0.4])
    for share in np.linspace(0.4, 0.3, 30):
        tracker._remember(np.array([0.5, share]))
    assert tracker._usual_share()[1] < 0.35


@pytest.mark.parametrize(("fits", "kept"), [([0.3, 0.12], "near"), ([0.3, 0.2], "far"), ([0.12, 0.3], "near")])
def test_what_a_search_finds_is_kept_only_if_enough_of_it_fits(monkeypatch, fits, kept):
    """With a closed mouth hardly anything fits, so the best pose of a search is arbitrary."""
    monkeypatch.setattr(rig_tracker, "fitting_share", np.asarray)
    near, far = SimpleNamespace(pose="near", solution=[0.3, 0.05]), SimpleNamespace(pose="far", solution=fits)
    look = SimpleNamespace(align=lambda *_: near)
    tracker = RigTracker.__new__(RigTracker)
    tracker._effort, tracker._failed, tracker._head = THOROUGH, 0, 0.1
    tracker._motion, tracker._usual_share = SimpleNamespace(last=None), lambda: np.array([0.4, 0.4])
    monkeypatch.setattr(rig_tracker, "_better", lambda one, other: one)
    tracker._wide_look, tracker._searched = (lambda *_: look), (lambda *_: far)
    found, _ = tracker._best(SimpleNamespace(pose=None), look, None, 1.0, np.array([0.15, 0.15]))
    assert found.pose == kept


@pytest.mark.parametrize(
    ("d", "other_d", "score", "ambiguous"),
    [
        ([0.5, 0.0, 0.0], [0.5, 0.0, 2.0], 0.9, True),
        ([0.5, 0.0, 0.0], [0.5, 0.0, 0.4], 0.9, False),  # the same pose
        ([0.5, 0.0, 0.0], [0.5, 0.0, 2.0], 0.6, False),  # fits worse
        ([5.0, 0.0, 0.0], [5.0, 0.0, 2.0], 0.9, False),  # open
    ],
)
def test_nearly_closed_teeth_are_not_found_if_another_pose_fits(monkeypatch, d, other_d, score, ambiguous):
    pose, other = (SimpleNamespace(d=np.array(values)) for values in (d, other_d))
    found, trial = SimpleNamespace(pose=pose, score=1.0), SimpleNamespace(pose=other, score=score)
    monkeypatch.setattr(rig_tracker, "_matched_score", lambda aligned: aligned.score)
    tracker = RigTracker.__new__(RigTracker)
    jaw = SimpleNamespace(pose=lambda d: make_transform(np.eye(3), np.array([d[1], -d[0], d[2]])))
    tracker._coordinates = SimpleNamespace(jaw=jaw, arches=lambda pose: None)
    tracker._instants = SimpleNamespace(solver=SimpleNamespace(scans=[None, SimpleNamespace(probes=np.eye(3))]))
    look = SimpleNamespace(use=np.ones((2, 1), bool), align=lambda *_: found, polished=lambda aligned: aligned)
    tracker._motion, tracker._effort = SimpleNamespace(around=lambda pose: None), THOROUGH
    tracker._look, tracker._habitual = (lambda *_: look), (lambda *_: [trial])
    tracker._usual_share, tracker._judged = (lambda: np.full(2, 0.4)), (lambda look, rough, found, least, pose: least)
    least = tracker.again(None, SimpleNamespace(pose=pose, found=np.ones(2, bool)))
    assert least[0] < 0.4 and np.isinf(least[1]) == ambiguous


def test_a_jaw_out_of_sight_is_searched_although_the_head_fits_less_than_usual(monkeypatch):
    """In dim light less of both contours matches; the head may still be right."""
    monkeypatch.setattr(region_tracker, "fitting_share", np.asarray)
    fits, tried = [0.18, 0.02], []
    search = SimpleNamespace(
        best=lambda *_: fits,
        from_farther=lambda *_: fits,
        near=lambda *_, **__: fits,
        with_head_alone=lambda *_: tried.append("head alone") or fits,
        with_head_searched=lambda *_: tried.append("head") or fits,
        with_jaw_searched=lambda *_: tried.append("jaw") or fits,
        with_jaw=lambda solution, look, least: tried.append(f"both, if {least:.3f} of the jaw fits") or fits,
    )
    one_way = region_tracker._DirectionTracker.__new__(region_tracker._DirectionTracker)
    one_way._search, one_way._poses, one_way._motion, one_way._found = search, None, None, np.ones(2, bool)
    one_way._rest = one_way._absent = one_way._missed = 0
    one_way._located([None], None, np.array([0.33, 0.3]))
    assert tried == ["head alone", "head", "jaw", "both, if 0.075 of the jaw fits"]


def solution_that_fits(upper_px, lower_px):
    """Return a solution of one camera of which so much contour fits, of 100 px per arch."""
    outline, poses = SimpleNamespace(score_px=np.array([[upper_px], [lower_px]])), np.stack([np.eye(4)] * 2)
    return SimpleNamespace(outline=outline, visible_px=np.full((2, 1), 100.0), poses=poses)


@pytest.mark.parametrize(
    ("both_px", "least", "fitting_px"),
    [
        ((60.0, 20.0), 0.1, (60.0, 20.0)),  # the head fits a little less, but the jaw as well
        ((30.0, 20.0), 0.1, (61.0, 0.0)),  # less fits in total
        ((60.0, 20.0), 0.3, (61.0, 0.0)),  # so little of the jaw fits that it is not found
    ],
)
def test_a_jaw_counts_again_after_its_head_was_aligned_alone(monkeypatch, both_px, least, fitting_px):
    search = PoseSearch.__new__(PoseSearch)
    search.condyles = SimpleNamespace(strain=lambda relative: 0.0)
    monkeypatch.setattr(search, "near", lambda *_, firm: solution_that_fits(*both_px))
    found = search.with_jaw(solution_that_fits(61.0, 0.0), None, least)
    np.testing.assert_array_equal(score_px(found)[:, 0], fitting_px)


@pytest.mark.parametrize(("fits", "kept"), [((0.3, 0.1), True), ((0.3, 0.05), False), ((0.05, 0.1), False)])
def test_a_lost_jaw_that_fits_a_little_is_the_start_for_the_next_frame(monkeypatch, fits, kept):
    start, better = (np.stack([np.eye(4), translation(np.array([0.0, down, 0.0]))]) for down in (0.0, -3.0))
    one_way = region_tracker._DirectionTracker.__new__(region_tracker._DirectionTracker)
    one_way._search = SimpleNamespace(
        config=SimpleNamespace(least_matched_px=0.0),
        objective_px=lambda solution: 0.0,
        polished=lambda *_, **__: SimpleNamespace(poses=better),
    )
    one_way._motion = MotionPredictor(start, np.zeros((2, 1, 3)))
    one_way._found = np.array([True, False])
    monkeypatch.setattr(region_tracker, "fitting_share", lambda solution: np.array(fits))
    monkeypatch.setattr(region_tracker, "matched_px", lambda solution: np.full(2, 100.0))
    monkeypatch.setattr(region_tracker, "_covariance", lambda solution: np.zeros((2, 6, 6)))
    given = one_way._taken(None, None, True, np.full(2, 0.3), True)
    assert not given.found[1]
    np.testing.assert_allclose(one_way._motion.starts()[0][1], (better if kept else start)[1], atol=1e-12)


@pytest.mark.parametrize(("found", "due"), [(True, [1, 2, 4, 8]), (False, [1, 2, 3, 4, 5, 6, 8])])
def test_arches_that_fit_badly_are_searched_less_and_less_often(found, due):
    assert [count for count in range(10) if region_tracker._is_due(count, found)] == due


@pytest.mark.slow
def test_teeth_are_found_again_when_lips_open_over_an_open_jaw():
    capture = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    with np.load(capture.folder / "truth" / "truth.npz") as truth:
        offsets = dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))
        first, relative, incisor = truth["frames"][0], truth["T_upper_lower"], np.append(truth["landmarks"][0], 1.0)
    meshes = load_meshes(capture)
    teeth = meshes["upper_teeth"], meshes["lower_teeth"]
    cameras, videos = open_footage(capture)
    start = capture.bootstrap.frame
    picked = GuidedTracker(*teeth, lambda *_: [], 1).picked(capture.bootstrap, cameras)
    follower = Follower(Covered(videos, offsets), cameras, prepared(teeth), subject_of_capture(capture, meshes))
    follower.start_at(start, picked)
    guide = follower.run(range(20, 25), NotSearched, lambda *_: None)
    assert not guide[22].found.any()
    exact = {frame: relative[Covered.SHOWN[frame] - first] for frame in (23, 24)}
    assert np.linalg.norm((exact[23] @ incisor - incisor)[:3]) > 10.0  # mm; the head moved by 4 mm
    for frame, true in exact.items():
        assert guide[frame].found.all()
        assert np.linalg.norm(((relative_pose(*guide[frame].poses) - true) @ incisor)[:3]) < 0.5


class NotSearched:
    """A search that fails the test."""

    @staticmethod
    def run(frames, *_):
        raise AssertionError(f"the teeth are not lost on frames {frames}")
