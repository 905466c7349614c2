"""Shots of the baked example rig, with keys of d."""

import numpy as np
from pxr import Usd, UsdGeom
from typer.testing import CliRunner

from jawusd.cli.main import app

#: d1, d2, d3 [mm] by frame
KEYS = {1: (0.0, 0.0, 0.0), 13: (15.0, 2.0, 1.0), 25: (4.0, -2.0, 0.5)}


def run(*arguments, code=0):
    """Run jawusd and return its output."""
    done = CliRunner().invoke(app, [str(x) for x in arguments])
    assert done.exit_code == code, done.output
    return done.stdout


def shot(folder, change, name="shot.usda", actors=("Person",), source="actor.usda"):
    """Write a changed shot that references the actor one or more times."""
    stage = Usd.Stage.CreateNew(str(folder / name))
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(25)
    stage.SetTimeCodesPerSecond(24)
    stage.SetDefaultPrim(stage.DefinePrim("/Shot", "Xform"))
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 0.001)
    for actor in actors:
        prim = stage.DefinePrim(f"/Shot/{actor}", "Xform")
        prim.GetReferences().AddReference(f"./{source}")
        change(prim)
    stage.Save()
    return folder / name


def key_d(prim):
    """Key d1, d2, d3 of an actor."""
    for i in range(3):
        for time, d in KEYS.items():
            prim.GetAttribute(f"jaw:d{i + 1}").Set(d[i], time)


def keyed(frames):
    """Return d (F, 3) [mm] at frames, interpolated between the keys."""
    return np.stack([np.interp(frames, list(KEYS), column) for column in np.transpose(list(KEYS.values()))], axis=1)
