"""Register the codeless schema JawRigAPI with OpenUSD.

It gives documentation, slider limits and type checks. Reading and writing rigs never depends on it: attributes are read
by name, and the applied schema from the raw `apiSchemas` metadata.
"""

from __future__ import annotations

import warnings

from pxr import Plug, Usd

from jawusd.base.plugin_path import schema_folder

SCHEMA_NAME = "JawRigAPI"


def register_schema() -> bool:
    """Register the schema with OpenUSD, once or more, and return whether this process knows it.

    OpenUSD builds its schema registry when a process first uses a stage; a plugin registered later stays unknown
    (OpenUSD issue 3596), which is a warning.
    """
    folder = schema_folder()
    if folder is not None:
        Plug.Registry().RegisterPlugins(str(folder))
    live = schema_is_live()
    if folder is not None and not live:
        message = f"{SCHEMA_NAME} stays unknown to OpenUSD: a stage was opened before. Import jawusd first, or set "
        warnings.warn(f"{message}PXR_PLUGINPATH_NAME={folder}. Rigs are read and written all the same.", stacklevel=2)
    return live


def schema_is_live() -> bool:
    """Return whether this process knows JawRigAPI; the call freezes the schema registry of the process."""
    return Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(SCHEMA_NAME) is not None


def has_jaw_api(prim: Usd.Prim) -> bool:
    """Return whether a prim carries JawRigAPI, whether or not this process knows the schema."""
    applied = prim.GetMetadata("apiSchemas")
    return applied is not None and SCHEMA_NAME in applied.GetAddedOrExplicitItems()


def rig_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Return the active prims of a stage that carry JawRigAPI, those inside instances too, loaded or not."""
    found = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsDefined & ~Usd.PrimIsAbstract)
    return [prim for prim in stage.Traverse(found) if has_jaw_api(prim)]
