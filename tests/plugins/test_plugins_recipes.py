"""The recipes on rigs, including built ones, with fakes that decompose matrices like the programs."""

import importlib
import json
import subprocess
import sys
import types
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from example_people import save
from example_rig import example_rig
from scipy.spatial.transform import Rotation

import jawusd.plugins
from jawusd.evaluator import JawRig, load
from jawusd.geometry import make_transform
from jawusd.plugins.extension import copy_scripts
from jawusd.rig.table import sample_valid

FRAMES = range(1, 25)
POINTS = np.array([[0.0, 0, 0], [10, 20, -30], [-50, 3, 8]])
OUTSIDE = (20.0, 7.6, 9.2)  # inside every slider
MAYA_ORDERS = ("xyz", "yzx", "zxy", "xzy", "yxz", "zyx")


@pytest.fixture
def recipes(tmp_path, monkeypatch):
    """Return the recipes as `python -m jawusd.plugins` writes them, next to the reader."""
    copy_scripts(tmp_path / "scripts")
    monkeypatch.syspath_prepend(tmp_path / "scripts")
    for name in ("jawusd_recipes", "jawusd_reader"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield importlib.import_module("jawusd_recipes")
    for name in ("jawusd_recipes", "jawusd_reader"):
        sys.modules.pop(name, None)


@pytest.fixture(params=["example", "turned", pytest.param("build", marks=pytest.mark.slow)])
def model(request, tmp_path):
    """Return a model file: of the example, with rotated scans, or of a build."""
    if request.param == "build":
        return request.getfixturevalue("example_build")[0] / "model.npz"
    rig = example_rig()
    if request.param == "turned":  # so that angles pass half a turn
        back = make_transform(Rotation.from_euler("x", 170, degrees=True).as_matrix(), [0, 5, 3])
        rig = JawRig({**rig.arrays, "T_rest": back @ rig.T_rest}, rig.meta)
    return save(rig, tmp_path / "model.npz")


@pytest.fixture
def told():
    """Return what the fakes record: limits, and values by name and frame."""
    return SimpleNamespace(limits=[], keys={}, range=None)


@pytest.fixture
def motion(model):
    """Return valid parameters at every frame."""
    d = sample_valid(load(model), 200, seed=5)
    order = np.argsort(d[:, 0])[:: len(d) // len(FRAMES)][: len(FRAMES)]
    return dict(zip(FRAMES, d[order].tolist()))


def stand_in_maya(told, motion, order):
    """Return a fake `maya.cmds` with the functions that the recipes call, by its documentation; angles in degrees."""
    now = {}

    def xform(node, matrix, objectSpace):
        M = np.reshape(matrix, (4, 4))
        axes = MAYA_ORDERS[order]
        angles = Rotation.from_matrix(M[:3, :3].T).as_euler(axes, degrees=True)
        now.update(translate=M[3, :3].tolist(), rotate=[angles[axes.index(axis)] for axis in "xyz"])

    def value(path, time=None):
        node, name = path.split(".")
        if name == "rotateOrder":
            return order
        return [tuple(now[name])] if name in now else motion[time][int(name[-1]) - 1]

    def add(node, longName, niceName, attributeType, minValue, maxValue, keyable):
        told.limits.append([longName, minValue, maxValue])

    def key(node, attribute, time, value, inTangentType, outTangentType):
        assert inTangentType == outTangentType == "linear"
        told.keys.setdefault(attribute, {})[time] = value

    return SimpleNamespace(
        group=lambda empty, name: name,
        addAttr=add,
        getAttr=value,
        xform=xform,
        setKeyframe=key,
        currentUnit=lambda query, angle: "deg",
    )


def stand_in_houdini(told, motion, order):
    """Return a fake `hou`."""

    class Matrix4:
        def __init__(self, values):
            self.matrix = np.reshape(values, (4, 4))

        def explode(self, transform_order, rotate_order):
            assert transform_order == "srt"
            angles = Rotation.from_matrix(self.matrix[:3, :3].T).as_euler(rotate_order, degrees=True)
            turned = [angles[rotate_order.index(axis)] for axis in "xyz"]
            return {"translate": self.matrix[3, :3].tolist(), "rotate": turned}

    class Keyframe:
        def __init__(self, value):
            self.value, self.expression = value, None

        def setFrame(self, frame):
            self.frame = frame

        def setExpression(self, expression, language):
            self.expression = (expression, language)

    class Parm:
        def __init__(self, name):
            self.name = name

        def evalAtFrame(self, frame):
            return motion[frame][int(self.name[-1]) - 1]

        def evalAsString(self):
            return {"xOrd": "srt", "rOrd": order}[self.name]

        def setKeyframe(self, key):
            assert key.expression == ("linear()", "hscript")
            told.keys.setdefault(self.name, {})[key.frame] = key.value

    class Node:
        def parm(self, name):
            return Parm(name)

        def parmTuple(self, name):
            return [Parm(name + axis) for axis in "xyz"]

        def parmTemplateGroup(self):
            return []

        def setParmTemplateGroup(self, group):
            told.limits = group

    return SimpleNamespace(
        Matrix4=Matrix4,
        Keyframe=Keyframe,
        Node=Node,
        exprLanguage=SimpleNamespace(Hscript="hscript"),
        FloatParmTemplate=lambda name, label, count, min, max: [name, min, max],
    )


def stand_in_unreal(told):
    """Return a fake `unreal`, whose rotator has angles about z, y and x in degrees."""

    class Channel:
        def __init__(self, index):
            self.index = index

        def add_key(self, time, new_value, sub_frame=0.0, time_unit="display", interpolation="auto"):
            assert interpolation == "linear"
            told.keys.setdefault(self.index, {})[time] = new_value

    class Track:
        def add_section(self):
            return self

        def set_range(self, first, last):
            told.range = (first, last)

        def get_all_channels(self):
            return [Channel(i) for i in range(9)]

    class Quat:
        def __init__(self, x, y, z, w):
            self.turn = Rotation.from_quat([x, y, z, w])

        def rotator(self):
            yaw, pitch, roll = self.turn.as_euler("ZYX", degrees=True)
            return SimpleNamespace(roll=roll, pitch=pitch, yaw=yaw)

    return SimpleNamespace(
        MovieScene3DTransformTrack=Track,
        Quat=Quat,
        FrameNumber=int,
        MovieSceneKeyInterpolation=SimpleNamespace(LINEAR="linear"),
        Binding=lambda: SimpleNamespace(add_track=lambda kind: kind()),
    )


def limits(model):
    """Return the expected values of the controls."""
    return [[f"d{i}", *row] for i, row in enumerate(load(model).d_range.tolist(), start=1)]


def assert_shown(told, names, order, rig, motion, scale=1.0):
    """Compare points moved by the keys with the model at every frame, and check that angles are continuous."""
    values = np.array([[told.keys[name][frame] for name in names] for frame in motion])
    assert all(set(told.keys[name]) == set(motion) for name in names)
    angles = values[:, [3 + "xyz".index(axis) for axis in order]]
    turned = [Rotation.from_euler(order, row, degrees=True).apply(POINTS) for row in angles]
    shown = np.array(turned) + values[:, None, :3] / scale
    T = rig.pose(np.array(list(motion.values())))
    wanted = np.einsum("nij,pj->npi", T[:, :3, :3], POINTS) + T[:, None, :3, 3]
    np.testing.assert_allclose(shown, wanted, atol=1e-9)
    assert np.abs(np.diff(values[:, 3:], axis=0)).max() < 60  # the jaw turns a few degrees a frame


@pytest.mark.parametrize("order", [0, 2, 5])
def test_maya_keys_the_mandible(recipes, model, motion, told, order, monkeypatch):
    maya = types.ModuleType("maya")
    maya.cmds = stand_in_maya(told, motion, order)
    monkeypatch.setitem(sys.modules, "maya", maya)
    rig = recipes.jawusd_reader.load(model)
    recipes.maya_bake(rig, recipes.maya_controls(rig), "Mandible", FRAMES[0], FRAMES[-1])
    assert told.limits == limits(model)
    names = [f"{kind}{axis}" for kind in ("translate", "rotate") for axis in "XYZ"]
    assert_shown(told, names, MAYA_ORDERS[order], load(model), motion)


@pytest.mark.parametrize("order", ["xyz", "zyx", "yxz"])
def test_houdini_keys_the_mandible(recipes, model, motion, told, order, monkeypatch):
    hou = stand_in_houdini(told, motion, order)
    monkeypatch.setitem(sys.modules, "hou", hou)
    rig, node = recipes.jawusd_reader.load(model), hou.Node()
    recipes.houdini_controls(rig, node)
    recipes.houdini_bake(rig, node, node, FRAMES[0], FRAMES[-1], 0.1)
    assert told.limits == limits(model)
    assert_shown(told, ["tx", "ty", "tz", "rx", "ry", "rz"], order, load(model), motion, 0.1)


def test_unreal_gets_a_key_at_every_frame_in_its_axes(recipes, model, told, monkeypatch):
    """Unreal's quaternions follow the usual convention; its points are those of USD with y and z swapped."""
    unreal = stand_in_unreal(told)
    monkeypatch.setitem(sys.modules, "unreal", unreal)
    rig = load(model)
    first, last = sample_valid(rig, 40, seed=2)[[0, 1]].tolist()
    recipes.unreal_keys(recipes.jawusd_reader.load(model), unreal.Binding(), {4: first, 28: last}, measured=True)
    assert told.range == (4, 29) and set(told.keys) == set(range(6))
    assert all(list(keys) == list(range(4, 29)) for keys in told.keys.values())
    for frame in range(4, 29):
        x, y, z, roll, pitch, yaw = (told.keys[i][frame] for i in range(6))
        turn = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True)
        places = turn.apply(POINTS[:, [0, 2, 1]]) + 10 * np.array([x, y, z])
        share = (frame - 4) / 24
        T = rig.pose((1 - share) * np.array(first) + share * np.array(last))
        np.testing.assert_allclose(places, (POINTS @ T[:3, :3].T + T[:3, 3])[:, [0, 2, 1]], atol=1e-9)
    angles = np.array([[told.keys[i][frame] for frame in range(4, 29)] for i in (3, 4, 5)])
    assert np.abs(np.diff(angles, axis=1)).max() < 30


def test_parameters_outside_the_bound_are_named_and_moved_inside(recipes, model):
    rig, reader = load(model), recipes.jawusd_reader.load(model)
    d1, d2, d3 = OUTSIDE
    keys = {0: (0.0, 0.0, 0.0), 7: (d1, min(d2, rig.d_range[1, 1]), min(d3, rig.d_range[2, 1]))}
    assert rig.margin(keys[7]) < -1.0
    with pytest.warns(UserWarning, match=r"1 of 2 frames are outside the bound and moved .* 7, d = \(20.00, "):
        moved = recipes.poses(reader, keys)
    np.testing.assert_allclose(moved[7], rig.pose(rig.project(keys[7])), atol=1e-4)
    with pytest.warns(UserWarning, match="kept as they are"):
        kept = recipes.poses(reader, keys, measured=True)
    np.testing.assert_allclose(kept[7], rig.pose(keys[7]), atol=1e-9)
    np.testing.assert_array_equal(moved[0], kept[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recipes.poses(reader, {0: keys[0]})


@pytest.mark.parametrize("order", ["XYZ", "ZYX", "YXZ", "zxy"])
def test_angles_go_on_through_every_turn(recipes, order):
    """Random rotations in small steps, often near gimbal lock: the angles never jump by half a turn."""
    rng = np.random.default_rng(3)
    turn, previous, before, jumps, unfiltered = Rotation.random(random_state=1), None, None, [], []
    for _ in range(4000):
        turn = Rotation.from_rotvec(rng.normal(0, 0.03, 3) + [0.02, 0.01, 0.0]) * turn
        given = turn.as_euler(order, degrees=True)
        found = recipes.nearest_turn(given.tolist(), previous)
        assert (Rotation.from_euler(order, found, degrees=True).inv() * turn).magnitude() < 1e-9
        if previous is not None and abs(given[1]) < 80:  # away from the poles
            jumps.append(np.abs(np.subtract(found, previous)).max())
            unfiltered.append(np.abs(given - before).max())
        previous, before = found, given
    assert max(jumps) < 45 and max(unfiltered) > 300


def test_keys_between_are_on_straight_lines(recipes):
    found = recipes.every_frame({2: (0.0, 0.0, 0.0), 4: (8.0, 2.0, 0.0), 5: (8.0, 2.0, 1.0)})
    assert found == {2: [0, 0, 0], 3: [4, 1, 0], 4: [8, 2, 0], 5: [8, 2, 1]}
    assert recipes.every_frame({3: (1.0, 0.0, 0.0)}) == {3: [1.0, 0.0, 0.0]}


def test_the_recipes_run_bare(recipes, tmp_path):
    """Isolated, without site packages: neither numpy nor jawusd is available."""
    path = save(example_rig(), tmp_path / "model.npz")
    code = f"""
import sys; sys.path.insert(0, {str(tmp_path / "scripts")!r})
import json, jawusd_reader, jawusd_recipes as recipes
assert "numpy" not in sys.modules and "jawusd" not in sys.modules
rig = jawusd_reader.load({str(path)!r})
print(json.dumps(recipes.poses(rig, recipes.every_frame({{0: (0, 0, 0), 4: (20, 1, 0.5)}}))))
"""
    done = subprocess.run([sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    for i in range(5):
        np.testing.assert_allclose(found[str(i)], example_rig().pose(np.array([20, 1, 0.5]) * i / 4), atol=1e-9)


def test_one_command_copies_the_scripts(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "jawusd.plugins", str(tmp_path / "scripts")], check=True, capture_output=True, text=True
    )
    names = {"jawusd_reader.py", "jawusd_recipes.py"}
    assert {path.name for path in (tmp_path / "scripts").iterdir()} == names
    assert {Path(line).name for line in done.stdout.split()} == names


def test_the_recipes_import_nothing_but_the_reader():
    text = (Path(jawusd.plugins.__file__).parent / "jawusd_recipes.py").read_text()
    assert "from jawusd" not in text and "import numpy" not in text
