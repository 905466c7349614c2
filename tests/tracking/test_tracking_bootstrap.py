"""Initial poses from picks."""

import numpy as np
import pytest
from bumpy_teeth import arch, jaw_poses, make_cameras, vertex_error_mm

from jawusd.base.errors import TrackingError
from jawusd.formats.capture import Pick, PickView
from jawusd.geometry import transform_point
from jawusd.tracking.initialization.bootstrap import pose_from_picks

MESH = arch(True)
POSE = jaw_poses(4)[3, 0]
CAMERAS = {c.name: c for c in make_cameras(distortion=-0.03)}


def _picks(count, noise_px=0.0, views=2, seed=0):
    rng = np.random.default_rng(seed)
    names = list(CAMERAS)
    out = []
    for k, vertex in enumerate(rng.permutation(np.linspace(0, len(MESH.vertices) - 1, count).astype(int))):
        seen = [names[(k + j) % len(names)] for j in range(views)]
        place = transform_point(POSE, MESH.vertices[vertex])
        pixels = [CAMERAS[n].project(place) + noise_px * rng.normal(size=2) for n in seen]
        spots = tuple(PickView(camera=n, x=float(p[0]), y=float(p[1])) for n, p in zip(seen, pixels))
        out.append(Pick(vertex=int(vertex), views=spots))
    return out


def _moved(pick, dx):
    first, *rest = pick.views
    return Pick(vertex=pick.vertex, views=(PickView(camera=first.camera, x=first.x + dx, y=first.y), *rest))


@pytest.mark.parametrize(("count", "views"), [(3, 2), (4, 2), (4, 3), (9, 2)])
def test_exact_picks_give_the_exact_pose(count, views):
    pose, wrong = pose_from_picks(_picks(count, views=views), MESH.vertices, CAMERAS, "upper")
    assert not wrong
    assert vertex_error_mm(MESH, pose, POSE) < 1e-6


def test_noisy_picks_start_within_the_basin():
    errors = [
        vertex_error_mm(MESH, pose_from_picks(_picks(4, 1.0, seed=s), MESH.vertices, CAMERAS, "upper")[0], POSE)
        for s in range(8)
    ]
    assert max(errors) < 0.8


