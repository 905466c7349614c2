"""Register the codeless schema JawRigAPI with OpenUSD.

It gives documentation, slider limits and type checks. Reading and writing rigs never depends on it: attributes are read
by name, and the applied schema from the raw `apiSchemas` metadata.
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
    """Register the schema with OpenUSD, once or more, and return whether this process knows it.

    OpenUSD builds its schema registry when a process first uses a stage; a plugin registered later stays unknown
    (OpenUSD issue 3596).
    """
    folder = schema_folder()
    if folder is not None:
        Plug.Registry().RegisterPlugins(str(folder))
    return schema_is_live()


def schema_is_live() -> bool:
    """Return whether this process knows JawRigAPI; the call freezes the schema registry of the process."""
    return Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(SCHEMA_NAME) is not None


def has_jaw_api(prim: Usd.Prim) -> bool:
    """Return whether a prim carries JawRigAPI, whether or not this process knows the schema."""
    applied = prim.GetMetadata("apiSchemas")
    return applied is not None and SCHEMA_NAME in applied.GetAddedOrExplicitItems()
