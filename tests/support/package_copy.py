"""Copy the package aside and run checks on the copy, so that guards can be shown planted violations."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def copy_package(folder: Path) -> Path:
    """Copy pyproject.toml and the package into a folder and return it."""
    shutil.copytree(ROOT / "jawusd", folder / "jawusd", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def run_python(folder: Path, code: str) -> subprocess.CompletedProcess:
    """Run code in a fresh interpreter that imports the package from the folder."""
    env = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=env, capture_output=True, text=True, timeout=120, check=False
    )
