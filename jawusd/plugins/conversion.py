"""Convert FBX and glTF files to USD stages through Blender, in a separate process."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

from jawusd.base.errors import AnyPath, FormatError, MissingDependencyError
from jawusd.base.inputs import check_input
from jawusd.formats.gltf import frame_rate

#: Suffixes of the files that Blender converts.
SUFFIXES = (".fbx", ".glb", ".gltf")
#: Name of the environment variable with the path of Blender, or of a Python with `bpy`.
SETTING = "JAWUSD_BLENDER"

_SCRIPT = Path(__file__).with_name("blender_convert.py")
_TIMEOUT_S = 900


def converted(path: AnyPath, folder: AnyPath, fps: float) -> Path:
    """Convert an .fbx, .glb or .gltf file to a USD stage in a folder; time 0 becomes frame 0.

    `fps` is the frame rate for files that do not contain one, such as glTF files of other programs.

    Raises:
        MissingDependencyError: Blender is not installed.
        FormatError: Blender cannot read the file.
    """
    path, target = Path(path), Path(folder) / f"{Path(path).stem}.usdc"
    check_input(path)
    if not path.is_file():
        raise FormatError("there is no such file.", path=path)
    command = [*_blender(path), "--", str(path.resolve()), str(target), repr(frame_rate(path) or fps)]
    # The OpenUSD plugins of this process are incompatible with Blender's OpenUSD.
    environment = {name: value for name, value in os.environ.items() if name != "PXR_PLUGINPATH_NAME"}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, env=environment, check=False)
        output = done.stderr or done.stdout
    except OSError as error:
        raise MissingDependencyError(f"{command[0]} cannot be run ({error.strerror}).", hint=_hint()) from error
    except subprocess.TimeoutExpired as error:
        raise FormatError(f"Blender did not finish in {_TIMEOUT_S} s.", path=path) from error
    if "No module named 'bpy'" in output:
        raise MissingDependencyError(f"{command[0]} is neither Blender nor a Python with bpy.", hint=_hint())
    if done.returncode or not target.is_file():
        last = (output.strip().splitlines() or ["no output"])[-1]
        raise FormatError(f"Blender cannot read it ({last:.200}).", path=path)
    return target


def _blender(path: Path) -> list[str]:
    """Return the command that runs the script in Blender."""
    named = os.environ.get(SETTING) or shutil.which("blender")
    if not os.environ.get(SETTING) and importlib.util.find_spec("bpy") is not None:
        named = sys.executable
    if not named:
        raise MissingDependencyError(
            "FBX and glTF are read through Blender, which was not found.", path=path, hint=_hint()
        )
    if Path(named).stem.lower().startswith("blender"):
        return [named, "--background", "--factory-startup", "--python-exit-code", "1", "--python", str(_SCRIPT)]
    return [named, str(_SCRIPT)]


def _hint() -> str:
    return f"Set {SETTING} to Blender (4.2 or later) or a Python with bpy (`pip install bpy`), or export USD instead."
