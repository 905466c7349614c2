"""Format versions: refuse newer rigs, upgrade older ones.

A new version of the format takes four steps: raise `layout.FORMAT_VERSION`; write here the upgrade from the version
before it, `STEPS[2]` from 2 to 3, which derives a prim's new attributes from its old ones; let
`tests/golden/make_golden_rig.py` write golden rigs of the new version beside the old ones, which the tests upgrade; do
the same in `plugins/jawusd_reader.py`. Files are never rewritten: `jawusd bake` on the model gives a rig of the present
version.
"""

from __future__ import annotations

from collections.abc import Callable

from pxr import Sdf, Usd

from jawusd.base.errors import FormatError, VersionError
from jawusd.rig.arrays import read_value
from jawusd.rig.layout import FORMAT_VERSION


def _to_2(prim: Usd.Prim) -> None:
    """Name the tolerance of measured poses, which version 1 held as the smallest margin of a valid pose.

    What else version 2 adds a rig may lack: the table of the glide surface and the clearances of the teeth.
    """
    limit = read_value(prim, "jaw:thresholds:margin", prim.GetStage().GetRootLayer().identifier)
    if not isinstance(limit, float):
        raise FormatError(f"jaw:thresholds:margin is {limit!r}, expected a number.", path=str(prim.GetPath()))
    tolerance = prim.CreateAttribute("jaw:thresholds:tolerance", Sdf.ValueTypeNames.Double)
    tolerance.Set(-limit)


STEPS: dict[int, Callable[[Usd.Prim], None]] = {1: _to_2}


def upgrade_rig(prim: Usd.Prim, where: object) -> None:
    """Check the version of a rig prim and upgrade an older one.

    The new attributes are authored in the session layer of the prim's stage: in memory, stronger than the files, never
    in them.

    Raises:
        FormatError: The version is not a positive whole number.
        VersionError: It is newer than this jawusd.
    """
    version = read_value(prim, "jaw:formatVersion", where)
    if not isinstance(version, int) or version < 1:
        raise FormatError(f"jaw:formatVersion is {version!r}, expected a whole number from 1.", path=str(where))
    if version > FORMAT_VERSION:
        raise VersionError(
            f"the rig has format version {version}, this jawusd reads up to {FORMAT_VERSION}.",
            path=str(where),
            hint="Update jawusd.",
        )
    stage = prim.GetStage()
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for step in range(version, FORMAT_VERSION):
            STEPS[step](prim)
            prim.GetAttribute("jaw:formatVersion").Set(step + 1)


def was_upgraded(prim: Usd.Prim) -> bool:
    """Return whether `upgrade_rig` changed a rig prim: hashes in its files are those of its values before."""
    path = prim.GetPath().AppendProperty("jaw:formatVersion")
    return prim.GetStage().GetSessionLayer().GetAttributeAtPath(path) is not None
