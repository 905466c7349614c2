"""Every rule finds its fault, and UsdValidation runs them all."""

import numpy as np
import onnx
import pytest
from example_rig import assert_valid_usd, example_rig, forget_checksums
from pxr import Gf, Sdf, Usd, UsdGeom, UsdValidation, Vt

from jawusd.evaluator import JawRig
from jawusd.rig import register_validators, validate_stage
from jawusd.rig.onnx_sidecar import decode_model, encode_model, write_onnx
from jawusd.rig.rules import RULES


def edit(path, change):
    layer = Sdf.Layer.OpenAsAnonymous(str(path))
    change(layer)
    layer.Export(str(path))
    if path.suffix == ".usdc":
        forget_checksums(path.parent)


def set_value(name, value):
    def change(layer):
        layer.GetAttributeAtPath(f"/Actor.{name}").default = value

    return change


def break_model(folder):
    edit(folder / "actor.usda", set_value("jaw:formatVersion", 7))


def break_table_shape(folder):
    edit(folder / "rig.usdc", set_value("jaw:decoder:shape", Vt.IntArray([3, 3, 3])))


def break_table_finiteness(folder):
    def change(layer):
        attribute = layer.GetAttributeAtPath("/Actor.jaw:decoder:twists")
        twists = np.array(attribute.default)
        twists[5] = np.inf
        attribute.default = Vt.FloatArray.FromNumpy(twists)

    edit(folder / "rig.usdc", change)


def break_table_agreement(folder):
    def change(layer):
        attribute = layer.GetAttributeAtPath("/Actor.jaw:decoder:twists")
        attribute.default = Vt.FloatArray.FromNumpy(np.array(attribute.default) * np.float32(1.01))

    edit(folder / "rig.usdc", change)


def break_onnx_presence(folder):
    (folder / "actor.onnx").unlink()


def break_onnx_hash(folder):
    rig = example_rig()
    write_onnx(folder / "actor.onnx", decode_model(rig, np.float64))


def forget_hashes(folder):
    """Remove the recorded hashes, as in rigs before 0.1.0."""

    def change(layer):
        for name in ("jaw:onnx", "jaw:onnx:encode"):
            layer.GetAttributeAtPath(f"/Actor.{name}").customData = {}

    edit(folder / "actor.usda", change)


def break_onnx_identity(folder):
    forget_hashes(folder)
    rig = example_rig()
    arrays = {**rig.arrays, "incisor": rig.incisor + 0.1}
    write_onnx(folder / "actor.onnx", decode_model(JawRig(arrays, rig.meta)))


def break_encoder_identity(folder):
    forget_hashes(folder)
    rig = example_rig()
    arrays = {**rig.arrays, "incisor": rig.incisor + 0.1}
    write_onnx(folder / "actor_encode.onnx", encode_model(JawRig(arrays, rig.meta)))


def break_onnx_agreement(folder):
    forget_hashes(folder)
    model = onnx.load(folder / "actor.onnx")
    for tensor in model.graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.ndim == 2 and values.dtype == np.float32 and values.size > 30:
            tensor.CopyFrom(onnx.numpy_helper.from_array(values * np.float32(1.02), tensor.name))
    onnx.save(model, folder / "actor.onnx")


def break_encoder_agreement(folder):
    """The graph of another jaw with the correct metadata."""
    forget_hashes(folder)
    rig = example_rig()
    model = encode_model(JawRig({**rig.arrays, "incisor": rig.incisor + 0.5}, rig.meta))
    right = onnx.load(folder / "actor_encode.onnx")
    del model.metadata_props[:]
    model.metadata_props.extend(right.metadata_props)
    onnx.save(model, folder / "actor_encode.onnx")


def break_bounds(folder):
    edit(folder / "actor.usda", set_value("jaw:d2", 30.0))


def break_mandible_target(folder):
    def change(layer):
        layer.GetRelationshipAtPath("/Actor.jaw:mandible").targetPathList.explicitItems = [Sdf.Path("/Actor/geo/Chin")]

    edit(folder / "actor.usda", change)


