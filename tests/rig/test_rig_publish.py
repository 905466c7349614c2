"""Published rigs: nothing refers to the old names, and actors packed together keep their data."""

import os

import numpy as np
import pytest
from example_rig import FPS, assert_valid_usd, example_meshes, example_motion, example_rig
from pxr import Sdf, Usd, UsdUtils
from typer.testing import CliRunner

from jawusd.base.errors import FormatError, RigError
from jawusd.cli.main import app
from jawusd.rig import load_rig, write_splines
from jawusd.rig.bake import bake_rig
from jawusd.rig.motion_read import read_poses_of_stage
from jawusd.rig.publish import publish_rig
from jawusd.rig.validate import validate_stage

KINDS = {"hero": "anchored", "villain": "additive"}


@pytest.fixture
def published(tmp_path):
    """Return a folder with two published actors, one named by the option, one by the rig."""
    frames, d = example_motion(8)
    for name, kind in KINDS.items():
        options = {"name": name, "fps": FPS, "frames": frames, "d": d, "table_size": 17}
        bake_rig(tmp_path / "built" / name, example_rig(kind), example_meshes(), **options)
        prefix = ["--prefix", "lead-1"] if name == "hero" else []
        arguments = ["publish", str(tmp_path / "built" / name), "-o", str(tmp_path / "lib" / name), *prefix]
        assert CliRunner().invoke(app, arguments).exit_code == 0
    (tmp_path / "built").rename(tmp_path / "gone")
    return tmp_path / "lib"


def test_every_file_has_its_own_name_and_is_valid(published):
    files = {path.name for path in (published / "villain").iterdir()}
    expected = {"villain.usda", "villain_rig.usdc", "villain_geo.usdc", "villain.onnx", "villain_encode.onnx"}
    assert files == expected | {"villain_anim_capture.usdc", "villain_skel.usdc", "villain.usdz"}
    assert not files & {path.name for path in (published / "hero").iterdir()}
    for path in published.glob("*/*.usd*"):
        assert_valid_usd(path)
    for name, prefix in (("hero", "lead-1"), ("villain", "villain")):
        for file in (f"{prefix}.usda", f"{prefix}_anim_capture.usdc", f"{prefix}.usdz"):
            assert load_rig(published / name / file).kind == KINDS[name]


@pytest.mark.slow
def test_actors_packed_together_keep_their_data(published, tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    frames, d = example_motion(8)
    stage.SetStartTimeCode(float(frames[0]))
    stage.SetEndTimeCode(float(frames[-1]))
    stage.SetDefaultPrim(stage.DefinePrim("/Shot", "Xform"))
    for name, prefix in (("hero", "lead-1"), ("villain", "villain")):
        reference = f"./lib/{name}/{prefix}_anim_capture.usdc"
        stage.DefinePrim(f"/Shot/{name}", "Xform").GetReferences().AddReference(reference)
    stage.Save()
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(tmp_path / "shot.usda")), str(tmp_path / "shot.usdz"))
    published.rename(tmp_path / "away")
    for name, kind in KINDS.items():
        assert load_rig(tmp_path / "shot.usdz", f"/Shot/{name}").kind == kind
        _, T = read_poses_of_stage(tmp_path / "shot.usdz", f"/Shot/{name}")
        np.testing.assert_allclose(T, example_rig(kind).pose(d), atol=1e-6)


def test_what_cannot_be_published(published, anchored_folder, tmp_path):
    with pytest.raises(RigError, match="is not a valid prefix"):
        publish_rig(anchored_folder, tmp_path / "out", "../hero")
    with pytest.raises(RigError, match="own folder"):
        publish_rig(anchored_folder, anchored_folder, "hero")
    with pytest.raises(RigError, match="no such file"):
        publish_rig(published / "hero", tmp_path / "out")


def test_splines_are_published_without_a_warning_of_openusd(anchored_folder, tmp_path, capfd):
    keys = np.array([[0.0, 0, 0], [9, 1, 0], [3, 0, 0]])
    curved = np.ones(2, dtype=bool)
    arguments = (anchored_folder / "splines.usda", anchored_folder / "anim_capture.usdc", [30, 40, 50], keys, FPS)
    write_splines(*arguments, 0 * keys, curved)
    publish_rig(anchored_folder, tmp_path / "lib", "hero")
    assert capfd.readouterr().err == ""
    stage = Usd.Stage.Open(str(tmp_path / "lib" / "hero_splines.usda"))
    assert stage.GetDefaultPrim().GetAttribute("jaw:d1").GetSpline().Eval(40) == 9


@pytest.mark.parametrize("file", ["actor.usda", "anim_capture.usdc"])
def test_actors_mixed_up_by_a_packager_are_refused(tmp_path, file):
    """Built folders that were not published: OpenUSD's packager flattens names, so that two actors share files."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    stage.SetDefaultPrim(stage.DefinePrim("/Shot", "Xform"))
    frames, d = example_motion(8)
    for name, kind in KINDS.items():
        options = {"name": name, "fps": FPS, "frames": frames, "d": d, "table_size": 17}
        bake_rig(tmp_path.parent / f"built_{file[:4]}" / name, example_rig(kind), example_meshes(), **options)
        reference = f"../built_{file[:4]}/{name}/{file}"
        stage.DefinePrim(f"/Shot/{name}", "Xform").GetReferences().AddReference(reference)
    stage.Save()
    package = tmp_path / "shot.usdz"
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(tmp_path / "shot.usda")), str(package))
    refused = 0
    for name, kind in KINDS.items():
        try:
            assert load_rig(package, f"/Shot/{name}").kind == kind
        except FormatError as error:
            refused += "packing mixed up files" in str(error)
    assert refused == 1
    found = [finding.message for finding in validate_stage(package) if finding.rule == "Model"]
    assert any("mixed" in message for message in found)


@pytest.mark.parametrize("name", ["more.onnx", "more.usda"])
def test_links_to_files_elsewhere_are_not_copied(name, anchored_folder, tmp_path):
    (tmp_path / "letter").write_text("#usda 1.0\n")
    (anchored_folder / name).symlink_to(tmp_path / "letter")
    with pytest.raises(RigError, match="outside its own folder"):
        publish_rig(anchored_folder, tmp_path / "out", "hero")
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes of POSIX")
def test_pipes_are_not_copied(anchored_folder, tmp_path):
    os.mkfifo(anchored_folder / "more.onnx")
    with pytest.raises(RigError, match="is not a regular file"):
        publish_rig(anchored_folder, tmp_path / "out", "hero")
