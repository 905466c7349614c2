"""The rig as OpenUSD: authoring, reading, animation, validation, ONNX sidecars.

Modules are loaded when one of their names is first used; only `bake` and the `onnx_*` modules need the package onnx.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING

from jawusd.rig.layout import register_schema, schema_is_live

if TYPE_CHECKING:
    from jawusd.base.inputs import allow_folders
    from jawusd.rig.animation import write_animation, write_splines
    from jawusd.rig.read import describe, load_rig
    from jawusd.rig.validate import Finding, find_nvidia_validator, nvidia_findings, register_validators, validate_stage

__all__ = [
    "Finding",
    "allow_folders",
    "describe",
    "find_nvidia_validator",
    "load_rig",
    "nvidia_findings",
    "register_schema",
    "register_validators",
    "schema_is_live",
    "validate_stage",
    "write_animation",
    "write_splines",
]

_MODULES = {
    "Finding": "jawusd.rig.validate",
    "allow_folders": "jawusd.base.inputs",
    "describe": "jawusd.rig.read",
    "find_nvidia_validator": "jawusd.rig.validate",
    "load_rig": "jawusd.rig.read",
    "nvidia_findings": "jawusd.rig.validate",
    "register_validators": "jawusd.rig.validate",
    "validate_stage": "jawusd.rig.validate",
    "write_animation": "jawusd.rig.animation",
    "write_splines": "jawusd.rig.animation",
}

# Disables onnxruntime's telemetry: onnxruntime reads this variable when it is loaded.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
# Registered at import time, because OpenUSD ignores schemas that are registered after the first stage was opened.
register_schema()


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'jawusd.rig' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
