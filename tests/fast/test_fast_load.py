"""`jawusd.load(..., fast=True)`, with numba and without."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from example_model import example_arrays, example_meta

import jawusd
from jawusd.evaluator.kernels import NumpyKernels

# refuses numba as an interpreter without it does
WITHOUT_NUMBA = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "numba":
            raise ModuleNotFoundError("No module named 'numba'", name="numba")
sys.meta_path.insert(0, Refuse())
import jawusd
"""


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.npz"
    np.savez(path, **example_arrays(), meta=json.dumps(example_meta()))
    return path


def run(code, *arguments):
    return subprocess.run(
        [sys.executable, "-c", WITHOUT_NUMBA + code, *map(str, arguments)],
        capture_output=True,
        text=True,
        env=dict(os.environ),
    )


def test_fast_gives_a_compiled_rig_and_plain_does_not(model):
    from jawusd.fast.kernels import CompiledKernels  # compiles, which not every process that collects tests need do

    fast, plain = jawusd.load(model, fast=True), jawusd.load(model)
    assert type(fast.kernels) is CompiledKernels and type(plain.kernels) is NumpyKernels
    np.testing.assert_allclose(fast.pose([20.0, 1.0, 1.0]), plain.pose([20.0, 1.0, 1.0]), atol=1e-10)


def test_without_numba_one_error_names_the_command(model):
    code = (
        "from jawusd.base.errors import MissingDependencyError\n"
        "try:\n"
        "    jawusd.load(sys.argv[1], fast=True)\n"
        "except MissingDependencyError as error:\n"
        "    print(error)\n"
    )
    done = run(code, model)
    assert done.returncode == 0, done.stderr
    assert "numba" in done.stdout and "pip install 'jawusd[fast]'" in done.stdout


def test_without_numba_the_plain_rig_loads(model):
    done = run("print(jawusd.load(sys.argv[1]).pose([0.0, 0.0, 0.0]).shape)", model)
    assert done.stdout.strip() == "(4, 4)", done.stderr
