"""The small take without faults, tracked once for all files that compare with it."""

import pickle

import pytest
from filelock import FileLock
from small_take import make_capture, track, write_masks

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
