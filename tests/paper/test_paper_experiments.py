"""The paper's experiments: measures against brute force or known geometry, and a full run on a synthetic person."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import trimesh

from jawusd.fitting import FittingConfig
from jawusd.fitting.data import PARAMETERS, SubjectAnatomy, select_poses
from jawusd.formats.atomic import write_csv_atomic
from jawusd.formats.experiments import TABLE_COLUMNS, CondylePath
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import TRACKED, Tracks
from jawusd.geometry import make_transform, se3_exp, transform_point, transform_points
from jawusd.paper import experiments, nlpca
from jawusd.paper.condyle_paths import condyle_paths, path_distances, principal_opening, sagittal_section
from jawusd.paper.experiments import (
    BOX,
    MODELS,
    POLYGONS,
    SLICES,
    Bounds,
    captured_reference,
    distance_to_nearest,
    run_experiments,
)
from jawusd.paper.nlpca import train_nlpca
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person

FRAMES = 240


@pytest.fixture(scope="module")
def person():
    return Person(1)


@pytest.fixture(scope="module")
def poses(person):
    return record(person, FRAMES, 1).T_noisy


@pytest.fixture(scope="module")
def anatomy(person):
    to_anatomical = make_transform(np.eye(3), -person.landmarks[0])
    return SubjectAnatomy.of(to_anatomical, person.landmarks, person.mandible_points, None)


@pytest.fixture(scope="module")
def data(poses, anatomy):
    return select_poses(np.arange(FRAMES), poses, anatomy).data


@pytest.fixture(scope="module")
def quick():
    """Train the networks for a tenth of the usual time, and draw a fifth of the random poses."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiments, "POSES", 200)
        patch.setattr(experiments, "_BATCH", 800)
        patch.setattr(nlpca, "train_nlpca", lambda *a, **k: train_nlpca(*a, **(k | {"stages": 2})))
        yield


@pytest.fixture(scope="module")
def found(quick, poses, anatomy):
    return run_experiments((np.arange(FRAMES), poses), anatomy, config=FittingConfig(starts=1), actor="someone")


def brute_force(anatomy, motion, captured):
    points = anatomy.at_rest(anatomy.mandible_vertices)
    moved, known = transform_points(motion, points), transform_points(captured, points)
    return np.array([np.linalg.norm(known - one, axis=-1).max(1).min() for one in moved])


def test_the_nearest_captured_pose_is_that_of_brute_force(data, anatomy):
    motion = data.motion[:40] @ se3_exp(np.random.default_rng(0).normal(size=(40, 6)) * [0.02, 0.02, 0.02, 2, 2, 2])
    expected = brute_force(anatomy, motion, data.motion)
    np.testing.assert_allclose(distance_to_nearest(data.metric, motion, data.motion), expected, atol=1e-9)


def test_the_reference_never_looks_into_its_own_part(data, anatomy):
    found = captured_reference(data.metric, data.motion, 4)
    part = np.arange(FRAMES) * 4 // FRAMES
    for k in range(4):
        expected = brute_force(anatomy, data.motion[part == k], data.motion[part != k])
        np.testing.assert_allclose(found[part == k], expected, atol=1e-9)


def test_random_parameters_fill_each_bound_and_nothing_else():
    rng = np.random.default_rng(0)
    d = rng.uniform([0, -8, -1], [40, 8, 6], (600, 3)) * np.linspace(0.2, 1, 600)[:, None]
    bounds = Bounds.of(d, 0.23)
    drawn = bounds.draw(np.random.default_rng(1))
    assert tuple(drawn) == (BOX, POLYGONS, SLICES)
    assert {len(values) for values in drawn.values()} == {experiments.POSES}
    assert (drawn[BOX] >= d.min(0)).all() and (drawn[BOX] <= d.max(0)).all()
    for axis, rings in zip((1, 2), bounds.rings, strict=True):
        shape = shapely.union_all([shapely.Polygon(ring) for ring in rings]).buffer(1e-9)
        assert shapely.contains_xy(shape, drawn[POLYGONS][:, 0], drawn[POLYGONS][:, axis]).all()
        assert not shapely.contains_xy(shape, drawn[BOX][:, 0], drawn[BOX][:, axis]).all()
    assert (bounds.slices.signed_distance(drawn[SLICES]) <= 0).all()
    # Uniform, neither concentrated in the middle nor at the edge.
    assert np.abs(drawn[BOX].mean(0) - bounds.box.mean(1)).max() < 0.05 * np.ptp(bounds.box, axis=1).max()


