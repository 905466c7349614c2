"""The layers of the design hold, and each guard is shown a violation that it must catch."""

import tomllib

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
        ("tracking/__init__.py", "import jawusd.fitting", "Layers"),
        ("base/errors.py", "import jawusd.geometry", "Layers"),
        ("evaluator/rig.py", "import jawusd.formats", "The evaluator"),
        ("evaluator/rig.py", "import jawusd.fast", "Layers"),
        ("fast/rigid.py", "import jawusd.solvers", "Layers"),
        ("fast/rigid.py", "import jawusd.media", "The evaluator"),
        ("segmentation/arches.py", "import jawusd.tracking", "Layers"),
        ("tracking/__init__.py", "import jawusd.segmentation", "Layers"),
        ("report/__init__.py", "import jawusd.fitting", "Layers"),
        ("viewer/page.py", "import jawusd.rig", "Layers"),
        ("library/index.py", "import jawusd.rig", "Layers"),
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


def ownership():
    """Return each owned package with the layers that may import it, from the protected contracts."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    protected = [contract for contract in contracts if contract["type"] == "protected"]
    return {package: set(c["allowed_importers"]) for c in protected for package in c["protected_modules"]}


def test_every_heavy_package_has_an_owner():
    owned = {"torch", "scipy", "shapely", "numba", "cv2", "av", "trimesh", "moderngl", "pyfqmr", "pxr", "onnx", "bpy"}
    owned |= {"onnxruntime", "typer", "rich", "matplotlib", "jinja2", "h5py", "ezc3d", "dask", "viser", "pydantic"}
    assert owned <= set(ownership())


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    """Import every owned package in a module of its own in each layer that may not; return both and what is said."""
    folder = copy_package(tmp_path_factory.mktemp("planted"))
    layers = {f"jawusd.{path.parent.name}" for path in (folder / "jawusd").glob("*/__init__.py")}
    others = {package: sorted(layers - allowed) for package, allowed in ownership().items()}
    for package in others:
        for layer in others[package]:
            place = folder / layer.replace(".", "/") / f"planted_{package}.py"
            place.write_text(f"def later():\n    import {package}\n")
    result = run_python(folder, LINT)
    assert result.returncode != 0
    return others, result.stdout


@pytest.mark.parametrize("package", sorted(ownership()))
def test_an_owned_package_is_refused_in_every_other_layer(planted, package):
    others, said = planted
    assert len(others[package]) > 10
    assert [layer for layer in others[package] if f"{layer}.planted_{package} -> {package} " not in said] == []


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
        "'matplotlib','h5py','ezc3d','viser','dask','distributed'}\n"
        "print(result.exit_code, sorted(heavy & set(sys.modules)))\n"
    )
    result = run_python(ROOT, code)
    assert result.stdout.strip() == "0 []", result.stdout + result.stderr
