"""When a build was made, by which command line and with which versions."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata

from jawusd.base.version import __version__
from jawusd.formats.report import Origin

_PACKAGES = ("numpy", "scipy", "numba", "usd-core", "opencv-contrib-python-headless", "av")


def origin_now(command: str) -> Origin:
    """Return the origin of what is made now by a command line, "" where there is none."""
    return Origin(datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"), command, package_versions())


def recorded_origin(result: Mapping[str, object]) -> Origin:
    """Return the origin that the report stage of a build recorded; an empty one where an earlier version did not."""
    found = result.get("origin")
    if not isinstance(found, dict):
        return Origin("", "", {})
    versions = found.get("versions")
    named = {str(name): str(version) for name, version in versions.items()} if isinstance(versions, dict) else {}
    return Origin(str(found.get("finished", "")), str(found.get("command", "")), named)


def package_versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of the packages that results depend on."""
    found = {"jawusd": __version__, "Python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
