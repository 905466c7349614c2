"""The evaluator runs where there is nothing but numpy: checked in fresh interpreters."""

import os
import subprocess
import sys
from pathlib import Path

import jawusd

ROOT = Path(jawusd.__file__).parents[1]

PROBE = """
import sys
before = set(sys.modules)
import jawusd.evaluator
loaded = {name.partition(".")[0] for name in set(sys.modules) - before}
third_party = sorted(loaded - set(sys.stdlib_module_names) - {"jawusd"})
print(" ".join(third_party))
print(" ".join(sorted(name for name in sys.modules if name.startswith("jawusd."))))
"""

# refuses every import that is neither the standard library, numpy nor jawusd's own
NUMPY_ONLY = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in sys.stdlib_module_names and top not in ("numpy", "jawusd", "example_model"):
            raise ImportError(f"{name} is not installed here")
sys.meta_path.insert(0, Refuse())
"""


def run(code, *arguments):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(Path(__file__).parents[1] / "support")])}
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, env=environment)


def test_import_loads_nothing_third_party_but_numpy():
    done = run(PROBE)
    assert done.returncode == 0, done.stderr
    third_party, own = done.stdout.splitlines()
    assert third_party == "numpy"
    layers = {name.split(".")[1] for name in own.split()}
    assert layers == {"base", "evaluator", "geometry"}


def test_the_probe_sees_a_planted_import():
    """The probe itself works: with scipy imported along the way it reports scipy."""
    done = run(PROBE.replace("import jawusd.evaluator\n", "import jawusd.evaluator, scipy\n"))
    assert "scipy" in done.stdout.splitlines()[0].split()


def test_a_rig_works_where_only_numpy_can_be_imported():
    code = NUMPY_ONLY + (
        "from example_model import example_arrays, example_meta\n"
        "from jawusd.evaluator import JawRig\n"
        "rig = JawRig(example_arrays(), example_meta())\n"
        "T = rig.pose([[20.0, 2.0, 1.0]])\n"
        "d, _ = rig.encode(T, inside=True)\n"
        "assert rig.validate(T).valid.all()\n"
        "rig.ik([0, 0, 0], [1, 2, 3]); rig.interpolate([0, 1], [[0, 0, 0], [5, 0, 0]], 0.5, 'smooth')\n"
        "print(abs(d - [20.0, 2.0, 1.0]).max() < 1e-8)\n"
    )
    done = run(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "True"
    assert run(NUMPY_ONLY + "import scipy\n").returncode != 0


def test_the_package_offers_its_names_and_loads_them_when_used():
    code = (
        "import sys, jawusd\n"
        "print(*dir(jawusd))\n"
        "print(*sorted(name for name in sys.modules if name.startswith('jawusd.')), 'numpy' in sys.modules)\n"
        "print(jawusd.JawRig.__name__, jawusd.JawusdError.__name__, 'pxr' in sys.modules)\n"
    )
    done = run(code)
    assert done.stdout.splitlines() == [
        "JawRig JawusdError __version__ align build fit_skin load load_skin save_skin track",
        "jawusd.base jawusd.base.plugin_path jawusd.base.version False",
        "JawRig JawusdError False",
    ], done.stderr
    assert callable(jawusd.build) and callable(jawusd.track)
    assert not hasattr(jawusd, "unheard_of")
