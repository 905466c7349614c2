"""Make the codeless schema JawRigAPI known to OpenUSD.

Knowing it gives documentation, slider limits and type checks. Reading and writing rigs never depends on it: attributes
are taken by name, and the applied schema from the raw `apiSchemas` metadata.
"""

from __future__ import annotations

from pathlib import Path

from pxr import Plug, Usd

SCHEMA_NAME = "JawRigAPI"

# In a wheel the files lie inside the package; in an editable install and a checkout, in the repository's `schemas`.
_FOLDERS = (Path(__file__).parent / "schemas", Path(__file__).parents[2] / "schemas")


def schema_folder() -> Path | None:
    """Return the folder that holds plugInfo.json and generatedSchema.usda, or None if they are not installed."""
    return next((folder for folder in _FOLDERS if (folder / "plugInfo.json").is_file()), None)


def register_schema() -> bool:
    """Register the schema with OpenUSD and say whether it is live.

    OpenUSD builds its schema registry when a process first uses a stage; a plugin registered later stays unknown
    (OpenUSD issue 3596). Registering twice does no harm.

    Returns:
        True if prims can be asked about JawRigAPI in this process.
    """
    folder = schema_folder()
    if folder is not None:
        Plug.Registry().RegisterPlugins(str(folder))
    return schema_is_live()


def schema_is_live() -> bool:
    """Return whether this process knows JawRigAPI. Asking fixes the schema registry of the process."""
    return Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(SCHEMA_NAME) is not None


def has_jaw_api(prim: Usd.Prim) -> bool:
    """Return whether a prim carries JawRigAPI, whatever this process knows of the schema."""
    applied = prim.GetMetadata("apiSchemas")
    return applied is not None and SCHEMA_NAME in applied.GetAddedOrExplicitItems()
