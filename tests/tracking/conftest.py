"""The small take without faults, tracked once for all files that compare with it; and a take of a jaw with a rig."""

import pickle

import numpy as np
import pytest
import rig_take
import small_take
from bumpy_teeth import jaw_poses
from example_model import LANDMARKS_ANATOMICAL, example_arrays, example_meta
from filelock import FileLock
from small_take import make_capture, track, write_masks

from jawusd.evaluator import JawRig
from jawusd.tracking.contour.scan import prepare_scan

FRAMES = 16


@pytest.fixture(scope="session")
def clean_take(tmp_path_factory, worker_id):
    """Return the capture of 16 frames and its tracks, made once per run in the first process that needs them."""
    own = tmp_path_factory.getbasetemp()
    shared = own if worker_id == "master" else own.parent  # of all processes of this run
    folder, kept = shared / "clean_take", shared / "clean_take.pickle"
    with FileLock(shared / "clean_take.lock"):
        if not kept.exists():
            tracks = track(make_capture(write_masks(folder, FRAMES), FRAMES))
            kept.write_bytes(pickle.dumps(tracks))
    return make_capture(folder, FRAMES), pickle.loads(kept.read_bytes())


@pytest.fixture(scope="module")
def jaw():
    same = {"T_anatomical_skull": np.eye(4), "T_rest": np.eye(4), "landmarks": LANDMARKS_ANATOMICAL}
    return JawRig({**example_arrays(), **same}, example_meta())


@pytest.fixture(scope="module")
def scans():
    return tuple(prepare_scan(mesh, row) for mesh, row in zip(small_take.MESHES, small_take.ROWS))


@pytest.fixture(scope="module")
def truth():
    """The jaw parameters and the head of every frame."""
    t = np.arange(rig_take.COUNT)
    d = np.column_stack([7.0 + 2.5 * np.sin(0.3 * t), 1.2 * np.sin(0.25 * t), 0.6 + 0.5 * np.cos(0.2 * t)])
    return d, jaw_poses(rig_take.COUNT)[:, 0]


@pytest.fixture(scope="module")
def folder(jaw, truth, tmp_path_factory):
    """The masks of the take; none in the hidden frames."""
    return rig_take.write_masks(tmp_path_factory.mktemp("shot"), jaw, truth, small_take.CAMERAS)
