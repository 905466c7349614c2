"""The layers of the design hold, and each guard is shown a violation that it must catch."""

import pytest
from package_copy import ROOT, copy_package, run_python

LINT = (
    "import sys\n"
    "from importlinter.cli import lint_imports\n"
    "sys.exit(lint_imports(config_filename='pyproject.toml', no_cache=True))\n"
)
# What a fresh interpreter loads beyond the standard library.
PROBE = (
    "import sys\n"
    "before = set(sys.modules)\n"
    "import {module}\n"
    "names = {{n.split('.')[0] for n in set(sys.modules) - before}} - set(sys.stdlib_module_names)\n"
    "print(' '.join(sorted(n for n in names if not n.startswith('_'))))\n"
)


def test_imports_follow_the_layers():
    result = run_python(ROOT, LINT)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize(
    ("file", "line", "contract"),
    [
        ("geometry/so3.py", "import jawusd.tracking", "Layers"),
        ("tracking/solver.py", "import jawusd.fitting", "Layers"),
        ("errors.py", "import jawusd.geometry", "Layers"),
        ("evaluator/rig.py", "import jawusd.formats", "evaluator"),
        ("evaluator/rig.py", "import numba", "numba and scipy"),
        ("evaluator/rig.py", "import jawusd.fast", "Layers"),
        ("fast/rig.py", "import jawusd.solvers", "Layers"),
        ("fast/rig.py", "import jawusd.imaging", "accelerator"),
        ("fast/rig.py", "import scipy", "accelerator"),
        ("fitting/__init__.py", "import pxr", "pxr and onnx"),
        ("rig/__init__.py", "import scipy", "numba and scipy"),
        ("pipeline/__init__.py", "import torch", "torch and shapely"),
        ("tracking/__init__.py", "import cv2", "Video and image"),
        ("segmentation/cut.py", "import jawusd.tracking", "Layers"),
        ("tracking/guided.py", "import jawusd.segmentation", "Layers"),
        ("segmentation/cut.py", "import torch", "torch and shapely"),
        ("segmentation/cut.py", "import rich", "typer and rich"),
        ("fitting/__init__.py", "import rich", "typer and rich"),
        ("fitting/__init__.py", "import matplotlib", "matplotlib and jinja2"),
        ("report/__init__.py", "import jawusd.fitting", "Layers"),
        ("formats/poses.py", "import h5py", "h5py belongs"),
        ("cli/many_commands.py", "import distributed", "dask and distributed"),
        ("pipeline/view.py", "import viser", "viser belongs"),
        ("viewer/page.py", "import jawusd.rig", "Layers"),
        ("viewer/plots.py", "import matplotlib", "matplotlib and jinja2"),
        ("viewer/decimate.py", "import trimesh", "Video and image"),
        ("library/index.py", "import jawusd.rig", "Layers"),
        ("library/transport.py", "import scipy", "numba and scipy"),
        ("newlayer/__init__.py", "x = 1", "newlayer"),
    ],
)
def test_a_planted_import_breaks_its_contract(tmp_path, file, line, contract):
    folder = copy_package(tmp_path)
    target = folder / "jawusd" / file
    target.parent.mkdir(exist_ok=True)
    with target.open("a") as handle:
        handle.write(f"\n{line}\n")
    result = run_python(folder, LINT)
    assert result.returncode != 0
    assert contract in result.stdout + result.stderr


@pytest.mark.parametrize(("module", "allowed"), [("jawusd", {"jawusd"}), ("jawusd.evaluator", {"jawusd", "numpy"})])
def test_a_clean_interpreter_loads_only_what_is_allowed(module, allowed):
    result = run_python(ROOT, PROBE.format(module=module))
    assert result.returncode == 0, result.stderr
    assert set(result.stdout.split()) == allowed


@pytest.mark.parametrize(
    "line", ["import scipy", "import importlib; importlib.import_module('scipy')", "import jawusd.rig"]
)
def test_the_probe_sees_a_planted_import_however_it_is_made(tmp_path, line):
    folder = copy_package(tmp_path)
    with (folder / "jawusd" / "evaluator" / "__init__.py").open("a") as handle:
        handle.write(f"\n{line}\n")
    result = run_python(folder, PROBE.format(module="jawusd.evaluator"))
    assert set(result.stdout.split()) - {"jawusd", "numpy"}


def test_help_loads_nothing_heavy():
    code = (
        "import sys\n"
        "from typer.testing import CliRunner\n"
        "from jawusd.cli.main import app\n"
        "result = CliRunner().invoke(app, ['--help'])\n"
        "heavy = {'torch','cv2','av','numba','scipy','shapely','trimesh','moderngl','pxr','onnx','pydantic','numpy',"
        "'matplotlib','h5py','viser','dask','distributed'}\n"
        "print(result.exit_code, sorted(heavy & set(sys.modules)))\n"
    )
    result = run_python(ROOT, code)
    assert result.stdout.strip() == "0 []", result.stdout + result.stderr
