"""Make the environments of the programs that the interop tests try rigs in.

Usage: python tests/interop/make_environments.py FOLDER [NAME ...]
Then run the tests with JAWUSD_INTEROP=FOLDER. Without names all are made; Blender's take 1 GB each.
"""

import subprocess
import sys
import venv
from pathlib import Path

PYTHON_PACKAGES = {
    "blender45": ["bpy==4.5.15"],
    "blender50": ["bpy==5.0.1"],
    "usd2411": ["usd-core==24.11", "numpy"],
    "usd255": ["usd-core==25.5", "numpy"],
    "tinyusdz": ["tinyusdz==0.9.4", "numpy"],
    "nvidia": ["usd-core==26.11", "numpy<3"],
}
# its own extra pins an older USD; it runs with the newest
WITHOUT_DEPENDENCIES = {"nvidia": ["usd-validation-nvidia==1.22.0"]}
NODE_PACKAGES = {"threejs": ["three@0.187.0"]}


def make(folder, name):
    """Make one environment."""
    target = folder / name
    if name in NODE_PACKAGES:
        target.mkdir(parents=True, exist_ok=True)
        subprocess.run(["npm", "install", "--silent", "--prefix", str(target), *NODE_PACKAGES[name]], check=True)
        return
    venv.create(target, with_pip=True)
    pip = [str(target / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, *PYTHON_PACKAGES[name]], check=True)
    if name in WITHOUT_DEPENDENCIES:
        subprocess.run([*pip, "--no-deps", *WITHOUT_DEPENDENCIES[name]], check=True)


if __name__ == "__main__":
    for wanted in sys.argv[2:] or [*PYTHON_PACKAGES, *NODE_PACKAGES]:
        print(wanted, flush=True)
        make(Path(sys.argv[1]), wanted)
