"""Damage the structure of USD layers and HDF5 files: files that parse, with values nobody expects."""

import tempfile
from pathlib import Path

import fuzz_mutate as mutate
import h5py
import numpy as np
from pxr import Sdf, Vt

_VALUES = (
    (Sdf.ValueTypeNames.Double, (0.0, -1.0, 1e300, float("nan"), float("inf"))),
    (Sdf.ValueTypeNames.Int, (0, -1, 2, 2**31 - 1)),
    (Sdf.ValueTypeNames.String, ("", "nan", "{}", "[]", "[" * 3000, "\0", "grid", "x" * 9999)),
    (Sdf.ValueTypeNames.Token, ("", "mm", "anchored", "additive", "curves", "none")),
    (Sdf.ValueTypeNames.Bool, (True, False)),
    (Sdf.ValueTypeNames.DoubleArray, ((), (1.0,), (float("nan"),) * 4, (1e308,) * 36, tuple(range(3000)))),
    (Sdf.ValueTypeNames.IntArray, ((), (-1,), (2**31 - 1, -5), (0, 10**9, 3), (3,) * 1000)),
    (Sdf.ValueTypeNames.FloatArray, ((), (1.5,), (float("inf"),) * 6)),
    (Sdf.ValueTypeNames.Double2, ((0.0, 0.0), (5.0, -5.0), (float("nan"), 1.0))),
    (Sdf.ValueTypeNames.Point3fArray, ((), ((0, 0, 0),), ((1e30, float("nan"), 0),) * 5)),
    (Sdf.ValueTypeNames.Asset, mutate.PATHS),
)
_TIMES = (0.0, -1.0, 35.5, 1e9, 1e300, -1e300)


def damaged_layer(binary):
    """Return a damager of layers that parse; now and then it damages the bytes instead."""
    suffix = ".usdc" if binary else ".usda"

    def damaged(rng, data):
        if rng.random() < 0.4:
            return mutate.damaged_bytes(rng, data) if binary else mutate.damaged_either(rng, data)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"layer{suffix}"
            path.write_bytes(data)
            layer = Sdf.Layer.OpenAsAnonymous(str(path))
            for _ in range(rng.integers(1, 4)):
                fault = _LAYER_FAULTS[rng.integers(len(_LAYER_FAULTS))]
                try:
                    fault(rng, layer)
                except Exception:  # what USD itself does not let in is no input
                    continue
            layer.Export(str(path))
            return path.read_bytes()

    return damaged


def _specs(layer, kind):
    found = []
    layer.Traverse("/", lambda path: found.append(layer.GetObjectAtPath(path)))
    return [spec for spec in found if isinstance(spec, kind)]


def _some(rng, items):
    return items[rng.integers(len(items))]


def _value(rng, layer):
    spec = _some(rng, _specs(layer, Sdf.AttributeSpec))
    kind, values = _some(rng, _VALUES)
    value = _some(rng, values)
    if rng.random() < 0.5:  # keep the type, change the value
        old = spec.default
        if isinstance(old, float):
            spec.default = _some(rng, (0.0, -1.0, 1e300, float("nan"), float("inf"), -old))
        elif isinstance(old, Vt.DoubleArray | Vt.IntArray | Vt.FloatArray | Vt.Vec3fArray):
            numbers = np.array(old)
            cut = _some(rng, (numbers[:0], numbers[1:], numbers[::-1], np.concatenate([numbers, numbers]), numbers * 0))
            spec.default = type(old).FromNumpy(np.ascontiguousarray(cut))
        elif isinstance(old, str):
            spec.default = _some(rng, _VALUES[2][1])
        return
    owner, name = spec.owner, spec.name
    owner.RemoveProperty(spec)
    Sdf.AttributeSpec(owner, name, kind).default = value


def _sample(rng, layer):
    spec = _some(rng, _specs(layer, Sdf.AttributeSpec))
    for _ in range(rng.integers(1, 4)):
        layer.SetTimeSample(spec.path, _some(rng, _TIMES), _some(rng, (float("nan"), 1e308, 0.5, -40.0)))


def _remove(rng, layer):
    spec = _some(rng, _specs(layer, Sdf.PropertySpec))
    spec.owner.RemoveProperty(spec)


def _type(rng, layer):
    spec = _some(rng, _specs(layer, Sdf.PrimSpec))
    spec.typeName = _some(rng, ("", "Mesh", "Xform", "Scope", "GeomSubset", "SkelRoot", "Nothing", "Camera"))


