"""Every command on the folder of a build names files that were replaced, modified or truncated."""

import json
import shutil

import numpy as np
import pytest
from example_rig import FPS, example_meshes, example_motion, example_rig
from report_data import report_data
from typer.testing import CliRunner

from jawusd.cli.main import app
from jawusd.evaluator import JawRig
from jawusd.formats.model import save_model
from jawusd.formats.tracks import save_tracks
from jawusd.pipeline.state import BuildState, hash_value
from jawusd.rig.bake import bake_rig
from jawusd.viewer.server import PageServer


def made(folder, seed):
    """A folder as written by a build, for one of two persons."""
    data = report_data(count=60)
    model = data.model
    model.meta["actor"] = f"person {seed}"
    rig = JawRig(model.arrays, model.meta) if seed == 0 else example_rig()
    frames, d = (model.frames, model.d) if seed == 0 else example_motion()
    files = bake_rig(folder, rig, example_meshes(), name=f"p{seed}", fps=FPS, frames=frames, d=d, table_size=17)
    save_model(folder / "model.npz", model)
    save_tracks(folder / "tracks.npz", data.tracks)
    state = BuildState(folder)
    state.finish("sync", "", [], 1.0, dict(data.sync))
    state.finish("fit", "", [folder / "model.npz"], 1.0, {})
    state.finish("refine", "", [folder / "tracks.npz"], 1.0, {})
    state.finish("bake", "", files, 1.0, {})
    return folder


@pytest.fixture(scope="module")
def builds(tmp_path_factory):
    return [made(tmp_path_factory.mktemp("build") / f"p{seed}", seed) for seed in (0, 1)]


@pytest.fixture
def folder(builds, tmp_path):
    return shutil.copytree(builds[0], tmp_path / "actor")


def run(*words):
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exception is None or isinstance(done.exception, SystemExit) or done.exception.exit_code, done
    return done


def damaged(folder, other, name, how):
    path = folder / name
    if how == "exchanged":
        data = (other / name).read_bytes()
        path.write_bytes(data if data != path.read_bytes() else data[:-1] + b"x")
    elif how == "cut":
        path.write_bytes(path.read_bytes()[:3000])
    else:
        path.unlink()


CASES = [
    ("model.npz", "exchanged"), ("tracks.npz", "exchanged"), ("actor_skel.usdc", "exchanged"),
    ("anim_capture.usdc", "exchanged"), ("actor_skel.usdc", "cut"), ("actor_skel.usdc", "missing"),
    ("actor.usdz", "cut"), ("actor.onnx", "exchanged"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "how"), CASES)
def test_validate_of_a_folder_names_the_file_and_leaves_with_1(builds, folder, name, how):
    assert run("validate", folder).exit_code == 0
    damaged(folder, builds[1], name, how)
    done = run("validate", folder)
    assert done.exit_code == 1
    assert f"build_changed: {name}: {'is missing' if how == 'missing' else 'was modified or replaced'}" in done.output


@pytest.mark.parametrize(("name", "how"), CASES)
def test_info_of_a_folder_names_the_file(builds, folder, name, how):
    assert json.loads(run("info", folder, "--json").output)["changed"] == []
    damaged(folder, builds[1], name, how)
    (found,) = json.loads(run("info", folder, "--json").output)["changed"]
    assert found["path"] == name
    assert f"error: {name}: " in run("info", folder).output


@pytest.mark.parametrize(("name", "how"), CASES)
def test_report_is_refused_and_view_says_so(builds, folder, name, how, monkeypatch):
    damaged(folder, builds[1], name, how)
    done = CliRunner().invoke(app, ["report", str(folder)])
    assert f"{name}: " in str(done.exception) and done.exception.exit_code == 3
    assert not (folder / "report.html").exists()
    monkeypatch.setattr(PageServer, "wait", PageServer.stop)
    shown = CliRunner().invoke(app, ["view", str(folder), "--no-browser", "--port", "0"])
    assert f"error: {name}: " in shown.output


@pytest.mark.parametrize("forged", [{"outputs": []}, {"result": {"offsets": "2"}}, {"result": {"offsets": {"a": "x"}}}])
@pytest.mark.parametrize("command", ["validate", "info", "report", "view"])
def test_a_forged_record_ends_no_command_in_a_traceback(folder, monkeypatch, command, forged):
    path = folder / "build.json"
    data = json.loads(path.read_text())
    data["stages"]["sync"].update(forged)
    data["sha256"] = hash_value(data["stages"])
    path.write_text(json.dumps(data))
    monkeypatch.setattr(PageServer, "wait", PageServer.stop)
    options = ["--no-browser", "--port", "0"] if command == "view" else []
    done = CliRunner().invoke(app, [command, str(folder), *options])
    if command == "report":
        assert "is damaged" in str(done.exception) and done.exception.exit_code == 3
    else:
        assert isinstance(done.exception, SystemExit | type(None)), done.exception
        assert ("is damaged" in done.output) == ("outputs" in forged)
        assert done.exit_code == (1 if command == "validate" and "outputs" in forged else 0)


def test_a_rig_that_no_build_wrote_has_nothing_to_compare(folder):
    (folder / "build.json").unlink()
    damaged(folder, folder, "tracks.npz", "cut")
    assert run("validate", folder).exit_code == 0
    assert np.all(json.loads(run("info", folder, "--json").output)["changed"] == [])
