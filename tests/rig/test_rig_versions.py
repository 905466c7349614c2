"""Rigs of older versions are upgraded in memory by all readers; the files are unchanged."""

import numpy as np
import pytest
from example_rig import example_rig, forget_checksums
from pxr import Sdf, Usd

from jawusd.base.errors import VersionError
from jawusd.rig import attributes, describe, load_rig, validate_stage

NEXT = attributes.FORMAT_VERSION + 1
OLD_NAME, NEW_NAME = "jaw:decoder:error", "jaw:decoder:maxError"


@pytest.fixture
def older(anchored_folder, monkeypatch):
    """Return a rig of a fictitious older version: another name, incisal point in inches.

    The current format becomes the next version, and UPGRADES gets the upgrade to it.
    """
    for file, change in (("rig.usdc", _rename), ("rig.usdc", _to_inches)):
        layer = Sdf.Layer.OpenAsAnonymous(str(anchored_folder / file))
        change(layer)
        layer.Export(str(anchored_folder / file))
    forget_checksums(anchored_folder)

    def step(prim):
        error = prim.CreateAttribute(NEW_NAME, Sdf.ValueTypeNames.Double)
        error.Set(prim.GetAttribute(OLD_NAME).Get())
        incisor = prim.GetAttribute("jaw:model:incisor")
        incisor.Set(np.array(incisor.Get()) * 25.4)

    monkeypatch.setattr(attributes, "FORMAT_VERSION", NEXT)
    monkeypatch.setitem(attributes.UPGRADES, NEXT - 1, step)
    return anchored_folder


def _rename(layer):
    attribute = layer.GetAttributeAtPath(f"/Actor.{NEW_NAME}")
    attribute.name = OLD_NAME


def _to_inches(layer):
    incisor = layer.GetAttributeAtPath("/Actor.jaw:model:incisor")
    incisor.default = np.array(incisor.default) / 25.4


def test_an_older_rig_gives_the_same_poses(older):
    before = {path.name: path.read_bytes() for path in older.iterdir()}
    d = [[10.0, 2.0, 1.0], [0, 0, 0]]
    for file in ("actor.usda", "anim_capture.usdc"):
        np.testing.assert_allclose(load_rig(older / file).pose(d), example_rig().pose(d), atol=1e-12)
        assert describe(older / file)["table"]["max_error_mm"] > 0
    assert {path.name: path.read_bytes() for path in older.iterdir()} == before


def test_an_older_rig_is_validated_as_it_is_read(older):
    findings = validate_stage(older / "actor.usda")
    assert {finding.rule for finding in findings} <= {"Onnx"}  # the sidecar was hashed with the current arrays


def test_reading_twice_on_one_stage_upgrades_once(older):
    stage = Usd.Stage.Open(str(older / "actor.usda"))
    prim = stage.GetPrimAtPath("/Actor")
    for _ in range(2):
        attributes.upgrade_rig(prim)
        assert prim.GetAttribute("jaw:formatVersion").Get() == NEXT
    np.testing.assert_allclose(prim.GetAttribute("jaw:model:incisor").Get(), example_rig().arrays["incisor"])


def test_a_version_after_the_present_one_is_refused(older):
    layer = Sdf.Layer.OpenAsAnonymous(str(older / "actor.usda"))
    layer.GetAttributeAtPath("/Actor.jaw:formatVersion").default = NEXT + 1
    layer.Export(str(older / "actor.usda"))
    with pytest.raises(VersionError, match=f"version {NEXT + 1}; this version of jawusd reads versions up to {NEXT}"):
        load_rig(older / "actor.usda")


def test_every_older_version_has_a_step():
    assert sorted(attributes.UPGRADES) == list(range(1, attributes.FORMAT_VERSION))
