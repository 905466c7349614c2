"""Several persons made from the example model: other sizes of bone and other ranges, the same kind of joint."""

import numpy as np
from example_model import example_arrays, example_meta

from jawusd.evaluator import JawRig
from jawusd.formats.model import JawModel, save_model


def person(actor, ranges=1.0, opening=1.0, wider_mm=0.0, kind="anchored"):
    """Return a rig: lateral and protrusive ranges and the opening scaled, each condyle farther out by `wider_mm`."""
    arrays = example_arrays(kind)
    arrays["slice_support"] = arrays["slice_support"] * ranges
    arrays["slice_d1"] = arrays["slice_d1"] * opening
    arrays["codes"] = arrays["codes"] * [opening, ranges, ranges]
    arrays["d_range"] = arrays["d_range"] * [[opening], [ranges], [ranges]]
    sideways = arrays["landmarks"][3] - arrays["landmarks"][4]
    sideways = sideways / np.linalg.norm(sideways) * wider_mm
    arrays["landmarks"] = arrays["landmarks"].copy()
    arrays["landmarks"][3] += sideways
    arrays["landmarks"][4] -= sideways
    return JawRig(arrays, {**example_meta(kind), "actor": actor})


def save(rig, path):
    """Write a rig's model file, as `jawusd fit` does, without captured frames."""
    none = np.zeros(0)
    arrays = {name: np.array(value) for name, value in rig.arrays.items()}
    save_model(path, JawModel(arrays, none.astype(int), np.zeros((0, 3)), none, none.astype(bool), dict(rig.meta)))
    return path
