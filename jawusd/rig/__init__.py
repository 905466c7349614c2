"""The rig as OpenUSD: authoring, reading, validation, animation, ONNX sidecar.

`jawusd.rig.bake` and `jawusd.rig.onnx_sidecar` need the package onnx (`jawusd[build]`); nothing else here does.
"""

from jawusd.formats.allowed_folders import allow_folders
from jawusd.rig.animation import write_animation, write_splines
from jawusd.rig.nvidia import find_nvidia_validator, nvidia_findings
from jawusd.rig.read import describe, load_rig
from jawusd.rig.schema import register_schema, schema_is_live
from jawusd.rig.validate import Finding, register_validators, validate_stage

# At import: OpenUSD ignores schemas registered after a process has used its first stage.
register_schema()

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