def test_a_sphere_is_cut_in_circles():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=10.0)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    cut = sagittal_section(mesh, np.array([6.0, 0.0, 0.0]), 50.0)
    assert np.abs(np.linalg.norm(cut, axis=-1) - 8.0).max() < 0.1
    length = np.linalg.norm(cut[:, 0] - cut[:, 1], axis=-1).sum()
    assert length == pytest.approx(2 * np.pi * 8, rel=0.01)  # closed, once around
    assert len(sagittal_section(mesh, np.array([20.0, 0.0, 0.0]), 50.0)) == 0
    assert len(sagittal_section(mesh, np.array([6.0, 0.0, 20.0]), 5.0)) == 0


def test_the_first_component_of_a_screw_motion_is_that_screw(data):
    screw = np.array([0.01, 0.0, 0.001, 0.0, -0.9, -0.2])
    amount = np.random.default_rng(2).uniform(0, 40, FRAMES)
    straight = replace(data, motion=se3_exp(amount[:, None] * screw))
    swept = principal_opening(straight)
    points = transform_point(swept, data.incisor)
    expected = transform_point(se3_exp(np.linspace(0, 40, 4000)[:, None] * screw), data.incisor)
    assert np.linalg.norm(points[:, None] - expected, axis=-1).min(1).max() < 0.02
    opened = -(points[:, 1] - data.incisor[1])
    assert opened[-1] == pytest.approx(opened.max()) and opened[-1] > 20


def test_paths_are_measured_against_the_captured_condyles():
    z = np.linspace(0, 10, 200)
    captured = np.stack([np.stack([np.zeros(200), -z, z], 1)] * 2)
    raised = captured[:, ::4] + [0.0, 2.0, 0.0]
    lowered = captured[:, ::4] - [0.0, 2.0, 0.0]
    paths = [CondylePath(name, z[::4], points, ()) for name, points in (("up", raised), ("down", lowered))]
    d = np.zeros((200, 3))
    d[:100, 1] = 5.0  # the nearer half was captured while the jaw was sideways
    up, up_from, down, down_from = path_distances(paths, captured, d)
    # Next to a point the line lies up to 0.75 mm higher.
    assert 1.2 < up.values_mm.mean() < 1.6 and down.values_mm.max() == 0.0
    assert up_from.values_mm.max() > 5.0 and np.isclose(up_from.values_mm.min(), np.sqrt(2), atol=0.05)
    assert len(down_from.values_mm) == len(up_from.values_mm) == 100


@pytest.mark.slow
def test_every_model_and_component_count_is_in_the_table(found):
    table = found.table()
    assert all(tuple(row) == TABLE_COLUMNS for row in table)
    rebuilt = {row["model"] for row in table if row["experiment"] == "reconstruction"}
    assert rebuilt >= {f"NLPCA {k}" for k in range(1, 6)} | set(MODELS) | {"paper, literal, as published"}
    drawn = {(row["model"], row["quantity"]) for row in table if row["experiment"] == "synthesis"}
    assert drawn == {(name, bound) for name in MODELS for bound in (BOX, POLYGONS, SLICES)} | {
        ("captured hold-out poses", "5 contiguous parts")
    }
    assert [path.model for path in found.condyle_paths] == ["principal component 1", "paper", "anchored"]
    mean = {row["model"]: row["mean_mm"] for row in table if row["experiment"] == "reconstruction"}
    assert mean["anchored"] < mean["additive"] < mean["pca"] < mean["NLPCA 1"]


@pytest.mark.slow
def test_rows_repeat_the_distances(found):
    one = found.of("reconstruction")[0]
    row = one.row()
    assert (row["count"], row["max_mm"]) == (FRAMES, pytest.approx(max(one.values_mm)))
    assert row["mean_mm"] == pytest.approx(sum(one.values_mm) / FRAMES)


@pytest.mark.slow
def test_the_table_is_written_as_csv(found, tmp_path):
    write_csv_atomic(tmp_path / "t.csv", TABLE_COLUMNS, found.table())
    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert lines[0] == ",".join(TABLE_COLUMNS) and len(lines) == len(found.table()) + 1


@pytest.mark.slow
def test_gaps_are_inside_the_bound_and_far_from_every_pose(found):
    coverage = found.coverage
    for index, gaps in enumerate(coverage.gaps):
        scaled = (gaps[:, None] - coverage.d[None, :, [0, index + 1]]) / [3.0, 2.0]
        assert not len(gaps) or np.linalg.norm(scaled, axis=-1).min() > 1
        named = any(f"bound of opening and {PARAMETERS[index + 1]}" in sentence for sentence in coverage.sentences)
        width = np.nan_to_num(np.diff(coverage.slices[index], axis=1)[:, 0])
        area = np.trapezoid(width, coverage.slices_d1)
        assert named == (0.25 * len(gaps) / area > 0.15)  # gaps lie on a grid of 0.5 mm
        low, high = np.nanmin(coverage.slices[index]), np.nanmax(coverage.slices[index])
        assert (gaps[:, 1] > low - 0.3).all() and (gaps[:, 1] < high + 0.3).all()