def break_mandible_ops(folder):
    def change(layer):
        stage = Usd.Stage.Open(layer)
        mandible = UsdGeom.Xformable(stage.GetPrimAtPath("/Actor/geo/Mandible"))
        mandible.ClearXformOpOrder()
        mandible.AddTransformOp().Set(Gf.Matrix4d(1))

    edit(folder / "geo.usdc", change)


def break_baked_motion(folder):
    def change(layer):
        layer.SetTimeSample("/Actor.jaw:d1", 50.0, 0.0)

    edit(folder / "anim_capture.usdc", change)


BROKEN = [
    (break_model, "actor.usda", "Model", "error", "version 7"),
    (break_table_shape, "actor.usda", "Table", "error", "jaw:decoder:shape"),
    (break_table_finiteness, "actor.usda", "Table", "error", "not finite"),
    (break_table_agreement, "actor.usda", "Table", "error", "mm from the model"),
    (break_onnx_presence, "actor.usda", "Onnx", "error", "does not exist"),
    (break_onnx_hash, "actor.usda", "Onnx", "error", "SHA-256 differs"),
    (break_onnx_identity, "actor.usda", "Onnx", "error", "another model"),
    (break_onnx_agreement, "actor.usda", "Onnx", "error", "mm from the model"),
    (break_encoder_identity, "actor.usda", "Onnx", "error", "actor_encode.onnx was made from another model"),
    (break_encoder_agreement, "actor.usda", "Onnx", "error", "mm from the model"),
    (break_bounds, "actor.usda", "Bounds", "warning", "are outside"),
    (break_mandible_target, "actor.usda", "Mandible", "error", "/Actor/geo/Chin"),
    (break_mandible_ops, "actor.usda", "Mandible", "error", "expected translate"),
    (break_baked_motion, "anim_capture.usdc", "Mandible", "error", "baked pose"),
]


@pytest.mark.parametrize(("damage", "name", "rule", "severity", "message"), BROKEN)
def test_each_rule_finds_its_fault(folder, damage, name, rule, severity, message):
    assert_valid_usd(folder / name)
    damage(folder)
    findings = [finding for finding in validate_stage(folder / name) if finding.rule == rule]
    assert [finding.severity for finding in findings] == [severity]
    assert message in findings[0].message
    assert findings[0].path.startswith("/Actor")


@pytest.mark.parametrize("declared", ["double[] jaw:d1 = [1, 2]", 'string jaw:d2 = "x"', "asset jaw:d3 = @./a@"])
def test_values_of_other_types_are_findings(declared, anchored_folder):
    shot = anchored_folder / "shot.usda"
    shot.write_text(f'#usda 1.0\n( subLayers = [@./actor.usda@] )\nover "Actor" {{\n    {declared}\n}}\n')
    assert {"Bounds", "Mandible"} <= {found.rule for found in validate_stage(shot) if found.severity == "error"}


def test_every_rule_has_a_failing_fixture():
    assert {rule for _, _, rule, _, _ in BROKEN} == set(RULES) - {"Assembly"}, "that is for test_rig_assembly"


def test_rules_are_usdvalidation_validators(anchored_folder):
    assert register_validators() and register_validators()
    registry = UsdValidation.ValidationRegistry()
    assert all(registry.HasValidator(f"jawusd:{name}") for name in RULES)
    break_bounds(anchored_folder)
    context = UsdValidation.ValidationContext(["JawUsd"], True)
    errors = context.Validate(Usd.Stage.Open(str(anchored_folder / "actor.usda")))
    assert {(error.GetName(), error.GetType()) for error in errors} >= {
        ("Bounds", UsdValidation.ValidationErrorType.Warn)
    }


def test_stock_validators_run_too(anchored_folder):
    edit(anchored_folder / "geo.usdc", lambda layer: layer.pseudoRoot.ClearInfo("metersPerUnit"))
    findings = validate_stage(anchored_folder / "geo.usdc")
    assert findings and all(finding.rule not in RULES for finding in findings)
