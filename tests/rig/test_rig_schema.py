"""The codeless schema: generated files, documentation, discovery in all kinds of processes."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom, UsdSkel

from jawusd.rig import schema_is_live
from jawusd.rig.layout import SCHEMA_NAME, has_jaw_api

SCHEMAS = Path(__file__).parents[2] / "schemas"
FILES = ("schema.usda", "generatedSchema.usda", "plugInfo.json")


def definition():
    found = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(SCHEMA_NAME)
    assert found is not None
    return found


def regenerate(folder):
    command = [sys.executable, "-m", "pxr.Usd.usdGenSchema", "-v", "schema.usda", "."]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


def copy_schemas(folder):
    for name in FILES:
        shutil.copy(SCHEMAS / name, folder)


def test_generated_files_follow_from_the_source(tmp_path):
    copy_schemas(tmp_path)
    done = regenerate(tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_change_of_the_source_alone_is_noticed(tmp_path):
    copy_schemas(tmp_path)
    source = tmp_path / "schema.usda"
    source.write_text(source.read_text().replace("double minimum = -20", "double minimum = -21"))
    assert regenerate(tmp_path).returncode != 0


def test_every_property_states_range_and_unit():
    layer = Sdf.Layer.OpenAsAnonymous(str(SCHEMAS / "generatedSchema.usda"))
    properties = layer.GetPrimAtPath("/JawRigAPI").properties
    assert len(properties) > 50
    for prop in properties:
        doc = prop.customData["userDocBrief"]
        assert "; range: " in doc and "; unit: " in doc, prop.name


def test_limits_lie_in_the_schema():
    stage = Usd.Stage.CreateInMemory()
    prim = UsdGeom.Xform.Define(stage, "/a").GetPrim()
    assert prim.ApplyAPI(SCHEMA_NAME)
    attribute = prim.GetAttribute("jaw:d2")
    assert (attribute.GetSoftLimits().GetMinimum(), attribute.GetSoftLimits().GetMaximum()) == (-15, 15)
    assert (attribute.GetHardLimits().GetMinimum(), attribute.GetHardLimits().GetMaximum()) == (-40, 40)


def test_applies_to_xformable_prims_only():
    stage = Usd.Stage.CreateInMemory()
    assert UsdGeom.Xform.Define(stage, "/a").GetPrim().CanApplyAPI(SCHEMA_NAME)
    assert UsdSkel.Root.Define(stage, "/b").GetPrim().CanApplyAPI(SCHEMA_NAME)
    assert not UsdGeom.Scope.Define(stage, "/c").GetPrim().CanApplyAPI(SCHEMA_NAME)


def test_rig_attributes_are_those_of_the_schema(folder, kind):
    stage = Usd.Stage.Open(str(folder / "actor.usda"))
    prim = stage.GetPrimAtPath("/Actor")
    assert has_jaw_api(prim)
    known = set(definition().GetPropertyNames())
    for prop in prim.GetAuthoredProperties():
        name = prop.GetName()
        if not name.startswith("jaw:"):
            continue
        assert name in known, name
        for spec in prop.GetPropertyStack():
            assert spec.custom, f"{name} is not custom, so Blender would not import it"
            if isinstance(prop, Usd.Attribute):
                schema_spec = definition().GetSchemaAttributeSpec(name)
                assert (spec.typeName, spec.variability) == (schema_spec.typeName, schema_spec.variability), name
    authored = {prop.GetName() for prop in prim.GetAuthoredProperties()}
    other = "jaw:model:curve" if kind == "anchored" else ("jaw:model:path", "jaw:model:glide", "jaw:model:spline")
    without = (
        "jaw:contact:",
        "jaw:joints:",
        "jaw:motion:",
        "jaw:thresholds:heldOut",
        "jaw:model:glideD2",
        "jaw:model:glideD3",
        *((other,) if isinstance(other, str) else other),
    )  # no scans that meet, another model, no frames held out
    assert {name for name in known - authored if not name.startswith(without)} == set()


def test_delivered_text_layers_avoid_what_other_readers_fail_on(folder):
    text = (folder / "actor.usda").read_text()
    assert "JawRigAPI" in text
    for word in ("limits", "uiHints", "arraySizeConstraint", ".spline"):
        assert word not in text


def run_python(code, *arguments, blocked=()):
    lines = ["import sys", *(f"sys.modules[{name!r}] = None" for name in blocked), code]
    command = [sys.executable, "-c", "\n".join(lines), *map(str, arguments)]
    environment = {name: value for name, value in os.environ.items() if name != "PXR_PLUGINPATH_NAME"}
    done = subprocess.run(command, capture_output=True, text=True, env={**environment, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_schema_is_live_when_jawusd_comes_first():
    assert run_python("import jawusd.rig; print(jawusd.rig.schema_is_live())") == ["True"]
    assert schema_is_live()


def test_rig_loads_when_a_stage_was_in_use_before(anchored_folder):
    code = """
