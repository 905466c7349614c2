"""Make the rig that ships with jawusd: python docs/make_example_rig.py [out]

`out` is the folder of `jawusd build examples/capture -o out`. The rig is that build's, with meshes of fewer faces and a
coarser table, without the ONNX graphs and the package: `jawusd view` opens it where no rig is named.
"""

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from pxr import Sdf

from jawusd.evaluator import JawRig
from jawusd.formats.mesh import GUM, TOOTH, Mesh
from jawusd.formats.model import load_model
from jawusd.meshes.remeshing import bone_proxy_of, proxy_of
from jawusd.pipeline.view import part_of
from jawusd.rig.bake import bake_rig
from jawusd.rig.geo import read_geometry, read_gum
from jawusd.rig.layout import (
    ACTOR_FILE,
    CAPTURED_FILE,
    EXAMPLE_RIG,
    GEO_FILE,
    ONNX_ATTRIBUTES,
    RIG_FILE,
    SKEL_FILE,
)
from jawusd.rig.read import describe

TEETH_FACES, BONE_FACES = 8000, 3000  # the contacts of the teeth need edges of at most 1.5 mm
TABLE_SIZE = 17
SHIPPED = (ACTOR_FILE, RIG_FILE, GEO_FILE, SKEL_FILE, CAPTURED_FILE)


def make(out: Path, folder: Path) -> None:
    """Write the rig of a build to a folder, reduced."""
    model, whole, about = load_model(out / "model.npz"), read_geometry(out / ACTOR_FILE), describe(out / ACTOR_FILE)
    gum = read_gum(out / ACTOR_FILE)
    meshes = {
        name: proxy_of(labelled(mesh, gum[name]), TEETH_FACES) if name in gum else bone_proxy_of(mesh, BONE_FACES)
        for name, mesh in whole.items()
    }
    rig = JawRig(model.arrays, model.meta)
    with tempfile.TemporaryDirectory() as baked:
        bake_rig(
            baked,
            rig,
            meshes,
            name="example",
            fps=about["fps"],
            frames=model.frames,
            d=model.d,
            table_size=TABLE_SIZE,
            prim_name="example",
        )
        folder.mkdir(parents=True, exist_ok=True)
        for name in SHIPPED:
            shutil.copy(Path(baked) / name, folder / name)
    without_graphs(folder / ACTOR_FILE)


def labelled(mesh: Mesh, gum: np.ndarray) -> Mesh:
    """Return a teeth scan in two pieces, crown and gum, labelled as such; `gum` is a mask of its faces."""
    crown, soft = (part_of(mesh, faces) for faces in (~gum, gum))
    labels = np.repeat([TOOTH, GUM], [len(crown.vertices), len(soft.vertices)]).astype(np.uint8)
    faces = np.concatenate([crown.faces, soft.faces + np.int32(len(crown.vertices))])
    return Mesh(np.concatenate([crown.vertices, soft.vertices]), faces, labels=labels)


def without_graphs(actor: Path) -> None:
    """Remove the references to ONNX graphs from an interface layer."""
    layer = Sdf.Layer.FindOrOpen(str(actor))
    prim = layer.GetPrimAtPath(f"/{layer.defaultPrim}")
    for name in ONNX_ATTRIBUTES:
        prim.RemoveProperty(prim.properties[name])
    layer.Save()


def main() -> int:
    """Make the rig and print the sizes of its files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("out"))
    parser.add_argument("-o", "--folder", type=Path, default=EXAMPLE_RIG.parent)
    options = parser.parse_args()
    make(options.out, options.folder)
    for name in SHIPPED:
        print(f"{options.folder / name}: {(options.folder / name).stat().st_size / 1024:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
