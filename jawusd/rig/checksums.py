"""Checksums of the binary layers of a rig, in `actor.usda`: damage is found before OpenUSD reads them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from pxr import Sdf

from jawusd.base.errors import RigError
from jawusd.rig.asset_paths import file_of_layer

#: Key in `customLayerData` of `actor.usda`: a dictionary of file names beside it and SHA-256 sums.
CHECKSUMS = "sha256"


def record_checksums(layer: Sdf.Layer, folder: Path, names: Iterable[str]) -> None:
    """Record in a layer in memory the checksums of files in the folder that it will be written to."""
    sums = {name: _sum(folder / name) for name in names}
    layer.customLayerData = {**layer.customLayerData, CHECKSUMS: sums}


def recorded_checksums(layer: Sdf.Layer) -> dict[Path, str]:
    """Return the checksums that a layer records, by file; none of rigs written before there were any."""
    sums = layer.customLayerData.get(CHECKSUMS)
    folder = file_of_layer(layer).resolve().parent
    return {folder / name: str(value) for name, value in sums.items()} if isinstance(sums, dict) else {}


def check_checksum(file: Path, wanted: str) -> None:
    """Compare a file with its checksum.

    Raises:
        RigError: It is another file than the one recorded.
    """
    if _sum(file) != wanted:
        raise RigError(
            "is damaged, or was changed since the rig was written: its checksum is not that in the rig.",
            path=file,
            hint="Copy it again from where it is whole, or build the rig again. If it was changed on purpose, remove "
            f"{CHECKSUMS} from customLayerData in the rig's text layer.",
        )


def _sum(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
