"""jawusd: capture in, jaw rig out.

Importing this package loads no heavy modules; they are loaded when names that need them are first used. The import
tells OpenUSD where to find the schema `JawRigAPI` (`jawusd info --schema`).
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING

from jawusd.base.plugin_path import announce_schema
from jawusd.base.version import __version__

if TYPE_CHECKING:
    from os import PathLike

    from jawusd.base.errors import JawusdError
    from jawusd.evaluator import JawRig
    from jawusd.evaluator.skin import load_skin
    from jawusd.fitting.align import align
    from jawusd.fitting.skin import fit_skin, save_skin
    from jawusd.pipeline.build import build
    from jawusd.pipeline.track import track

__all__ = [
    "JawRig",
    "JawusdError",
    "__version__",
    "align",
    "build",
    "fit_skin",
    "load",
    "load_skin",
    "save_skin",
    "track",
]

_MODULES = {
    "JawRig": "jawusd.evaluator",
    "JawusdError": "jawusd.base.errors",
    "align": "jawusd.fitting.align",
    "build": "jawusd.pipeline.build",
    "fit_skin": "jawusd.fitting.skin",
    "load_skin": "jawusd.evaluator.skin",
    "save_skin": "jawusd.fitting.skin",
    "track": "jawusd.pipeline.track",
}


announce_schema()


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'jawusd' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__


def load(path: str | PathLike[str], *, prim: str | None = None, fast: bool = False, untrusted: bool = False) -> JawRig:
    """Load a rig for posing, validation and inverse kinematics.

    Args:
        path: Folder of a rig, its `actor.usda` (or any layer or package that carries the rig), a `model.npz`, or its
            `actor.onnx`, alone: then onnxruntime computes poses and judges them, in single precision.
        prim: Path of the rig's prim, where a stage holds several; a `.onnx` holds one rig.
        fast: Compile the most used functions with numba: the same results to 1e-10, several times faster. Needs
            `pip install 'jawusd[fast]'`; the first use after an installation compiles for about a minute.
        untrusted: Read the file in a second Python with limits of memory and time, some 0.5 s: a file that crashes
            OpenUSD is then an error, and does not end this program.

    Raises:
        FormatError: the file is not a rig, is incomplete, or was written by a newer version.
        RigError: the stage cannot be opened.
        ResourceError: there is not enough memory.
        MissingDependencyError: ``fast`` without numba, a `.onnx` without onnxruntime.
        ValueError: ``fast`` or ``untrusted`` with a `.onnx`.
    """
    if str(path).endswith(".onnx"):
        if fast or untrusted:
            raise ValueError("a .onnx runs in onnxruntime, in this process: fast and untrusted are for other files")
        from jawusd.rig.onnx_rig import load_onnx

        return load_onnx(path, prim)
    if untrusted:
        from jawusd.rig.separate import load_separately

        rig = load_separately(Path(path), prim)
    elif str(path).endswith(".npz"):
        from jawusd import evaluator

        rig = evaluator.load(path)
    else:
        from jawusd.rig import load_rig
        from jawusd.rig.layout import actor_in_folder

        rig = load_rig(actor_in_folder(Path(path)), prim)
    if not fast:
        return rig
    from jawusd.fast import accelerate

    return accelerate(rig)
