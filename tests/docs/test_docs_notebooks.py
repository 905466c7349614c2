"""The notebooks run from top to bottom on the rig of the example, and print what is stored in them."""

import json

import pytest
from doc_blocks import missing
from load_script import load_script
from package_copy import ROOT

nbformat = pytest.importorskip("nbformat", reason="nbclient is not installed")
pytest.importorskip("nbclient", reason="nbclient is not installed")
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
QUICK = "pose_a_rig"
pytestmark = pytest.mark.filterwarnings("ignore:.*:DeprecationWarning:jupyter_client|traitlets|zmq")


@pytest.fixture(scope="module")
def program():
    return load_script(ROOT / "docs" / "run_notebooks.py")


def marked(path):
    """Return a notebook as a parameter; those that fit models or solve take ten seconds and more."""
    return pytest.param(path, id=path.stem, marks=() if path.stem == QUICK else pytest.mark.slow)


@pytest.mark.parametrize("path", [marked(path) for path in NOTEBOOKS])
def test_a_notebook_prints_what_is_stored_in_it(path, program, example_build):
    stored, run = nbformat.read(path, as_version=4), program.executed(path, example_build[0])
    expected = program.printed(stored)
    assert len(expected) >= 5
    assert missing(expected, program.printed(run)) is None
    drawn = [[output.output_type for output in cell.get("outputs", [])] for cell in run.cells]
    assert drawn == [[output.output_type for output in cell.get("outputs", [])] for cell in stored.cells]


def test_a_notebook_that_fails_is_found(program, example_build, tmp_path):
    from nbclient.exceptions import CellExecutionError

    path = tmp_path / "broken.ipynb"
    cells = [nbformat.v4.new_code_cell('import jawusd\njawusd.load("../../out/nothing.usda")')]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
    with pytest.raises(CellExecutionError, match="there is no such file"):
        program.executed(path, example_build[0])


def test_notebooks_are_small_in_the_navigation_and_ready_for_jupyter():
    assert 3 <= len(NOTEBOOKS) <= 5
    navigation = (ROOT / "mkdocs.yml").read_text()
    for path in NOTEBOOKS:
        assert f"notebooks/{path.stem}.md" in navigation
        assert path.stat().st_size < 120_000
        stored = json.loads(path.read_text())
        nbformat.validate(stored)
        assert "/tmp" not in path.read_text() and stored["metadata"]["kernelspec"]["name"] == "python3"
