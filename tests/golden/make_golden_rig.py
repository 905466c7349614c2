"""Write the golden rigs of the present format version: `python tests/golden/make_golden_rig.py`.

Run once per format version, before it is released; the files are then kept for ever, and every later reader must give
the same poses from them.
"""

import json
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "support"))

from example_rig import example_meshes, touching_rig  # noqa: E402

from jawusd.rig.bake import decoder_layer, interface_layer  # noqa: E402
from jawusd.rig.geo import build_geometry  # noqa: E402
from jawusd.rig.layers import write_layer  # noqa: E402
from jawusd.rig.layout import ACTOR_FILE, FORMAT_VERSION, GEO_FILE, ONNX_FILE, RIG_FILE  # noqa: E402
from jawusd.rig.onnx_sidecar import decode_model, write_onnx  # noqa: E402
from jawusd.rig.table import build_table  # noqa: E402


def write(kind):
    """Write the rig of one kind and what it must say: poses and margins inside the bounds, at rest and far outside."""
    folder = HERE / f"rig_v{FORMAT_VERSION}_{kind}"
    rig, meshes = touching_rig(kind), example_meshes()
    moving = np.concatenate([meshes[name].vertices for name in ("mandible", "lower_teeth")])
    write_layer(build_geometry(meshes, rig.arrays["T_rest"]), folder / GEO_FILE)
    write_layer(decoder_layer(rig, build_table(rig, moving, 17)), folder / RIG_FILE)
    write_onnx(folder / ONNX_FILE, decode_model(rig, np.float64))
    write_layer(interface_layer(rig, f"golden {kind}", meshes, 24.0), folder / ACTOR_FILE)
    rng = np.random.default_rng(12)
    d = np.round(np.concatenate([np.zeros((1, 3)), rng.uniform([-5, -12, -5], [50, 12, 10], (39, 3))]), 3)
    said = {"d": d.tolist(), "poses": rig.pose(d).tolist(), "margins": rig.margin(d).tolist()}
    (folder / "poses.json").write_text(json.dumps(said))


for name in ("anchored", "additive"):
    write(name)
