"""Hand out what runs inside other programs: the Blender extension as one zip, the scripts as files."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

_HERE = Path(__file__).parent
_SCRIPTS = ("jawusd_reader.py", "jawusd_recipes.py", "blender_nodes.py")
# one fixed time: equal sources give equal bytes
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)


def build_extension(out: Path) -> Path:
    """Write the zip that Blender's "Install from Disk" takes (4.2 and later).

    Returns:
        The file.

    Raises:
        OSError: it cannot be written.
    """
    sources = [*sorted((_HERE / "blender").glob("*.py")), _HERE / "blender" / "blender_manifest.toml"]
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for source in [*sources, _HERE / "jawusd_reader.py"]:
            archive.writestr(zipfile.ZipInfo(source.name, _ZIP_TIME), source.read_bytes(), zipfile.ZIP_DEFLATED)
    return out


def copy_scripts(folder: Path) -> list[Path]:
    """Copy the reader, and the scripts that need nothing but it, into a folder; made if missing.

    Returns:
        The files.

    Raises:
        OSError: they cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return [Path(shutil.copyfile(_HERE / name, folder / name)) for name in _SCRIPTS]
