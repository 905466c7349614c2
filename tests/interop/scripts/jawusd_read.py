"""Run with any usd-core and jawusd on the path: load, describe, validate and animate a rig; print JSON.

Usage: python jawusd_read.py FOLDER
"""

import json
import sys

from pxr import Sdf, Usd

from jawusd.rig import describe, load_rig, validate_stage, write_animation
from jawusd.rig.motion_read import read_poses_of_stage

folder = sys.argv[1]
d = [[10.0, 1.0, 0.5], [0.0, 0.0, 0.0]]
write_animation(f"{folder}/anim_here.usdc", f"{folder}/actor.usda", [0, 10], [[0, 0, 0], d[0]], 24)
skeleton = Sdf.Layer.OpenAsAnonymous(f"{folder}/anim_capture.usdc")
skeleton.GetPrimAtPath("/Actor").variantSelections["motion"] = "skeleton"
skeleton.Export(f"{folder}/skeleton.usdc")
result = {
    "version": Usd.GetVersion(),
    "poses": load_rig(f"{folder}/anim_capture.usdc").pose(d).tolist(),
    "kind": describe(f"{folder}/actor.usdz")["model"]["kind"],
    "findings": [[f.severity, f.rule] for f in validate_stage(f"{folder}/anim_here.usdc")],
    "bones": read_poses_of_stage(f"{folder}/skeleton.usdc")[1].tolist(),
    "bone_findings": [[f.severity, f.rule] for f in validate_stage(f"{folder}/skeleton.usdc")],
}
print("RESULT " + json.dumps(result))
