"""Validation of USD files: jawusd's rules as UsdValidation validators, and the findings of all, NVIDIA's included."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from pxr import Sdf, Usd

from jawusd.base.errors import AnyPath, RigError
from jawusd.rig.layout import rig_prims
from jawusd.rig.read import open_stage
from jawusd.rig.rules import RULES, Finding, Rule

try:
    from pxr import UsdValidation
except ImportError:  # not available in OpenUSD before 25.02
    UsdValidation = None

PROGRAM = "nvidia_usd_validate"
_TIMEOUT_S = 600
_NVIDIA_SEVERITIES = {"INFO": "info", "WARNING": "warning"}

KEYWORD = "JawUsd"
_PREFIX = "jawusd:"

# UsdValidation accepts validators written in Python since OpenUSD 26.05.
_PLUGGABLE = UsdValidation is not None and hasattr(UsdValidation.ValidationRegistry, "RegisterStageValidator")
_NO_STOCK = "OpenUSD's own validators were not run: they need usd-core 26.5 or newer."


def register_validators() -> bool:
    """Register the rules with UsdValidation, for the whole process; False if this OpenUSD does not accept them."""
    if not _PLUGGABLE:
        return False
    registry = UsdValidation.ValidationRegistry()
    for name, rule in RULES.items():
        if not registry.HasValidator(_PREFIX + name):
            metadata = UsdValidation.ValidatorMetadata(name=_PREFIX + name, doc=rule.__doc__, keywords=[KEYWORD])
            registry.RegisterStageValidator(metadata, _stage_validator(rule))
    return True


def validate_stage(path: AnyPath) -> list[Finding]:
    """Return the findings of UsdValidation and, for rigs, of jawusd's own rules about a USD file.

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
    """Return the rig prims in a stage, one for each prototype that instances share."""
    first: dict[Sdf.Path, Usd.Prim] = {}
    for prim in rig_prims(stage):
        first.setdefault(prim.GetPrimInPrototype().GetPath() if prim.IsInstanceProxy() else prim.GetPath(), prim)
    return list(first.values())


def _severities() -> dict[str, UsdValidation.ValidationErrorType]:
    kinds = UsdValidation.ValidationErrorType
    return {"error": kinds.Error, "warning": kinds.Warn, "info": kinds.Info}


def _stage_validator(rule: Rule) -> Callable[[Usd.Stage, object], list[UsdValidation.ValidationError]]:
    severities = _severities()

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
    severity = next((name for name, kind in _severities().items() if kind == error.GetType()), "error")
    sites = [str(site.GetPrim().GetPath()) for site in error.GetSites() if site.IsValid() and site.GetPrim()]
    return Finding(severity, error.GetName(), sites[0] if sites else "/", error.GetMessage())


def find_nvidia_validator() -> Path | None:
    """Return the path of NVIDIA's validator, next to this Python interpreter or on PATH; None if not installed."""
    found = shutil.which(PROGRAM, path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
    return Path(found) if found else None


def nvidia_findings(path: AnyPath, program: Path) -> list[Finding]:
    """Return the findings of NVIDIA's validator, a program from `find_nvidia_validator`, with its default rules.

    Raises:
        RigError: The program wrote no report.
    """
    with tempfile.TemporaryDirectory() as scratch:
        report = Path(scratch) / "report.json"
        command = [str(program), "--json-output", str(report), str(path)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
        except subprocess.TimeoutExpired as error:
            raise RigError(f"{PROGRAM} did not finish in {_TIMEOUT_S} s.", path=path) from error
        if not report.is_file():
            raise RigError(f"{PROGRAM} wrote no report: {done.stderr.strip()[-300:]}", path=path)
        rules = json.loads(report.read_text(encoding="utf-8")).get("rules", [])
    return [
        Finding(
            _NVIDIA_SEVERITIES.get(issue["severity"], "error"),
            issue["rule"]["name"],
            str(issue["at"] or "/"),
            issue["message"],
        )
        for rule in rules
        for issue in rule["issues"]
    ]
