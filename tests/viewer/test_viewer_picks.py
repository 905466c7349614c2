"""Picks, clicks and worst frames, without a page."""

import numpy as np
import pytest
import trimesh

from jawusd.formats.capture import Bootstrap
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import LOST, TRACKED, Tracks, uncovered_percent
from jawusd.geometry import make_transform, random_rotation, transform_points
from jawusd.viewer.picking import FOV_RAD, PickBook, PickingLayout, fit_view, hit_vertex, region_around
from jawusd.viewer.plots import coverage_plot, frame_html, frames_to_inspect, with_playhead


def filled():
    """Return three picks of each arch, seen by two cameras at frame 20."""
    book = PickBook()
    for arch in ("upper", "lower"):
        for vertex in (3, 5, 7):
            book.add(arch, vertex)
    for camera in ("a", "b"):
        book.select_incomplete(camera)
        for k in range(6):
            book.see(camera, 20, (10.0 * k, 5.0))
    return book


def test_picks_are_made_in_order_and_become_a_bootstrap():
    book = filled()
    made = book.bootstrap()
    assert made.frame == 20 and [pick.vertex for pick in made.upper] == [3, 5, 7]
    assert [pick.views[0].x for pick in made.lower] == [30.0, 40.0, 50.0]
    assert [view.camera for view in made.lower[0].views] == ["a", "b"]
    again = PickBook(made)
    assert again.bootstrap() == made and again.selected is None
    assert [book.name(k) for k in range(6)] == ["U1", "U2", "U3", "L1", "L2", "L3"]


def test_what_is_missing_is_said_and_not_written():
    book = PickBook()
    assert "upper teeth: 0 picks" in book.missing()
    with pytest.raises(ValueError, match="no pick is selected"):
        book.see("a", 20, (1.0, 2.0))
    with pytest.raises(ValueError, match="picks are incomplete"):
        book.bootstrap()
    book = filled()
    book.add("lower", 99)
    assert book.missing().startswith("L4 has pixels in 0")
    book.remove()
    assert book.missing() == ""


def test_pixels_of_two_frames_do_not_mix():
    book = filled()
    with pytest.raises(ValueError, match="belong to frame 20, not 21"):
        book.see("a", 21, (1.0, 2.0))
    assert book.frame == 20
    book.clear()
    book.add("upper", 1)
    book.see("a", 20, (1.0, 2.0))
    book.selected = 0
    book.see("b", 30, (3.0, 4.0))  # the only pick moves to the other frame and loses its old pixel
    assert book.frame == 30 and book.picks[0].views == {"b": (3.0, 4.0)}
    book.remove_pixel("b")
    book.remove()
    assert book.picks == [] and book.frame is None and book.selected is None


def test_a_vertex_clicked_twice_is_one_pick():
    book = filled()
    book.add("upper", 5)
    assert len(book.picks) == 6 and book.selected == 1


@pytest.fixture(scope="module")
def ball():
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=20.0)
    return Mesh(sphere.vertices, sphere.faces)


def test_a_ray_meets_the_vertex_that_faces_it(ball):
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = make_transform(random_rotation(rng), rng.normal(0, 30, 3))
        world = transform_points(pose, ball.vertices)
        target = int(rng.integers(len(world)))
        outwards = world[target] - pose[:3, 3]
        origin = world[target] + 3.0 * outwards
        vertex, distance = hit_vertex(ball, pose, origin, -outwards)
        assert vertex == target and distance == pytest.approx(60.0, abs=0.1)
        assert hit_vertex(ball, pose, origin, outwards) is None


def test_layout_pixels_and_rays_agree():
    table = PickingLayout((1280, 720), (400.0, 150.0, 900.0, 400.0))
    eye = np.array([3.0, -5.0, -200.0])
    for pixel in ((0.0, 0.0), (641.3, 278.9), (1279.4, 719.4)):
        assert table.pixel(eye, table.place(pixel) - eye) == pytest.approx(pixel, abs=1e-9)
    assert table.pixel(eye, table.place((1281.0, 20.0)) - eye) is None
    assert table.pixel(eye, eye - table.place((20.0, 20.0))) is None  # behind the camera
    assert table.pixel(eye, (1.0, 0.0, 0.0)) is None


def test_the_eye_sees_every_point_and_stands_no_farther_than_needed():
    rng = np.random.default_rng(2)
    for aspect in (0.6, 1.7):
        points, away, up = rng.normal(0, 40, (30, 3)), rng.normal(size=3), np.array([0.0, -1.0, 0.0])
        eye, target = fit_view(points, away, up, aspect)
        forward = (target - eye) / np.linalg.norm(target - eye)
        right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
        top = np.cross(right, forward)
        depth = (points - eye) @ forward
        share = np.abs(np.stack([(points - eye) @ right / aspect, (points - eye) @ top])) / depth / np.tan(FOV_RAD / 2)
        assert depth.min() > 0 and 0.8 < share.max() < 1.0


def test_a_region_has_room_and_stays_in_the_picture():
    low_x, low_y, high_x, high_y = region_around([[100, 5], [300, 80]], (640, 480))
    assert low_x < 100 and high_x > 300 and low_y == 0 and 80 < high_y < 479
    x0, y0, x1, y1 = region_around([[5, 5]], (640, 480))
    assert x1 > x0 and y1 > y0


def made_up_tracks(count=100):
    """Return tracks with frame 140 lost and a poor coverage of the lower arch at frame 120."""
    frames = np.arange(100, 100 + count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    lost = poses.copy()
    lost[40] = np.nan
    coverage = np.full((count, 2, 2), 0.005)
    coverage[20, 1] = 0.08
    coverage[60, 0, 1] = 0.9  # bad but unused
    used = np.ones((count, 2, 2), bool)
    used[60, 0, 1] = False
    status = np.full((count, 2), TRACKED, np.int8)
    status[40, 1] = LOST
    covariance = np.zeros((count, 6, 6))
    return Tracks(
        frames, poses, lost, lost, poses, lost, lost, status, np.zeros(count, bool), coverage, used,
        covariance, covariance, covariance, np.zeros((count, 5)), np.zeros((count, 2)), np.zeros((count, 2)),
        ("a", "b"),
    )  # fmt: skip


def test_worst_frames_are_the_lost_and_the_badly_covered_ones():
    tracks = made_up_tracks()
    assert frames_to_inspect(tracks, 24.0)[:2] == [140, 120]
    apart = np.diff(sorted(frames_to_inspect(tracks, 24.0)))
    assert apart.min() >= 12
    percent = uncovered_percent(tracks)
    assert percent[20, 1] == pytest.approx(8.0) and percent[60, 0] == pytest.approx(0.5)
    assert "8.00 %" in frame_html(tracks, 120) and "lost" in frame_html(tracks, 140)
    assert frame_html(tracks, 99) == frame_html(tracks, 200) == "not tracked"


def test_the_plot_marks_the_frame_and_breaks_where_nothing_is_known():
    tracks = made_up_tracks()
    tracks.coverage_error[50:60] = np.nan
    plot = coverage_plot(tracks, (100, 199), [140])
    assert plot.static.count("M") >= 4 and "nan" not in plot.static
    left, right = with_playhead(plot, 100), with_playhead(plot, 199)
    assert left != right and "nan" not in left + right


def test_empty_bootstraps_are_no_picks():
    assert PickBook(Bootstrap(frame=3)).picks == []