def test_models_sweep_the_opening_alone(data, anatomy, person):
    class Sinking:
        """A model whose opening is a translation down."""

        def motion(self, d):
            return make_transform(np.tile(np.eye(3), (len(d), 1, 1)), -d[:, :1] * [0, 1.0, 0])

    path = condyle_paths(data, {"sinking": Sinking()}, 20.0, None, anatomy)[1]
    np.testing.assert_allclose(path.points[0, -1] - path.points[0, 0], [0, -20, 0], atol=1e-9)
    np.testing.assert_allclose(path.opening_mm, np.linspace(0, 20, len(path.opening_mm)), atol=1e-9)


def test_opening_alone_leaves_the_papers_model_out_and_says_so(quick, person, anatomy):
    angle = np.linspace(0, 1, 120) * np.deg2rad(25)
    centre = anatomy.at_rest(person.landmarks)[3:].mean(0)
    slide = np.stack([0 * angle, -6 * angle, 18 * angle], 1)
    hinge = make_transform(np.eye(3), centre)
    opening = hinge @ se3_exp(np.concatenate([angle[:, None] * [1.0, 0, 0], slide], 1)) @ np.linalg.inv(hinge)
    to_skull = np.linalg.inv(anatomy.T_anatomical_skull)
    T = to_skull @ opening @ anatomy.T_anatomical_skull
    found = run_experiments((np.arange(120), T), anatomy, config=FittingConfig(starts=1))
    assert any(note.startswith("paper: ") and "opening" in note for note in found.notes)
    assert {one.model for one in found.of("synthesis")} >= {"anchored"}
    assert any("laterotrusion" in sentence for sentence in found.coverage.sentences)


@pytest.mark.slow
def test_gross_outliers_are_counted_but_do_not_spoil_the_rest(quick, poses, anatomy):
    rng = np.random.default_rng(5)
    struck = rng.choice(FRAMES, 6, replace=False)
    wrong = poses.copy()
    centre = make_transform(np.eye(3), anatomy.landmarks[0])
    twisted = centre @ se3_exp(rng.choice([-1, 1], (6, 6)) * [0, 0.15, 0.15, 0, 0, 0]) @ np.linalg.inv(centre)
    wrong[struck] = wrong[struck] @ twisted
    found = run_experiments((np.arange(FRAMES), wrong), anatomy, config=FittingConfig(starts=1))
    errors = next(one for one in found.of("reconstruction") if one.model == "anchored").values_mm
    assert len(errors) == FRAMES and (errors > 5).sum() == 6 and np.median(errors) < 0.6
    assert all(np.isfinite(one.values_mm).all() for one in found.distances)
    assert max(path.opening_mm.max() for path in found.condyle_paths if path.model == "anchored") < 60


@pytest.mark.slow
def test_frames_a_prior_helped_with_are_never_used(poses, anatomy):
    nan = np.full((FRAMES, 4, 4), np.nan)
    aided = np.zeros(FRAMES, dtype=bool)
    aided[100:120] = True
    wrong = poses.copy()
    wrong[aided] = wrong[aided] @ se3_exp([0, 0.3, 0, 0, 0, 30.0])
    fields = {name: nan for name in ("T_world_upper", "T_world_lower", "raw_T_world_upper", "raw_T_world_lower")}
    tracks = _tracks(wrong, aided, fields)
    found = run_experiments(tracks, anatomy, quick=True)
    assert found.frames == FRAMES - 20
    assert max(found.of("reconstruction")[-2].values_mm) < 5


def _tracks(poses, aided, extra):
    """Tracks with these raw poses; all other fields are those of empty tracks."""
    covariance = np.tile(np.eye(6) * 1e-6, (FRAMES, 1, 1))
    values = {
        "frames": np.arange(FRAMES), "T_upper_lower": poses, "raw_T_upper_lower": poses, "prior_aided": aided,
        "status": np.full((FRAMES, 2), TRACKED, dtype=np.int8), "camera_names": ("cam0",),
        "covariance_upper": covariance, "covariance_lower": covariance, "covariance_relative": covariance,
        "sigma_mm": np.full((FRAMES, 5), 0.1), **extra,
    }  # fmt: skip
    empty = {name: np.zeros((FRAMES, 2)) for name in Tracks.__dataclass_fields__ if name not in (*values, "meta")}
    return Tracks(**values, **empty)
