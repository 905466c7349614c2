"""The viewer's input of an actor, and the files it writes, read back by independent readers."""

import sys

import numpy as np
import pytest
from example_rig import FPS, assert_valid_usd, example_motion, example_rig
from pxr import Usd

from jawusd.base.errors import FormatError, MissingDependencyError, OutputError, RigError
from jawusd.formats.mesh import Mesh, crown_face_mask
from jawusd.formats.tracks import Tracks, save_tracks
from jawusd.pipeline.view import motion_names, open_viewer, part_of, viewed_actor
from jawusd.rig.geo import read_geometry, read_gum
from jawusd.rig.layout import EXAMPLE_RIG
from jawusd.rig.motion_read import read_poses_of_stage
from jawusd.viewer.motion import Clip


def test_an_actor_brings_its_meshes_with_teeth_and_gum_apart(folder):
    actor = viewed_actor(folder)
    assert actor.name == "someone" and actor.fps == FPS and actor.folder == folder
    whole = read_geometry(folder / "geo.usdc")
    for arch in ("upper", "lower"):
        parts = len(actor.meshes[f"{arch}_teeth"].faces), len(actor.meshes[f"{arch}_gum"].faces)
        assert min(parts) > 0 and sum(parts) == len(whole[f"{arch}_teeth"].faces)
    assert set(actor.meshes) == {"skull", "mandible", "upper_teeth", "upper_gum", "lower_teeth", "lower_gum"}
    np.testing.assert_allclose(actor.rig.pose([9, 1, 0]), example_rig().pose([9, 1, 0]), atol=1e-9)


def test_gum_is_where_the_paint_is_grey(folder):
    from example_rig import example_meshes

    gum = read_gum(folder / "geo.usdc")
    assert set(gum) == {"upper_teeth", "lower_teeth"}
    for name, faces in gum.items():
        np.testing.assert_array_equal(faces, ~crown_face_mask(example_meshes()[name]))


def test_a_part_of_a_mesh_has_only_the_vertices_it_uses():
    mesh = Mesh(np.arange(15.0).reshape(5, 3), np.array([[0, 1, 2], [2, 3, 4]]), np.arange(15).reshape(5, 3))
    part = part_of(mesh, np.array([False, True]))
    np.testing.assert_array_equal(part.vertices[part.faces[0]], mesh.vertices[[2, 3, 4]])
    assert len(part.vertices) == 3 and (part.colors == mesh.colors[2:]).all()


def test_what_is_no_rig_is_refused(tmp_path):
    (tmp_path / "model.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(RigError, match="is an npz file; expected a USD file"):
        viewed_actor(tmp_path / "model.npz")
    with pytest.raises(RigError, match="no such file"):
        viewed_actor(tmp_path)


def test_the_baked_motion_is_offered_and_read_back(folder):
    actor = viewed_actor(folder / "actor.usda")
    frames, d = example_motion()
    (name,) = actor.clip_names()
    clip = actor.load_clip(name)
    np.testing.assert_array_equal(clip.frames, frames)
    np.testing.assert_allclose(clip.d, d, atol=1e-4)
    assert clip.fps == FPS


@pytest.mark.parametrize("name", ["anim_other.usdc", "../actor.usda", "/etc/passwd", "actor.usda", "captured take"])
def test_only_motions_that_are_offered_are_read(folder, name):
    with pytest.raises(FormatError, match="no motion"):
        viewed_actor(folder).load_clip(name)


def test_a_motion_file_that_is_broken_is_refused(folder):
    (folder / "anim_broken.usdc").write_bytes(b"PXR-USDC" + bytes(80))
    actor = viewed_actor(folder)
    with pytest.raises(RigError, match="not a USD file"):
        actor.load_clip("anim_broken.usdc")


def test_a_written_animation_is_valid_and_moves_as_the_clip(folder):
    actor = viewed_actor(folder)
    clip = Clip("keys", np.array([0.0, 12.0, 30.0]), np.array([[2.0, 0, 0], [18, 2, 0.5], [5, -1, 1]]), 30.0)
    path = actor.save_layer("anim_mine.usdc", clip, False)
    assert_valid_usd(path)
    assert Usd.Stage.Open(str(path)).GetTimeCodesPerSecond() == 30.0
    frames, T = read_poses_of_stage(path)
    expected = actor.rig.pose(actor.rig.interpolate(clip.frames, clip.d, frames))
    np.testing.assert_allclose(T, expected, atol=1e-6)
    assert "anim_mine.usdc" in motion_names(folder)
    with pytest.raises(OutputError, match="exists already"):
        actor.save_layer("anim_mine.usdc", clip, False)
    actor.save_layer("anim_mine.usdc", clip, True)


@pytest.mark.parametrize(
    "name", ["actor.usda", "../anim.usdc", "anim/x.usdc", "anim.txt", "", "anim\n.usdc", "rig.usdc"]
)
def test_only_animations_beside_the_rig_are_written(folder, name):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    clip = Clip("keys", np.array([0.0]), np.zeros((1, 3)), 24.0)
    with pytest.raises(OutputError, match="not a valid name"):
        viewed_actor(folder).save_layer(name, clip, True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_the_captured_take_is_the_tracks_beside_the_rig(folder):
    frames, d = example_motion(12)
    T = example_rig().pose(d)
    T[4] = np.nan
    pose = np.tile(np.eye(4), (12, 1, 1))
    pair, spread = np.ones((12, 2)), np.tile(np.eye(6), (12, 1, 1))
    tracks = Tracks(
        frames, pose, pose, T, pose, pose, T, pair.astype(np.int8), np.zeros(12, bool), np.zeros((12, 2, 1)),
        np.ones((12, 2, 1), bool), spread, spread, spread, np.ones((12, 5)), pair, pair, ("a",), {},
    )  # fmt: skip
    save_tracks(folder / "tracks.npz", tracks)
    actor = viewed_actor(folder)
    assert actor.clip_names()[0] == "captured take"
    clip = actor.load_clip("captured take")
    np.testing.assert_array_equal(clip.frames, np.delete(frames, 4))
    np.testing.assert_allclose(clip.d, np.delete(d, 4, axis=0), atol=1e-5)


def test_the_example_rig_plays_and_nothing_is_written_beside_it():
    before = sorted(EXAMPLE_RIG.parent.iterdir())
    actor = viewed_actor(EXAMPLE_RIG)
    clip = actor.load_clip(actor.take)
    assert actor.take == "anim_capture.usdc" and clip.d[:, 0].max() > 35
    assert len(actor.meshes) == 6 and not actor.placeholders
    with pytest.raises(OutputError, match="ships with jawusd"):
        actor.save_layer("anim_view.usdc", clip, True)
    assert sorted(EXAMPLE_RIG.parent.iterdir()) == before
    assert actor.contacts(np.zeros(3)).std() > 10  # the scans are fine enough for contacts


def test_without_viser_the_extra_is_named(folder, monkeypatch):
    monkeypatch.delitem(sys.modules, "jawusd.viewer.server", raising=False)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingDependencyError, match=r"jawusd\[view\]"):
        open_viewer(folder, "127.0.0.1", 0)
