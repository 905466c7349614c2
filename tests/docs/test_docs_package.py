"""What a wheel says of itself: one version, and a page whose pictures and links lead to the repository."""

import re
import sys
from pathlib import Path

import pytest
import yaml
from package_copy import ROOT

import jawusd
from jawusd.rig.layout import EXAMPLE_RIG

pytest.importorskip("hatchling", reason="hatchling is not installed")
REPOSITORY = "https://repository.example/jawusd"


@pytest.fixture
def metadata(monkeypatch):
    """Return a function that reads the metadata of a build with an address of the repository, or none."""
    from hatchling.metadata.core import ProjectMetadata
    from hatchling.plugin.manager import PluginManager

    def read(repository):
        monkeypatch.setenv("JAWUSD_REPOSITORY_URL", repository)
        project = ProjectMetadata(str(ROOT), PluginManager())
        return project.version, project.core

    yield read
    sys.modules.pop("hatch_build", None)


def test_the_version_stands_in_one_place(metadata):
    version, _ = metadata("")
    assert version == jawusd.__version__
    assert not re.search(r"^version", (ROOT / "CITATION.cff").read_text(), flags=re.M)


def test_pages_of_a_release_have_absolute_pictures_and_links(metadata):
    _, core = metadata(REPOSITORY)
    local = re.findall(r"\]\((?!https?://)([^)]+)\)", core.readme)
    assert local == []
    assert f"]({REPOSITORY}/raw/v{jawusd.__version__}/examples/pictures/overlay.png)" in core.readme
    assert f"({REPOSITORY}/blob/v{jawusd.__version__}/docs/glossary.md)" in core.readme
    assert core.urls["Repository"] == REPOSITORY


def test_pages_of_other_builds_name_no_addresses(metadata):
    _, core = metadata("")
    assert core.readme == (ROOT / "README.md").read_text()
    assert core.urls == {}


def test_a_wheel_brings_the_example_rig():
    from hatchling.builders.wheel import WheelBuilder

    shipped = {Path(file.distribution_path) for file in WheelBuilder(str(ROOT)).recurse_included_files()}
    folder = Path("jawusd", "rig", "example")
    files = {folder / file.name for file in (ROOT / folder).iterdir()}
    assert folder / EXAMPLE_RIG.name in files <= shipped


def test_citation_names_what_the_format_asks_for():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(cited)
    assert cited["license"] == "Apache-2.0"


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.name)
def test_workflows_and_templates_can_be_read(path):
    read = yaml.safe_load(path.read_text())
    assert read
    for job in read.get("jobs", {}).values() if isinstance(read, dict) else ():
        for step in job["steps"]:
            assert ("run" in step) != ("uses" in step)
