"""Validation: jawusd's rules as UsdValidation validators, and every finding about a file in one list."""

from __future__ import annotations

import os
from collections.abc import Callable

from pxr import Sdf, Usd

from jawusd.rig.read import open_stage
from jawusd.rig.rules import RULES, Finding, Rule
from jawusd.rig.schema import rig_prims

try:
    from pxr import UsdValidation
except ImportError:  # OpenUSD before 25.02 has no such module
    UsdValidation = None

KEYWORD = "JawUsd"
_PREFIX = "jawusd:"

# UsdValidation takes validators written in Python from OpenUSD 26.05 on.
_PLUGGABLE = UsdValidation is not None and hasattr(UsdValidation.ValidationRegistry, "RegisterStageValidator")
_NO_STOCK = "OpenUSD's own validators were not run: usd-core is older than 26.5."


def register_validators() -> bool:
    """Register the rules with UsdValidation, once per process, so that any tool that validates applies them.

    Returns False if this OpenUSD takes no validators written in Python.
    """
    if not _PLUGGABLE:
        return False
    registry = UsdValidation.ValidationRegistry()
    for name, rule in RULES.items():
        if not registry.HasValidator(_PREFIX + name):
            metadata = UsdValidation.ValidatorMetadata(name=_PREFIX + name, doc=rule.__doc__, keywords=[KEYWORD])
            registry.RegisterStageValidator(metadata, _stage_validator(rule))
    return True


def validate_stage(path: str | os.PathLike[str]) -> list[Finding]:
    """Return the findings of UsdValidation and of jawusd's own rules about any USD file.

    A file without a rig is checked by the stock validators alone.

    Raises:
        RigError: The file cannot be opened.
    """
    stage = open_stage(path)
    if not register_validators():
        found = [finding for prim in _rig_prims(stage) for rule in RULES.values() for finding in rule(prim)]
        broken = [Finding("error", "CompositionError", "/", str(error)) for error in stage.GetCompositionErrors()]
        return [*broken, *found, Finding("info", "Stock", "/", _NO_STOCK)]
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    return [_finding(error) for error in UsdValidation.ValidationContext(validators).Validate(stage)]


def _rig_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Return the prims that carry a rig; of instances that share one, the first."""
    first: dict[Sdf.Path, Usd.Prim] = {}
    for prim in rig_prims(stage):
        first.setdefault(prim.GetPrimInPrototype().GetPath() if prim.IsInstanceProxy() else prim.GetPath(), prim)
    return list(first.values())


def _stage_validator(rule: Rule) -> Callable[[Usd.Stage, object], list[UsdValidation.ValidationError]]:
    severities = {
        "error": UsdValidation.ValidationErrorType.Error,
        "warning": UsdValidation.ValidationErrorType.Warn,
        "info": UsdValidation.ValidationErrorType.Info,
    }

    def validate(stage: Usd.Stage, time_range: object = None) -> list[UsdValidation.ValidationError]:
        return [
            UsdValidation.ValidationError(
                finding.rule,
                severities[finding.severity],
                [UsdValidation.ValidationErrorSite(stage, prim.GetPath())],
                finding.message,
            )
            for prim in _rig_prims(stage)
            for finding in rule(prim)
        ]

    return validate


def _finding(error: UsdValidation.ValidationError) -> Finding:
    severities = {
        UsdValidation.ValidationErrorType.Error: "error",
        UsdValidation.ValidationErrorType.Warn: "warning",
        UsdValidation.ValidationErrorType.Info: "info",
    }
    sites = [str(site.GetPrim().GetPath()) for site in error.GetSites() if site.IsValid() and site.GetPrim()]
    return Finding(
        severities.get(error.GetType(), "error"), error.GetName(), sites[0] if sites else "/", error.GetMessage()
    )
