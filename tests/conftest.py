"""What several folders of tests share."""

import json

import pytest
from filelock import FileLock
from package_copy import ROOT


@pytest.fixture(scope="session")
def example_build(tmp_path_factory, worker_id):
    """Build examples/capture once per run, in the first process that needs it.

    Returns the folder, which nobody may change, and the summary.
    """
    from jawusd.pipeline.build import BuildOptions, build

    own = tmp_path_factory.getbasetemp()
    shared = own if worker_id == "master" else own.parent  # of all processes of this run
    out, said = shared / "example" / "actor", shared / "example.json"
    with FileLock(shared / "example.lock"):
        if not said.exists():
            said.write_text(json.dumps(build(ROOT / "examples" / "capture", out, BuildOptions(), lambda *told: None)))
    return out, json.loads(said.read_text())
