"""Impossible bites are errors, unusual ones are warnings, and no valid bite is rejected."""

import numpy as np
import pytest

from jawusd.base.errors import TrackingError
from jawusd.formats.mesh import Mesh
from jawusd.geometry import (
    anatomical_frame,
    find_landmarks,
    make_transform,
    random_rotation,
    se3_exp,
    transform_points,
)
from jawusd.synthetic.anatomy import build_anatomy
from jawusd.synthetic.person import Person
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.initialization.scan_checks import check_occlusion, occlusion_findings


@pytest.fixture(scope="module")
def bite():
    anatomy = build_anatomy(Person(0))
    return anatomy.upper.mesh, anatomy.lower.mesh


def placed(mesh, move_mm=(0, 0, 0), turn_deg=(0, 0, 0), scale=1.0):
    """Return the mesh rotated about its centre, scaled and moved."""
    middle = mesh.vertices.mean(0)
    turn = se3_exp([*np.deg2rad(turn_deg), 0, 0, 0])[:3, :3]
    return Mesh((mesh.vertices - middle) @ turn.T * scale + middle + move_mm, mesh.faces, mesh.colors)


def without(mesh, lost):
    """Return the mesh without the faces that have a vertex for which `lost` is true."""
    faces = mesh.faces[~lost(mesh.vertices)[mesh.faces].any(1)]
    used, faces = np.unique(faces, return_inverse=True)
    colors = None if mesh.colors is None else mesh.colors[used]
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), colors)


def findings(upper, lower, axes=None):
    scans = prepare_scan(upper, "upper"), prepare_scan(lower, "lower")
    return occlusion_findings(scans, axes)[1]


def kinds(upper, lower, axes=None):
    return [finding.kind for finding in findings(upper, lower, axes)]


def bites(upper, lower):
    """Yield valid bites by name."""
    molars = lambda v: v[:, 2] < -24  # noqa: E731
    yield "usual", upper, lower
    yield "open in front", upper, placed(lower, (0, -0.3, 0), (0.4, 0, 0))
    yield "overjet of 7 mm", upper, placed(lower, (0, 0, -5))
    yield "no upper molars", without(upper, molars), lower
    yield "no lower molars", upper, without(lower, molars)
    yield "no molars", without(upper, molars), without(lower, molars)
    yield "no incisors", without(upper, lambda v: abs(v[:, 0]) < 14), without(lower, lambda v: abs(v[:, 0]) < 12)
    yield "no teeth lower left behind", upper, without(lower, lambda v: (v[:, 0] > 0) & (v[:, 2] < -14))
    yield "not painted", *(Mesh(mesh.vertices, mesh.faces) for mesh in (upper, lower))


def test_bites_of_persons_are_accepted_in_any_frame(bite):
    T = make_transform(random_rotation(np.random.default_rng(0)), [30, -80, 150.0])
    for name, upper, lower in bites(*bite):
        assert not kinds(upper, lower), name
        moved = [Mesh(transform_points(T, mesh.vertices), mesh.faces, mesh.colors) for mesh in (upper, lower)]
        assert not kinds(*moved), name
        crowns = [prepare_scan(mesh, "arch").crown_vertices() for mesh in moved]
        A = anatomical_frame(*crowns)
        up = (A @ T)[1, 1]
        assert up > 0.95, name
        assert np.isfinite(find_landmarks(crowns[1], None, A)).all(), name


def test_deep_bite_that_leaves_the_middles_at_one_height_is_accepted(bite):
    """The mean heights of two valid arches may differ by only 1 mm: only the contact of the crowns matters."""
    upper, lower = bite
    shallow = lambda v: v[:, 1] > v[:, 1].min() + 4.5  # noqa: E731
    short = without(upper, lambda v: shallow(v) & (v[:, 2] < -10))
    assert not [f for f in findings(short, lower) if f.severity == "error"]


@pytest.mark.parametrize(
    ("kind", "message", "change"),
    [
        ("scans_apart", r"they are \d\.\d mm apart at the closest point; at most 4", {"move_mm": (0, -7, 0)}),
        ("scans_beside", r"the arches are \d+ mm apart sideways", {"move_mm": (30, 0, 0)}),
        ("scans_beside", r"the arches are \d+ mm apart sideways", {"move_mm": (0, 3, -80)}),
        ("scans_inside", r"more than 2 mm above the upper ones over \d+%", {"move_mm": (0, 6, 0)}),
        ("scans_passed", "moved through one another", {"move_mm": (0, 14, 0)}),
        ("scans_turned", r"rotated by 1[678]\d degrees", {"turn_deg": (0, 180, 0)}),
        ("scan_upside_down", "the lower arch is upside down", {"turn_deg": (0, 0, 180)}),
        ("scans_size", r"the lower arch is 12\d mm wide", {"scale": 2.0}),
    ],
)
def test_impossible_bites_are_errors_with_their_cause(bite, kind, message, change):
    scans = prepare_scan(bite[0], "upper"), prepare_scan(placed(bite[1], **change), "lower")
    for axes in (None, np.eye(4)):
        assert [f.kind for f in occlusion_findings(scans, axes)[1]] == [kind]
        with pytest.raises(TrackingError, match=message):
            check_occlusion(scans, axes)


def test_upper_scan_upside_down_and_the_same_file_twice_are_refused(bite):
    upper, lower = bite
    assert kinds(placed(upper, turn_deg=(0, 0, 180)), lower) == ["scan_upside_down"]
    assert kinds(upper, upper) == ["scans_same"]


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("scans_open", {"move_mm": (0, -1.2, 0)}),
        ("scans_overlap", {"move_mm": (0, 2, 0)}),
        ("bite_tilted", {"turn_deg": (0, 0, 3)}),
        ("midlines_apart", {"move_mm": (5, 0, 0)}),
        ("underbite", {"move_mm": (0, -1, 5)}),
        ("arch_widths", {"scale": 0.7}),
        ("scan_size", {"scale": 1.36}),
    ],
)
def test_unusual_bites_are_warnings_with_a_value(bite, kind, change):
    found = {f.kind: f for f in findings(bite[0], placed(bite[1], **change))}
    assert kind in found
    assert found[kind].severity == "warning" and found[kind].value is not None and found[kind].limit is not None


def test_exchanged_files_are_reported(bite):
    assert "underbite" in kinds(bite[1], bite[0])


def test_given_axes_that_do_not_fit_are_reported(bite):
    up_and_down = np.diag([1.0, -1.0, -1.0, 1.0])
    assert kinds(*bite, up_and_down) == ["anatomical_axes_off"]
    assert kinds(*bite, np.eye(4)) == []
