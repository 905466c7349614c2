"""Numbers, plots and meshes for the screen."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from example_rig import example_meshes, example_rig

from jawusd.formats.keys import Key
from jawusd.formats.mesh import Mesh
from jawusd.geometry import LANDMARKS
from jawusd.viewer.motion import Clip
from jawusd.viewer.plots import bound_plot, curve_plot, posselt_plot, posselt_point, with_playhead
from jawusd.viewer.pose_panel import reading_html, slider_ends, verdict_html
from jawusd.viewer.readouts import border_path, habitual_path, landmark_places, measure_pose, rest_places
from jawusd.viewer.viewed import for_view, is_solid

RIG = example_rig()


def test_the_numbers_of_a_pose_are_displacements_in_anatomical_axes():
    d = np.array([14.0, 2.0, 0.5])
    A = RIG.T_anatomical_skull[:3, :3]
    T, rest = RIG.pose(d), RIG.T_rest
    moved = [A @ ((T - rest) @ [*RIG.landmarks[LANDMARKS.index(name)], 1])[:3] for name in
             ("incisor", "condyle_left", "condyle_right")]  # fmt: skip
    found = measure_pose(RIG, d)
    np.testing.assert_allclose(found.incisor_mm, moved[0], atol=1e-9)
    np.testing.assert_allclose([found.condyle_left_mm, found.condyle_right_mm], moved[1:], atol=1e-9)
    assert found.inside and found.margin_mm == float(RIG.margin(d)) and found.incisor_mm[1] < -10
    codes = RIG.captured_d
    nearest = np.linalg.norm(codes - d, axis=1).min() if len(codes) else np.inf
    assert found.captured_mm == pytest.approx(nearest)
    assert not measure_pose(RIG, [14.0, 40.0, 0.0]).inside


def test_the_places_of_five_poses_are_those_of_each():
    d = np.array([[0.0, 0, 0], [4, 1, 0], [9, -1, 0.5], [14, 2, 0], [20, 0, 0]])
    points = np.column_stack([RIG.landmarks, np.ones(5)])
    expected = [(RIG.T_anatomical_skull @ RIG.pose(one) @ points.T).T[:, :3] for one in d]
    np.testing.assert_allclose(landmark_places(RIG, d), expected, atol=1e-9)
    np.testing.assert_allclose(landmark_places(RIG, d[:4]), expected[:4], atol=1e-9)


def test_paths_begin_closed_and_borders_lie_on_the_bound():
    path = habitual_path(RIG, 20)
    np.testing.assert_allclose(path[0], landmark_places(RIG, [0.0, 0.0, 0.0]))
    for axis in (1, 2):
        ring = border_path(RIG, axis)
        assert len(ring) > 40 and np.abs(RIG.margin(ring)).max() < 1e-6
        assert (ring[:, 3 - axis] == 0).all() and np.ptp(ring[:, 0]) > 0.9 * np.ptp(RIG.d_range[0])


def marked(svg):
    """Return the centre of the mark in a plot, in data, and its colour."""
    root = ElementTree.fromstring(svg)
    circle = root.find("circle")
    return float(circle.get("cx")), float(circle.get("cy")), circle.get("fill")


@pytest.mark.parametrize("axis", [1, 2])
def test_the_present_pose_is_marked_where_it_belongs(axis):
    plot = bound_plot(RIG, axis)
    ElementTree.fromstring(plot.definition())
    (low_x, low_y), (high_x, high_y) = plot.low, plot.high
    left, bottom, _ = marked(plot.with_point(low_x, low_y, True))
    right, top, green = marked(plot.with_point(high_x, high_y, True))
    x, y, red = marked(plot.with_point(0.25 * low_x + 0.75 * high_x, 0.5 * (low_y + high_y), False))
    assert x == pytest.approx(0.25 * left + 0.75 * right, abs=0.11) and y == pytest.approx(
        0.5 * (top + bottom), abs=0.11
    )
    assert top < bottom and green != red
    border = border_path(RIG, axis)[:, [0, axis]]
    assert (border >= plot.low).all() and (border <= plot.high).all()


def test_posselt_figures_hold_the_border_and_mark_the_incisal_point():
    rest = rest_places(RIG)
    for axis, column in ((1, 0), (2, 2)):
        plot = posselt_plot(RIG, axis)
        ElementTree.fromstring(plot.definition())
        found = measure_pose(RIG, [10.0, 1.0, 0.0])
        x, y = posselt_point(landmark_places(RIG, [10.0, 1.0, 0.0]), rest, axis)
        assert (x, y) == pytest.approx((found.incisor_mm[column], found.incisor_mm[1]))
        assert plot.low[0] < x < plot.high[0] and plot.low[1] < y < plot.high[1]


def test_curves_are_drawn_with_their_keys_and_playhead():
    empty = curve_plot(None, (), (0, 100))
    assert "no keys" in empty.definition()
    ElementTree.fromstring(with_playhead(empty, 50))
    clip = Clip("<img>", np.array([0.0, 50.0]), np.array([[0, 0, 0], [10.0, 1, -1]]), 24)
    keys = (Key(frame=0, d=(0, 0, 0)), Key(frame=50, d=(10, 1, -1)))
    plot = curve_plot(clip, keys, (0, 100))
    root = ElementTree.fromstring(plot.definition())
    assert len([path for path in root.iter("path") if path.get("stroke-width") == "1.5"]) == 3
    assert len(list(root.iter("circle"))) == 6 and "<img>" not in plot.definition()
    heads = [float(re.search(r"M([\d.]+) ", with_playhead(plot, f)).group(1)) for f in (-5, 0, 50, 100, 500)]
    assert (
        heads[0] == heads[1] and heads[3] == heads[4] and heads[2] == pytest.approx((heads[1] + heads[3]) / 2, abs=0.11)
    )


def test_slider_ends_are_rounded_inwards_and_reach_beyond_only_when_allowed():
    limits = np.array([[0.0, 40.0], [-1.23456, 2.34567], [-0.1, 0.3]])
    kept = np.array(slider_ends(limits, limits * 3, keep_valid=True))
    assert (kept[:, 0] >= limits[:, 0] - 1e-6).all() and (kept[:, 1] <= limits[:, 1] + 1e-6).all()
    np.testing.assert_allclose(kept, limits, atol=0.01)
    free = np.array(slider_ends(limits, limits * 3, keep_valid=False))
    assert (free[:, 0] < limits[:, 0] * 3 + 1e-9).all() and (free[:, 1] > limits[:, 1] * 3).all()


def test_the_reading_says_in_words_and_colour_when_a_pose_is_outside():
    limits = np.array([[0.0, 40.0], [-2, 2], [-1, 1]])
    good = reading_html(measure_pose(RIG, [5.0, 0, 0]), (5.0, 0, 0), limits)
    bad = reading_html(measure_pose(RIG, [5.0, 30.0, 0]), (5.0, 30.0, 0), limits)
    assert "<b style" in bad and "<b style" not in good
    inside, outside = (verdict_html(measure_pose(RIG, [5.0, side, 0])) for side in (0.0, 30.0))
    assert "OUTSIDE" not in inside and "OUTSIDE" in outside and "margin -" in outside


def test_measures_are_explained_where_the_pointer_rests():
    reading = reading_html(measure_pose(RIG, [5.0, 0, 0]), (5.0, 0, 0), np.array([[0.0, 40.0], [-2, 2], [-1, 1]]))
    rows = {row.find("td").text: row.get("title") for row in ElementTree.fromstring(reading).iter("tr")}
    assert "pose" in rows["nearest captured"] and "forward" in rows["incisal point moved"] and all(rows.values())
    assert "forward" not in rows and 'title="Distance' in verdict_html(measure_pose(RIG, [5.0, 0, 0]))


def test_no_value_is_minus_zero():
    limits = np.array([[0.0, 40.0], [-2, 2], [-1, 1]])
    assert "-0.00" not in reading_html(measure_pose(RIG, [0.0, 0, 0]), (0.0, 0, 0), limits)


def sphere(count):
    """Return a closed triangulated sphere of radius 30 mm."""
    i, j = np.meshgrid(np.arange(count), np.arange(2 * count), indexing="ij")
    polar, turn = np.pi * (i + 0.5) / count, np.pi * j / count
    vertices = 30 * np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1)
    a = (i * 2 * count + j)[:-1]
    b = (i * 2 * count + (j + 1) % (2 * count))[:-1]
    c, e = a + 2 * count, b + 2 * count
    faces = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, e], -1).reshape(-1, 3)])
    return Mesh(vertices.reshape(-1, 3), faces)


def test_meshes_for_the_screen_are_small_and_keep_their_shape():
    mesh = sphere(120)
    small = for_view(mesh, 5000)
    assert 2500 < len(small.faces) <= 5000
    radius = np.linalg.norm(small.vertices, axis=1)
    assert radius.min() > 29 and radius.max() < 30.01
    a, b, c = (small.vertices[small.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", normal, a + b + c) > 0).mean() > 0.99  # still oriented outwards
    assert len(np.unique(np.sort(small.faces, axis=1), axis=0)) == len(small.faces)


def test_only_closed_meshes_that_face_outwards_are_solid():
    whole = example_meshes()["skull"]
    assert is_solid(whole) and is_solid(for_view(whole, 60))
    assert not is_solid(Mesh(whole.vertices, whole.faces[1:]))
    assert not is_solid(Mesh(whole.vertices, whole.faces[:, ::-1]))


def test_small_meshes_are_left_alone_and_colours_are_averaged():
    mesh = example_meshes()["lower_teeth"]
    assert for_view(mesh, len(mesh.faces)) is mesh
    small = for_view(mesh, len(mesh.faces) // 3)
    assert small.colors.shape == small.vertices.shape and len(small.faces) > 0