@pytest.mark.parametrize("bad", [0, 2])
@pytest.mark.parametrize("count", [4, 6])
def test_one_wrong_pick_is_rejected_and_reported(count, bad):
    picks = _picks(count, 0.3)
    vertex = (picks[bad].vertex + len(MESH.vertices) // 2) % len(MESH.vertices)
    picks[bad] = Pick(vertex=vertex, views=picks[bad].views)
    pose, wrong = pose_from_picks(picks, MESH.vertices, CAMERAS, "upper")
    assert wrong == [bad + 1]
    assert vertex_error_mm(MESH, pose, POSE) < 0.5


def test_one_wrong_pixel_is_rejected():
    picks = _picks(5, 0.2)
    picks[1] = _moved(picks[1], 60.0)
    pose, wrong = pose_from_picks(picks, MESH.vertices, CAMERAS, "upper")
    assert wrong == [2]
    assert vertex_error_mm(MESH, pose, POSE) < 0.4


def test_three_contradicting_picks_are_an_error_with_their_residuals():
    picks = _picks(3)
    picks[0] = _moved(picks[0], 90.0)
    with pytest.raises(
        TrackingError, match=r"picks on the upper teeth contradict one another \(pick 1: .* up to 1.1 mm is allowed"
    ):
        pose_from_picks(picks, MESH.vertices, CAMERAS, "upper")


def test_two_picks_are_too_few():
    with pytest.raises(TrackingError, match="2 picks on the lower teeth; at least 3"):
        pose_from_picks(_picks(4)[:2], MESH.vertices, CAMERAS, "lower")


def test_picks_on_a_line_are_refused():
    line = np.column_stack([np.linspace(-20, 20, 5), np.zeros(5), np.zeros(5)])
    picks = []
    for k, point in enumerate(line):
        place = transform_point(POSE, point)
        spots = [(n, CAMERAS[n].project(place)) for n in ("cam0", "cam1")]
        picks.append(Pick(vertex=k, views=tuple(PickView(camera=n, x=float(p[0]), y=float(p[1])) for n, p in spots)))
    with pytest.raises(TrackingError, match="lie on a line"):
        pose_from_picks(picks, line, CAMERAS, "upper")


def test_pick_outside_of_the_picture_is_refused():
    picks = _picks(4)
    picks[2] = _moved(picks[2], 5000.0)
    with pytest.raises(TrackingError, match="pick 3 on the upper teeth lies at .* outside its 640 x 400 image"):
        pose_from_picks(picks, MESH.vertices, CAMERAS, "upper")


def test_pick_beyond_the_scan_is_refused():
    picks = _picks(3)
    picks[1] = Pick(vertex=len(MESH.vertices), views=picks[1].views)
    with pytest.raises(TrackingError, match=r"pick 2 .* refers to vertex \d+, but the scan has"):
        pose_from_picks(picks, MESH.vertices, CAMERAS, "upper")


def test_pick_seen_twice_by_one_camera_is_refused():
    picks = _picks(3)
    picks[0] = Pick(vertex=picks[0].vertex, views=(picks[0].views[0], picks[0].views[0]))
    with pytest.raises(TrackingError, match="pick 1 .* has a pixel in camera cam0 only; its depth is unknown"):
        pose_from_picks(picks, MESH.vertices, CAMERAS, "upper")


def test_pick_in_an_unknown_camera_is_refused():
    picks = _picks(3)
    views = (picks[0].views[0], PickView(camera="cam9", x=1.0, y=1.0))
    picks[0] = Pick(vertex=picks[0].vertex, views=views)
    with pytest.raises(TrackingError, match="refers to camera cam9, which is not calibrated"):
        pose_from_picks(picks, MESH.vertices, CAMERAS, "upper")


@pytest.mark.parametrize("size", [0.75, 1.3])
def test_picks_that_agree_with_another_size_of_scan_say_so(size):
    words = rf"agree with a scan {abs(1 / size - 1):.1%} {'larger' if size < 1 else 'smaller'}"
    for seed in range(4):
        with pytest.raises(TrackingError, match="agree with a scan"):
            pose_from_picks(_picks(5, 0.5, seed=seed), size * MESH.vertices, CAMERAS, "upper")
    with pytest.raises(TrackingError, match=words):
        pose_from_picks(_picks(5), size * MESH.vertices, CAMERAS, "upper")


def test_picks_on_other_teeth_are_not_taken_for_another_size():
    picks = _picks(5)
    turned = [Pick(vertex=a.vertex, views=b.views) for a, b in zip(picks, [*picks[1:], picks[0]])]
    with pytest.raises(TrackingError, match="contradict one another \\(pick 1"):
        pose_from_picks(turned, MESH.vertices, CAMERAS, "upper")


def test_exchanged_cameras_are_named():
    names = {"cam0": "cam1", "cam1": "cam0"}
    message = "cameras cam0 and cam1 are exchanged, in the picks or in the calibration"
    for seed in range(4):
        picks = _picks(5, 0.5, views=2, seed=seed)
        wrong = [
            Pick(
                vertex=p.vertex,
                views=tuple(v.model_copy(update={"camera": names.get(v.camera, v.camera)}) for v in p.views),
            )
            for p in picks
        ]
        with pytest.raises(TrackingError, match=message):
            pose_from_picks(wrong, MESH.vertices, CAMERAS, "upper")


def test_views_that_do_not_meet_report_the_calibration():
    picks = []
    for pick in _picks(5):
        first, *rest = pick.views
        picks.append(Pick(vertex=pick.vertex, views=(first.model_copy(update={"y": first.y + 60.0}), *rest)))
    with pytest.raises(TrackingError, match="lines of sight .* a calibration or camera name is wrong"):
        pose_from_picks(picks, MESH.vertices, CAMERAS, "upper")
