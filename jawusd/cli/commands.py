"""The commands by name, each loaded with its module when it is first asked for: a run pays for the command it runs."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Protocol, cast

import typer
from typer.core import TyperCommand, TyperGroup

from jawusd.cli.command import CONTEXT, Command
from jawusd.cli.summaries import SUMMARIES

_NAMES = {
    "start_commands": ("init", "doctor", "cameras"),
    "build_commands": ("build", "track", "fit", "bake", "demo", "build-many"),
    "capture_commands": ("check", "calibrate", "sync", "segment", "scans", "plates"),
    "photo_commands": ("photos",),
    "rig_commands": ("info", "pose", "validate", "ik"),
    "rebake_command": ("rebake",),
    "stage_commands": ("encode", "publish"),
    "animate_command": ("animate",),
    "face_commands": ("arkit-fit", "arkit-table"),
    "solve_commands": ("solve",),
    "live_commands": ("live",),
    "library_commands": ("retarget", "library"),
    "report_commands": ("report", "view"),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}


class _Formatter(Protocol):
    """What typer writes help with."""

    def section(self, name: str) -> AbstractContextManager[None]: ...
    def write_dl(self, rows: Sequence[tuple[str, str]]) -> None: ...


class Commands(TyperGroup):
    """The group of all commands, which lists them without loading them."""

    # typer hands its public Context; the base class in its private copy of click declares that one's.

    def __init__(self, **settings: object) -> None:
        super().__init__(**settings)  # type: ignore[arg-type]  # typer passes them on as they are
        self.commands = _Loaded()  # type: ignore[assignment]  # a mapping that loads what is asked for

    def list_commands(self, ctx: object) -> list[str]:
        """Return the names in the order of `jawusd --help`."""
        return list(SUMMARIES)

    def format_commands(self, ctx: object, formatter: _Formatter) -> None:
        """Write the list of commands with what each does."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, SUMMARIES[name]) for name in SUMMARIES])


class _Loaded(Mapping[str, TyperCommand]):
    """The commands by name; looking one up loads its module."""

    def __init__(self) -> None:
        self._found: dict[str, TyperCommand] = {}

    def __getitem__(self, name: str) -> TyperCommand:
        if name not in self._found:
            self._found[name] = _load(name, _MODULES[name])
        return self._found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(_MODULES)

    def __len__(self) -> int:
        return len(_MODULES)


def _load(name: str, module: str) -> TyperCommand:
    function = getattr(importlib.import_module(f"jawusd.cli.{module}"), name.replace("-", "_"))
    alone = typer.Typer(add_completion=False, rich_markup_mode=None)
    alone.command(name, cls=Command, context_settings=CONTEXT, short_help=SUMMARIES[name])(function)
    return cast(TyperCommand, typer.main.get_command(alone))