from pxr import Usd
early = Usd.Stage.CreateInMemory()
early.DefinePrim('/a', 'Xform').HasAPI('CollectionAPI')
import jawusd
from jawusd.rig import schema_is_live, validate_stage
rig = jawusd.load(sys.argv[1])
print(schema_is_live(), rig.pose([10.0, 0.0, 0.0]).shape, len(validate_stage(sys.argv[1])))
"""
    assert run_python(code, anchored_folder / "actor.usda") == ["False", "(4,", "4)", "0"]


def test_rig_opens_without_jawusd(folder):
    code = """
from pxr import Sdf, Usd, UsdGeom
stage = Usd.Stage.Open(sys.argv[1])
prim = stage.GetDefaultPrim()
d1, shape = (prim.GetAttribute(name).Get() for name in ('jaw:d1', 'jaw:decoder:shape'))
print(UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage), d1, len(shape))
"""
    assert run_python(code, folder / "actor.usda", blocked=("jawusd",)) == ["0.001", "Y", "0.0", "3"]


def test_reading_needs_only_the_base_install(anchored_folder):
    code = """
from jawusd.rig import describe, load_rig, validate_stage
actor = sys.argv[1]
print(load_rig(actor).pose([5.0, 0.0, 0.0]).shape, describe(actor)['actor'])
print([(finding.severity, finding.rule) for finding in validate_stage(actor)])
"""
    heavy = ("onnx", "scipy", "numba", "cv2", "torch", "trimesh", "av", "shapely")
    found = run_python(code, anchored_folder / "actor.usda", blocked=heavy)
    assert " ".join(found) == "(4, 4) example [('info', 'Onnx')]"


def told(code):
    environment = {name: value for name, value in os.environ.items() if name != "PXR_PLUGINPATH_NAME"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    return done.stdout.strip(), done.stderr


KNOWN = "print(Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('JawRigAPI') is not None)"


def test_import_jawusd_is_enough():
    """Before OpenUSD is loaded, and between its import and the first stage; it loads nothing itself."""
    assert told("import sys, jawusd; print('pxr' in sys.modules)")[0] == "False"
    assert told(f"import jawusd; from pxr import Usd; {KNOWN}")[0] == "True"
    assert told(f"from pxr import Plug, Usd; import jawusd; {KNOWN}")[0] == "True"


def test_too_late_is_a_warning():
    used = "s = Usd.Stage.CreateInMemory(); s.DefinePrim('/a', 'Xform').HasAPI('CollectionAPI')"
    out, warned = told(f"from pxr import Usd; {used}; import jawusd.rig; {KNOWN}")
    assert out == "False" and "Import jawusd first" in warned


def test_info_says_where_it_is():
    done = subprocess.run([sys.executable, "-m", "jawusd", "info", "--schema"], capture_output=True, text=True)
    assert done.returncode == 0 and f"PXR_PLUGINPATH_NAME={SCHEMAS}" in done.stdout
    environment = {**os.environ, "PXR_PLUGINPATH_NAME": str(SCHEMAS)}
    code = f"from pxr import Usd; {KNOWN}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.stdout.strip() == "True"
