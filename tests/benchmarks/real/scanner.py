"""Files of real scanners: read, told apart into crown and gum, and the patients' rows as the photographs close them."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import patients
from report import Origin, saved, table, title
from sources import PATIENTS, SCANNER

from jawusd.base.errors import MissingDependencyError
from jawusd.formats.mesh import GUM, Mesh
from jawusd.meshes.meshio import load_mesh
from jawusd.meshes.scan_labels import label_scan

ORIGIN = Origin(
    f"`{SCANNER.repository}` TestData, `{PATIENTS.repository}` demo/ref_mesh",
    f"{SCANNER.licence}; {PATIENTS.licence}",
    "scanner",
)
CASTS = ("real-world/scan_012.dcm", "real-world/scan_039.dcm", "real-world/scan_040.dcm", "Scan-01/Scan.dcm")


def run(data: Path, out: Path) -> None:
    """Print what is read and labelled, with pictures."""
    title("Files of real scanners", ORIGIN)
    header = ("file", "vertices", "faces", "extent [mm]", "crown, share", "weak border, share", "seconds")
    table(header, (row(name, path, out) for name, path in files(data).items()), ORIGIN)


def files(data: Path) -> dict[str, Path]:
    """Return the scans by what they are called in the table."""
    casts = {name: SCANNER.found(data) / "TestData" / name for name in CASTS}
    meshes = PATIENTS.found(data) / "demo" / "ref_mesh"
    for patient in (0, 1):
        for arch in patients.ROWS:
            casts[f"patient {patient}, {arch.lower()}"] = meshes / str(patient) / f"Ref_{arch}_Mesh_Tag={patient}.obj"
    return casts


def row(name: str, path: Path, out: Path) -> list[str]:
    """Return the row of a scan, and write a picture of its labels."""
    begun = time.process_time()
    try:
        mesh = load_mesh(path)
    except MissingDependencyError as error:
        return [name, str(error), *["-"] * 5]
    found = label_scan(mesh, None)
    taken = time.process_time() - begun
    crown = found.labels != GUM
    picture(out / f"scan_{path.stem}.png", mesh, crown, found.up)
    extent = " x ".join(f"{value:.0f}" for value in np.sort(np.ptp(mesh.vertices, axis=0))[::-1])
    told = (f"{crown.mean():.2f}", f"{found.weak_share:.2f}", f"{taken:.0f}")
    return [name, str(len(mesh.vertices)), str(len(mesh.faces)), extent, *told]


def picture(path: Path, mesh: Mesh, crown: np.ndarray, up: np.ndarray) -> None:
    """Draw the vertices seen from where the other row is, crown bright and gum red, lower ones first."""
    import matplotlib.pyplot as plt

    axes = np.linalg.svd(np.eye(3) - np.outer(up, up))[0][:, :2]
    order = np.argsort(mesh.vertices @ up)
    flat = mesh.vertices[order] @ axes
    figure, drawing = plt.subplots(figsize=(5, 5), layout="constrained")
    drawing.scatter(*flat.T, s=0.5, c=np.where(crown[order], "#d8c9a0", "#b04040"), linewidths=0)
    drawing.set_aspect("equal")
    saved(figure, path)
