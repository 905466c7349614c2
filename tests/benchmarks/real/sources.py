"""Which repositories hold the data, where they lie, and under which licence: none of it is part of the project."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Source:
    """Describe a repository: `folder` is its name below --data, `needs` a file that must be in it."""

    folder: str
    repository: str
    licence: str
    used_for: str
    needs: str

    def found(self, data: Path) -> Path:
        """Return its folder.

        Raises:
            SystemExit: it is not below the folder of data; says what to clone.
        """
        folder = data / self.folder
        if not (folder / self.needs).exists():
            where = folder if not folder.is_dir() else folder / self.needs
            clone = f"git clone https://github.com/{self.repository} {folder}"
            raise SystemExit(f"{where} is missing; get it with: {clone}")
        return folder


OPTOTRAK = Source(
    "optotrak",
    "paulgribble/optotrak",
    "none given: figures only",
    "3,000 frames of speech, four markers each on head and jaw; a clench; the maker's own poses",
    "plgrigid/dms1.asc",
)
CHEWING = Source(
    "artisynth-chewing-env",
    "aaltolab/artisynth-chewing-env",
    "MIT",
    "401 frames of chewing, three markers of the jaw at 50 Hz",
    "XML_Processing/Marker1_Traj.txt",
)
PATIENTS = Source(
    "3D-Teeth-Reconstruction-from-Five-Intra-oral-Images",
    "SJTUzhou/3D-Teeth-Reconstruction-from-Five-Intra-oral-Images",
    "MIT",
    "two patients: photographs, drawn outlines, crowns from scans",
    "seg/valid/label/0-0.png",
)
SCANNER = Source(
    "Open3SDCM",
    "Nosenzor/Open3SDCM",
    "Boost 1.0",
    "3Shape scans (DCM) of real casts",
    "TestData/real-world/scan_012.dcm",
)
SOURCES = (OPTOTRAK, CHEWING, PATIENTS, SCANNER)


def listing() -> str:
    """Return the repositories as a Markdown table, and how to clone them."""
    rows = ["| folder | repository | licence | holds |", "|---|---|---|---|"]
    rows += [f"| `{one.folder}` | `{one.repository}` | {one.licence} | {one.used_for} |" for one in SOURCES]
    commands = [f"git clone https://github.com/{one.repository} DIR/{one.folder}" for one in SOURCES]
    return "\n".join([*rows, "", *commands])
