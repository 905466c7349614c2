"""Where OpenUSD finds the codeless schema JawRigAPI, set before it is loaded: it looks only once."""

from __future__ import annotations

import os
import sys
from pathlib import Path

#: The environment variable in which OpenUSD looks for plugins.
VARIABLE = "PXR_PLUGINPATH_NAME"

# In a wheel the files lie inside the package; in an editable install and a checkout, in the repository's `schemas`.
_FOLDERS = (Path(__file__).parent / "rig" / "schemas", Path(__file__).parents[1] / "schemas")


def schema_folder() -> Path | None:
    """Return the folder that holds plugInfo.json and generatedSchema.usda, or None if they are not installed."""
    return next((folder for folder in _FOLDERS if (folder / "plugInfo.json").is_file()), None)


def announce_schema() -> None:
    """Let OpenUSD know the schema: by the environment before it is loaded, by its registry afterwards.

    Costs nothing where OpenUSD is never loaded. Programs started from here inherit the environment.
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
