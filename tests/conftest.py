"""What several folders of tests share."""

import json
import os
import shutil

import pytest
from filelock import FileLock
from package_copy import ROOT

# Before OpenUSD is loaded, and for the programs that tests start: in one thread, as `jawusd` runs it.
os.environ |= {"PXR_WORK_THREAD_LIMIT": "1", "TF_ENV_SETTING_ALERTS_ENABLED": "0"}
# Before numpy and torch are loaded: the processes that share the tests use all cores already, and threads of linear
# algebra that wait for one another cost a third of the time.
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

FAST = {"evaluator", "formats", "geometry", "library"}  # folders of tests that need neither footage nor USD


def pytest_collection_modifyitems(items):
    """Mark the tests of the small folders as fast, and begin with files that have slow tests.

    Processes take whole files: a long one that begins last leaves the others idle.
    """
    for item in items:
        if item.path.parent.name in FAST and item.get_closest_marker("slow") is None:
            item.add_marker("fast")
    long = {item.path for item in items if item.get_closest_marker("slow") is not None}
    items.sort(key=lambda item: item.path not in long)


@pytest.fixture(scope="session")
def example_build(tmp_path_factory, worker_id):
    """Build examples/capture once per run, in the first process that needs it.

    Returns the folder, which nobody may change, and the summary. JAWUSD_EXAMPLE_BUILD may name a folder in which the
    same version has built it: what is there is taken over.
    """
    from jawusd.pipeline.build import BuildOptions, build

    own = tmp_path_factory.getbasetemp()
    shared = own if worker_id == "master" else own.parent  # of all processes of this run
    out, said = shared / "example" / "actor", shared / "example.json"
    with FileLock(shared / "example.lock"):
        if not said.exists():
            built = os.environ.get("JAWUSD_EXAMPLE_BUILD")
            if built:
                shutil.copytree(built, out)
            options = BuildOptions(resume=bool(built))
            said.write_text(json.dumps(build(ROOT / "examples" / "capture", out, options, lambda *told: None)))
    return out, json.loads(said.read_text())
