"""Run in an environment with any usd-core: print the poses of an animated rig, as JSON.

Usage: python usd_read.py FILE FRAME,FRAME,...
"""

import json
import sys

from pxr import Usd, UsdGeom

stage = Usd.Stage.Open(sys.argv[1])
actor = stage.GetPrimAtPath("/Actor")
mandible = UsdGeom.Xformable(stage.GetPrimAtPath("/Actor/geo/Mandible"))
frames = [float(frame) for frame in sys.argv[2].split(",")]
matrices = [mandible.GetLocalTransformation(frame) for frame in frames]
result = {
    "version": Usd.GetVersion(),
    "poses": [[[matrix[j][i] for j in range(4)] for i in range(4)] for matrix in matrices],
    "d": [[actor.GetAttribute(f"jaw:d{i}").Get(frame) for i in (1, 2, 3)] for frame in frames],
    "table": len(actor.GetAttribute("jaw:decoder:twists").Get()),
    "schemas": list(actor.GetMetadata("apiSchemas").GetAddedOrExplicitItems()),
}
print("RESULT " + json.dumps(result))
