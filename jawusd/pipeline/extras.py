"""Import optional stages, with one clear error when their packages are not installed."""

from __future__ import annotations

import importlib
from types import ModuleType

from jawusd.errors import MissingDependencyError

_EXTRA_OF = {
    "jawusd.imaging": "build",
    "jawusd.capture": "build",
    "jawusd.segmentation": "build",
    "jawusd.tracking": "build",
    "jawusd.fitting": "build",
    "jawusd.rig": "build",
    "jawusd.report": "build",
    "jawusd.synthetic": "demo",
    "jawusd.viewer": "view",
    "jawusd.pipeline": "many",
}


def stage(module: str) -> ModuleType:
    """Import a module of an optional stage.

    Args:
        module: dotted name below `jawusd`.

    Raises:
        MissingDependencyError: a package of its extra is not installed; names the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] == "jawusd":
            raise
        extra = _EXTRA_OF[".".join(module.split(".")[:2])]
        raise MissingDependencyError(
            f'{module} needs the package "{error.name}", which is not installed.',
            hint=f"Install it with: pip install 'jawusd[{extra}]'",
        ) from error