def _reach(rng, layer):
    spec = _some(rng, _specs(layer, Sdf.PrimSpec))
    path = _some(rng, (*mutate.PATHS, "./actor.usda", "./anim.usda", "./geo.usdc"))
    kind = rng.integers(5)
    if kind == 0:
        layer.subLayerPaths.append(path)
    elif kind == 1:
        spec.referenceList.prependedItems.append(Sdf.Reference(path))
    elif kind == 2:
        spec.payloadList.prependedItems.append(Sdf.Payload(path, "/Actor"))
    elif kind == 3:
        Sdf.AttributeSpec(spec, "inputs:file", Sdf.ValueTypeNames.Asset).default = Sdf.AssetPath(path)
    else:
        clip = {"default": {"assetPaths": Sdf.AssetPathArray([Sdf.AssetPath(path)]), "primPath": "/Actor"}}
        spec.SetInfo("clips", clip)


def _times(rng, layer):
    layer.startTimeCode, layer.endTimeCode = _some(rng, _TIMES), _some(rng, _TIMES)
    layer.timeCodesPerSecond = _some(rng, (0.0, -24.0, 1e300, float("nan")))


def _double(rng, layer):
    spec = _some(rng, _specs(layer, Sdf.PrimSpec))
    Sdf.CopySpec(layer, spec.path, layer, Sdf.Path(f"/Copy{rng.integers(9)}"))


def _inherit(rng, layer):
    specs = _specs(layer, Sdf.PrimSpec)
    spec, other = _some(rng, specs), _some(rng, specs)
    arcs = spec.inheritPathList if rng.random() < 0.5 else spec.specializesList
    arcs.prependedItems.append(other.path)


def _target(rng, layer):
    spec = _some(rng, _specs(layer, Sdf.RelationshipSpec))
    spec.targetPathList.explicitItems = [_some(rng, ("/", "/Nothing", "/Actor.jaw:d1", "/Actor"))]


_LAYER_FAULTS = (_value, _value, _value, _value, _sample, _remove, _type, _reach, _reach, _times, _double, _inherit,
                 _target)  # fmt: skip

_GROUP = "T_model_origin_mand_landmark_t"


def damaged_hdf5(rng, data):
    """Return an HDF5 file with other data sets, links or attributes than expected, or damaged as bytes."""
    if rng.random() < 0.4:
        return mutate.damaged_bytes(rng, data)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.h5"
        path.write_bytes(data)
        with h5py.File(path, "r+") as file:
            group = file[_GROUP]
            name = str(_some(rng, ("translations", "rotations", "transformations", "more")))
            if name in group:
                del group[name]
            kind = rng.integers(9)
            if kind == 0:
                shape = _some(rng, ((0, 3), (5,), (), (5, 4), (5, 3, 3), (1, 2, 3, 4), (7, 3)))
                group[name] = np.full(shape, _some(rng, (0.0, np.nan, 1e300, np.inf)))
            elif kind == 1:
                shape = _some(rng, ((10**7, 4), (10**9, 3), (10**7, 4, 4), (5, 10**6), (2**40, 3)))
                group.create_dataset(name, shape, "f8", chunks=True, compression="gzip")
            elif kind == 2:
                group[name] = _some(rng, ("text", np.array([b"a", b"b"]), np.zeros(3, [("a", "f8")]), 1j, 3))
            elif kind == 3:
                group[name] = h5py.ExternalLink(str(_some(rng, mutate.PATHS[:10])), "/")
            elif kind == 4:
                group[name] = h5py.SoftLink(str(_some(rng, ("/", "/nothing", f"/{_GROUP}", f"/{_GROUP}/{name}"))))
            elif kind == 5:
                group.create_dataset(name, (5, 3), "f8", external=[("../secret.txt", 0, 120)])
            elif kind == 6:
                layout = h5py.VirtualLayout((5, 3), "f8")
                layout[:] = h5py.VirtualSource("../outside.h5", "x", (5, 3))
                group.create_virtual_dataset(name, layout)
            elif kind == 7:
                group.attrs["unit"] = _some(rng, ("", "km", 3.0, np.zeros(4), b"\xff\xfe", np.array(["mm"], "S2")))
            else:
                group.create_group(name)
        return path.read_bytes()
