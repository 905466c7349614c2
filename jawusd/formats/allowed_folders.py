"""Folders that stages may name files in, beside their own: libraries of actors, shared textures."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextvars import ContextVar
from pathlib import Path

#: Environment variable that allows folders in every run, separated as in PATH.
SETTING = "JAWUSD_ALLOW"

_given: ContextVar[tuple[Path, ...]] = ContextVar("allowed_folders", default=())


def allow_folders(folders: Iterable[str | os.PathLike[str]]) -> None:
    """Allow folders, and those below them, instead of any allowed before; those of the setting stay allowed."""
    _given.set(tuple(Path(folder).resolve() for folder in folders))


def allowed_folders() -> list[Path]:
    """Return the folders that are allowed, links resolved."""
    named = [Path(folder).resolve() for folder in os.environ.get(SETTING, "").split(os.pathsep) if folder]
    return [*_given.get(), *named]


def is_allowed(path: Path) -> bool:
    """Tell whether a file lies in an allowed folder, with links resolved."""
    return any(path.resolve().is_relative_to(folder) for folder in allowed_folders())
