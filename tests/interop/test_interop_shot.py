"""A packed shot in other programs: every actor moves by its own model."""

import numpy as np
import pytest
from example_rig import FPS, example_meshes, example_motion, example_rig, moved
from foreign import SCRIPTS, environment, run, run_in
from pxr import Gf, Sdf, Usd, UsdGeom

from jawusd.rig.bake import bake_rig
from jawusd.rig.publish import write_package

KINDS, OFFSET, COUNT = {"hero": "anchored", "villain": "additive"}, 10, 12


@pytest.fixture(scope="module")
def pack(tmp_path_factory):
    """Return a function that packs a shot in cm of the given actors, each of which starts later than the one before."""
    folder, (frames, d) = tmp_path_factory.mktemp("shot"), example_motion(COUNT)
    for name, kind in KINDS.items():
        options = {"name": name, "fps": FPS, "frames": frames, "d": d, "table_size": 17}
        bake_rig(folder / name, example_rig(kind), example_meshes(), **options)

    def packed(*names):
        stage = Usd.Stage.CreateNew(str(folder / f"{'_'.join(names)}.usda"))
        UsdGeom.SetStageMetersPerUnit(stage, 0.01)
        UsdGeom.SetStageUpAxis(stage, "Y")
        stage.SetTimeCodesPerSecond(FPS)
        stage.SetStartTimeCode(float(frames[0]))
        stage.SetEndTimeCode(float(frames[-1] + OFFSET))
        stage.SetDefaultPrim(stage.DefinePrim("/Shot", "Xform"))
        for k, name in enumerate(names):
            prim = stage.DefinePrim(f"/Shot/{name}", "Xform")
            prim.GetReferences().AddReference(f"./{name}/anim_capture.usdc", Sdf.LayerOffset(k * OFFSET))
            place = UsdGeom.XformCommonAPI(prim)  # integers, which three.js cannot read from binary layers
            place.SetTranslate(Gf.Vec3d(30 * k, 3, 4))
            place.SetRotate(Gf.Vec3f(0, 90, 0))
            place.SetScale(Gf.Vec3f(0.1))
        stage.Save()
        return write_package(folder / f"{'_'.join(names)}.usdz", stage.GetRootLayer().realPath)

    return packed


def d_at(name, frame):
    """Return d of an actor in a frame of the shot; before and after its motion, that of the nearest end."""
    frames, d = example_motion(COUNT)
    late = OFFSET * list(KINDS).index(name)
    return d[np.clip(frame - late - frames[0], 0, COUNT - 1)]


@pytest.mark.parametrize("blender", ["blender45", "blender50"])
def test_blender_moves_each_actor_by_itself(pack, blender):
    frames = [int(example_motion(COUNT)[0][0] + k) for k in (0, 5, 11, 15, 21)]
    found = run_in(blender, "blender_shot.py", pack(*KINDS), ",".join(map(str, frames)), ",".join(KINDS))
    for frame in frames:
        for name, kind in KINDS.items():
            pose = example_rig(kind).pose(d_at(name, frame))
            expected = moved(pose[None], example_meshes()["mandible"].vertices)[0]
            assert np.linalg.norm(np.array(found[str(frame)][name]) - expected, axis=1).max() < 0.001


def test_tinyusdz_finds_all_meshes_and_motions(pack):
    code = "import json, sys, tinyusdz; scene = tinyusdz.tydra.convert_to_render_scene(tinyusdz.load(sys.argv[1]));"
    code += "print('RESULT ' + json.dumps([len(scene.meshes()), [len(a.channels()) for a in scene.animations()]]))"
    found = run([environment("tinyusdz") / "bin" / "python", "-c", code, pack(*KINDS)])
    assert found == [8, [2, 2]]


def test_three_js_moves_an_actor_in_its_place(pack):
    """One actor only: animations refer to nodes by names, which several actors share."""
    frames = example_motion(COUNT)[0][[0, 5, 11]]
    times, modules = ",".join(str(frame / FPS) for frame in frames), environment("threejs") / "node_modules"
    found = run(["node", SCRIPTS / "three_read.mjs", modules, pack("hero"), times, "MandibleMesh"])
    at = placed([0, 3, 4])
    for frame in frames:
        shown = np.array(found["matrices"][str(frame / FPS).removesuffix(".0")], dtype=float).reshape(4, 4)
        np.testing.assert_allclose(np.linalg.inv(at) @ shown, example_rig().pose(d_at("hero", frame)), atol=1e-3)


def placed(translation):
    """Return the actor's transform in the shot: a quarter turn about y and a scale of 0.1."""
    return np.array(
        [[0, 0, 0.1, translation[0]], [0, 0.1, 0, translation[1]], [-0.1, 0, 0, translation[2]], [0, 0, 0, 1]]
    )
