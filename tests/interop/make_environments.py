"""Install the programs that the interop tests run, each in its own environment.

Usage: python tests/interop/make_environments.py FOLDER [NAME ...]
Then run the tests with JAWUSD_INTEROP=FOLDER. Without names, all are installed: 3 GB, of which each Blender takes 1 GB,
in about five minutes, with the pip of the Python that runs this (22.3 or newer). An environment that
fails or takes too long is skipped and named, and the exit code is 1.
"""

import shutil
import subprocess
import sys
import venv
from pathlib import Path

PYTHON_PACKAGES = {
    "blender45": ["bpy==4.5.15"],
    "blender50": ["bpy==5.0.1"],
    "usd2411": ["usd-core==24.11", "numpy"],
    "usd255": ["usd-core==25.5", "numpy"],
    "usd2611": ["usd-core==26.11", "numpy"],
    "tinyusdz": ["tinyusdz==0.9.4", "numpy"],
    "nvidia": ["usd-core==26.11", "numpy<3"],
}
# its own extra pins an older USD; it runs with the newest
WITHOUT_DEPENDENCIES = {"nvidia": ["usd-validation-nvidia==1.22.0"]}
NODE_PACKAGES = {"threejs": ["three@0.187.0"]}


STEP_LIMIT_S = 300


def run(*command):
    """Run one step of an installation."""
    subprocess.run([str(part) for part in command], check=True, timeout=STEP_LIMIT_S)


def make(folder, name):
    """Install one environment."""
    target = folder / name
    if name in NODE_PACKAGES:
        target.mkdir(parents=True, exist_ok=True)
        run("npm", "install", "--silent", "--prefix", target, *NODE_PACKAGES[name])
        return
    venv.create(target)  # without pip: the one of this Python installs into it
    pip = [sys.executable, "-m", "pip", "--python", target / "bin" / "python"]
    pip += ["install", "--quiet", "--disable-pip-version-check"]
    run(*pip, *PYTHON_PACKAGES[name])
    if name in WITHOUT_DEPENDENCIES:
        run(*pip, "--no-deps", *WITHOUT_DEPENDENCIES[name])


def main(folder, names):
    """Install environments; return the names of those that failed."""
    missing = []
    for name in names:
        print(name, flush=True)
        try:
            make(folder, name)
        except (subprocess.SubprocessError, OSError) as error:
            print(f"NOT MADE: {name}: {error}", flush=True)
            shutil.rmtree(folder / name, ignore_errors=True)
            missing.append(name)
    return missing


if __name__ == "__main__":
    sys.exit(1 if main(Path(sys.argv[1]), sys.argv[2:] or [*PYTHON_PACKAGES, *NODE_PACKAGES]) else 0)
