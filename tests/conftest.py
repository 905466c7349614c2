"""What several folders of tests share."""

import pytest
from package_copy import ROOT


@pytest.fixture(scope="session")
def example_build(tmp_path_factory):
    """Build examples/capture once per run; return the folder, which nobody may change, and the summary."""
    from jawusd.pipeline.build import BuildOptions, build

    out = tmp_path_factory.mktemp("build") / "actor"
    return out, build(ROOT / "examples" / "capture", out, BuildOptions(), lambda stage, done, total: None)
