"""FBX and glTF, written by Blender and by jawusd, are converted back to d through Blender."""

import json
import os

import numpy as np
import pytest
from example_rig import FPS, example_motion, example_rig, scanned_meshes
from foreign import environment, run_in
from typer.testing import CliRunner

from jawusd.cli.main import app
from jawusd.rig.bake import bake_rig
from jawusd.rig.glb import write_glb
from jawusd.rig.motion_read import read_parameters_of_stage

FRAMES, D = example_motion()
BLENDERS = ["blender45", "blender50"]


def run(*arguments, code=0):
    done = CliRunner().invoke(app, [str(x) for x in arguments])
    assert done.exit_code == code, (done.output, done.exception)
    return done.stdout


@pytest.fixture(scope="module", params=[True, False], ids=["bones", "teeth"])
def folder(request, tmp_path_factory):
    """Return a baked rig: with bones, whose vertices are never split, or with teeth scans only."""
    made, meshes = tmp_path_factory.mktemp("actor"), scanned_meshes()
    if not request.param:
        meshes = {name: mesh for name, mesh in meshes.items() if name.endswith("teeth")}
    bake_rig(made, example_rig(), meshes, name="example", fps=FPS, frames=FRAMES, d=D, table_size=17)
    return made


@pytest.mark.parametrize("blender", BLENDERS)
@pytest.mark.parametrize(("name", "first"), [("take.fbx", 0), ("take.glb", FRAMES[0])])
@pytest.mark.parametrize("source", ["anim_capture.usdc", "actor_skel.usdc"])
def test_what_blender_exports_comes_back(folder, tmp_path, monkeypatch, blender, name, first, source):
    run_in(blender, "blender_formats.py", folder / source, tmp_path / name, FRAMES[0], FRAMES[-1])
    monkeypatch.setenv("JAWUSD_BLENDER", str(environment(blender) / "bin" / "python"))
    summary = json.loads(run("encode", folder / "actor.usda", tmp_path / name, "-o", tmp_path / "d.csv", "--json"))
    assert summary["largest_residual_mm"] < 1e-3 and summary["encoded"] == len(D)
    read = np.loadtxt(tmp_path / "d.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(read[:, 0], FRAMES - FRAMES[0] + first)  # Blender's FBX begins at 0
    np.testing.assert_allclose(read[:, 1:4], D, atol=1e-3)


@pytest.mark.parametrize("blender", BLENDERS)
def test_own_glb_becomes_a_layer_again(folder, tmp_path, monkeypatch, blender):
    glb = write_glb(tmp_path / "take.glb", folder / "actor.usda", example_rig(), FRAMES, D, FPS)
    python = environment(blender) / "bin" / "python"
    program = tmp_path / "blender-5"  # the arguments of Blender, parsed as its own Python would
    program.write_text(
        f'#!/bin/sh\n[ "$1" = --background ] && [ "$5" = --python ] || exit 3\nshift 5\nexec {python} "$@"\n'
    )
    os.chmod(program, 0o755)
    monkeypatch.setenv("JAWUSD_BLENDER", str(program))
    for command in ("rebake", "animate"):
        run(command, folder / "actor.usda", glb, "-o", tmp_path / f"{command}.usdc")
        times, d, fps = read_parameters_of_stage(tmp_path / f"{command}.usdc")
        assert fps == FPS
        np.testing.assert_array_equal(times, FRAMES)
        np.testing.assert_allclose(d, D, atol=1e-3)
        run("validate", folder / "actor.usda", tmp_path / f"{command}.usdc")


@pytest.mark.parametrize("d", [np.zeros((3, 3)), np.zeros((1, 3))], ids=["still", "one pose"])
def test_a_take_without_motion_is_said_to_have_none(folder, tmp_path, monkeypatch, d):
    glb = write_glb(tmp_path / "take.glb", folder / "actor.usda", example_rig(), np.arange(len(d)) * 10, d, FPS)
    monkeypatch.setenv("JAWUSD_BLENDER", str(environment("blender45") / "bin" / "python"))
    assert "the mandible does not move" in run("encode", folder / "actor.usda", glb, "-o", tmp_path / "d.csv")
