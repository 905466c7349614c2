"""The benchmark on data of others says what to clone, and which folder is missing."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "real"
REPOSITORIES = ("paulgribble/optotrak", "aaltolab/artisynth-chewing-env", "Nosenzor/Open3SDCM")


def run(*arguments):
    """Run the benchmark; return its exit code, output and complaint."""
    command = [sys.executable, SCRIPT, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    return done.returncode, done.stdout, done.stderr


def test_the_list_names_repositories_and_licences():
    code, told, _ = run("--list")
    assert code == 0
    for repository in REPOSITORIES:
        row = next(line for line in told.splitlines() if f"`{repository}`" in line)
        assert row.count("|") == 5 and all(cell.strip() for cell in row.split("|")[1:-1])
        assert f"git clone https://github.com/{repository} DIR/" in told


@pytest.mark.parametrize("made", [(), ("optotrak",)])
def test_a_missing_folder_is_one_line(tmp_path, made):
    for name in made:
        (tmp_path / name).mkdir()
    code, told, complaint = run("--data", str(tmp_path))
    assert code == 1 and not told
    assert complaint.count("\n") == 1 and str(tmp_path / "optotrak") in complaint
    assert "git clone https://github.com/paulgribble/optotrak" in complaint
