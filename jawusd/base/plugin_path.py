"""Register the codeless schema JawRigAPI with OpenUSD, which searches its plugin path only once."""

from __future__ import annotations

import os
import sys
from pathlib import Path

#: The environment variable with OpenUSD's plugin path.
VARIABLE = "PXR_PLUGINPATH_NAME"

_PACKAGE = Path(__file__).parents[1]
# In a wheel the files are inside the package; in an editable install or checkout, in the repository's `schemas`.
_FOLDERS = (_PACKAGE / "rig" / "schemas", _PACKAGE.parent / "schemas")


def schema_folder() -> Path | None:
    """Return the folder with plugInfo.json and generatedSchema.usda, or None if they are not installed."""
    return next((folder for folder in _FOLDERS if (folder / "plugInfo.json").is_file()), None)


def announce_schema() -> None:
    """Make the schema known to OpenUSD: through the environment before it is loaded, through its registry afterwards.

    Does not load OpenUSD. Child processes inherit the environment.
    """
    folder = schema_folder()
    if folder is None:
        return
    named = [part for part in os.environ.get(VARIABLE, "").split(os.pathsep) if part]
    if str(folder) not in named:
        os.environ[VARIABLE] = os.pathsep.join([*named, str(folder)])
    loaded = sys.modules.get("pxr.Plug")
    if loaded is not None:
        loaded.Registry().RegisterPlugins(str(folder))
