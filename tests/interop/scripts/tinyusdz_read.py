"""Run in an environment with tinyusdz: print what it reads from a rig, as JSON.

Usage: python tinyusdz_read.py FILE
Prints {"schemas", "shape", "range", "channels": {"translation" | "rotation": {"times", "values"}}}.
"""

import json
import sys

import numpy as np
import tinyusdz

stage = tinyusdz.load(sys.argv[1])
actor = stage.get_prim_at_path("/Actor")
scene = tinyusdz.tydra.convert_to_render_scene(stage)
channels = {}
for animation in scene.animations():
    samplers = animation.samplers()
    for channel in animation.channels():
        sampler = samplers[channel["sampler"]]
        times, values = (np.asarray(part, dtype=float) for part in (sampler.times, sampler.values))
        channels[channel["path"]] = {"times": times.ravel().tolist(), "values": values.reshape(len(times), -1).tolist()}
result = {
    "schemas": actor.api_schemas(),
    "shape": np.asarray(actor.get_attribute("jaw:decoder:shape").value).tolist(),
    "meshes": len(scene.meshes()),
    "channels": channels,
}
print("RESULT " + json.dumps(result))
