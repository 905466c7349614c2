"""The recipes under a bare interpreter, with stand-ins for the programs that record what they are told."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from example_rig import example_rig
from scipy.spatial.transform import Rotation

import jawusd.plugins
from jawusd.formats.model import JawModel, save_model
from jawusd.plugins.extension import copy_scripts

KEYS = {1: (0.0, 0.0, 0.0), 2: (20.0, 3.0, 0.5), 3: (8.0, -2.0, 1.0)}
# Stand-ins with the calls the recipes make and the signatures the programs document.
STAND_INS = """
import json, sys, types
sys.path.insert(0, FOLDER)
keys, told = {int(k): v for k, v in json.loads(KEYS).items()}, {"keys": []}

maya = types.ModuleType("maya"); cmds = maya.cmds = types.ModuleType("maya.cmds")
cmds.group = lambda empty, name: name
cmds.addAttr = lambda node, longName, niceName, attributeType, minValue, maxValue, keyable: told.setdefault(
    "limits", []).append([longName, minValue, maxValue])
cmds.getAttr = lambda path, time: keys[time][int(path[-1]) - 1]
cmds.xform = lambda node, matrix, objectSpace: told.update(now=matrix)
cmds.setKeyframe = lambda node, attribute, time: told["keys"].append([time, told["now"]])
sys.modules.update({"maya": maya, "maya.cmds": cmds})

hou = types.ModuleType("hou")
class Matrix4:
    def __init__(self, values): self.values = values
    def extractTranslates(self): return self.values[12:15]
    def extractRotates(self): return (self.values, None, None)  # the test turns the numbers itself
class Keyframe:
    def __init__(self, value): self.value = value
    def setFrame(self, frame): self.frame = frame
class Parm:
    def __init__(self, name): self.name = name
    def evalAtFrame(self, frame): return keys[frame][int(self.name[-1]) - 1]
    def setKeyframe(self, key): told["keys"].append([key.frame, self.name, key.value])
class Node:
    def parm(self, name): return Parm(name)
    def parmTuple(self, name): return [Parm(name + axis) for axis in "xyz"]
    def parmTemplateGroup(self): return []
    def setParmTemplateGroup(self, group): told["limits"] = group
hou.Matrix4, hou.Keyframe = Matrix4, Keyframe
hou.FloatParmTemplate = lambda name, label, count, min, max: [name, min, max]
sys.modules["hou"] = hou

unreal = types.ModuleType("unreal")
class Channel:
    def __init__(self, index): self.index = index
    def add_key(self, frame, value): told["keys"].append([frame, self.index, value])
class Track:
    def add_section(self): return self
    def set_range(self, first, last): told["range"] = [first, last]
    def get_all_channels(self): return [Channel(i) for i in range(9)]
class Binding:
    def add_track(self, kind): return kind()
class Quat:
    def __init__(self, x, y, z, w): self.q = [x, y, z, w]
    def rotator(self): return types.SimpleNamespace(roll=self.q, pitch=None, yaw=None)
unreal.MovieScene3DTransformTrack, unreal.Quat, unreal.FrameNumber = Track, Quat, int
sys.modules["unreal"] = unreal

import jawusd_reader, jawusd_recipes as recipes
assert "numpy" not in sys.modules and "jawusd" not in sys.modules
rig = jawusd_reader.load(FOLDER + "/model.npz")
"""


@pytest.fixture
def tell(tmp_path):
    """Return a function that runs code after the stand-ins in an isolated interpreter, and returns what was told."""
    rig, none = example_rig(), np.zeros(0)
    model = JawModel(dict(rig.arrays), none.astype(int), np.zeros((0, 3)), none, none.astype(bool), dict(rig.meta))
    save_model(tmp_path / "model.npz", model)
    copy_scripts(tmp_path)

    def run(code):
        names = f"FOLDER = {str(tmp_path)!r}\nKEYS = {json.dumps(KEYS)!r}\n"
        whole = names + STAND_INS + code + "\nprint(json.dumps(told))"
        done = subprocess.run([sys.executable, "-I", "-S", "-c", whole], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


def limits():
    """Return what the controls must say."""
    return [[f"d{i}", *row] for i, row in enumerate(example_rig().arrays["d_range"].tolist(), start=1)]


POINTS = np.array([[0.0, 0, 0], [10, 20, -30], [-50, 3, 8]])


def expected_points(frame):
    """Return where the model carries the points at a key."""
    T = example_rig().pose(KEYS[frame])
    return POINTS @ T[:3, :3].T + T[:3, 3]


def carried(numbers):
    """Return where a program with row vectors carries the points: p M."""
    return (np.c_[POINTS, np.ones(3)] @ np.reshape(numbers, (4, 4)))[:, :3]


def test_maya_keys_the_mandible(tell):
    told = tell('recipes.maya_bake(rig, recipes.maya_controls(rig), "Mandible", 1, 3)')
    assert told["limits"] == limits()
    assert [frame for frame, _ in told["keys"]] == [1, 2, 3]
    for frame, numbers in told["keys"]:
        np.testing.assert_allclose(carried(numbers), expected_points(frame), atol=1e-9)


def test_houdini_keys_the_mandible(tell):
    told = tell("recipes.houdini_controls(rig, Node()); recipes.houdini_bake(rig, Node(), Node(), 1, 3, 0.1)")
    assert told["limits"] == limits() and len(told["keys"]) == 3 * 6
    for frame in KEYS:
        found = {name: value for at, name, value in told["keys"] if at == frame}
        numbers = np.reshape(found["rx"], (4, 4))
        np.testing.assert_allclose(numbers[3, :3], [found[f"t{axis}"] for axis in "xyz"])
        numbers[3, :3] *= 10  # written in centimetres
        np.testing.assert_allclose(carried(numbers), expected_points(frame), atol=1e-9)


def test_unreal_gets_keys_in_its_axes(tell):
    """Unreal's quaternions turn about a vector as everybody's do; its points are those of USD with y and z swapped."""
    told = tell("recipes.unreal_keys(rig, Binding(), keys)")
    assert told["range"] == [1, 4]
    for frame in KEYS:
        found = {index: value for at, index, value in told["keys"] if at == frame}
        assert set(found) == {0, 1, 2, 3, 4, 5}
        turned = Rotation.from_quat(found[3]).apply(POINTS[:, [0, 2, 1]])
        places = turned + 10 * np.array([found[0], found[1], found[2]])
        np.testing.assert_allclose(places, expected_points(frame)[:, [0, 2, 1]], atol=1e-9)


def test_one_command_copies_the_scripts(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "jawusd.plugins", str(tmp_path / "scripts")], check=True, capture_output=True, text=True
    )
    names = {"jawusd_reader.py", "jawusd_recipes.py", "blender_nodes.py"}
    assert {path.name for path in (tmp_path / "scripts").iterdir()} == names
    assert {Path(line).name for line in done.stdout.split()} == names


def test_the_recipes_import_nothing_but_the_reader():
    text = (Path(jawusd.plugins.__file__).parent / "jawusd_recipes.py").read_text()
    assert "from jawusd" not in text and "import numpy" not in text
