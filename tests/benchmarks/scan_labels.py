"""How far the line between crown and gum, found from the shape of scans alone, lies from their paint.

    python tests/benchmarks/scan_labels.py [--persons 64] [--capture FOLDER ...]

Takes the paint off the scans of synthetic persons, and of captures with painted scans. A scan's distance is the mean
over both lines of the distance to the other one; "pieces" are scans whose crowns are separate from their gum, "surface"
those where both share one.
"""

import argparse
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from subjects.short_capture import ShortConfig, draw_capture

from jawusd.formats.capture import load_capture
from jawusd.formats.mesh import Mesh, tooth_labels
from jawusd.meshes.meshio import load_mesh
from jawusd.meshes.scan_labels import Labelling, label_scan
from jawusd.meshes.scan_surface import ScanSurface
from jawusd.pipeline.subject import _WEAK_SHARE

NEVER_MM = 20.0  # counted for a line that was not found


def line(surface: ScanSurface, crown: np.ndarray) -> np.ndarray:
    edges = surface.edges()
    return surface.vertices[edges[crown[edges[:, 0]] != crown[edges[:, 1]]]].mean(axis=1)


def border_mm(mesh: Mesh, found: Labelling) -> tuple[float, float]:
    """Return the distance of the lines [mm] and the share of vertices with the wrong label."""
    surface = ScanSurface.of(mesh)
    masks = []
    for labels in (tooth_labels(mesh), found.labels):
        mask = np.zeros(len(surface.vertices), dtype=bool)
        mask[surface.of_vertex[labels > 0]] = True
        masks.append(mask)
    wrong = float((masks[0] != masks[1]).mean())
    one, two = (line(surface, mask) for mask in masks)
    if len(one) < 50:  # separate pieces share no edges; a few wrong scraps are no line
        return (0.0 if wrong < 0.01 else NEVER_MM), wrong
    if not len(two):
        return NEVER_MM, wrong
    return float((cKDTree(one).query(two)[0].mean() + cKDTree(two).query(one)[0].mean()) / 2), wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--persons", type=int, default=64)
    parser.add_argument("--capture", nargs="*", default=[])
    options = parser.parse_args()
    rows = defaultdict(list)

    def measure(kind: str, name: str, scans: list[Mesh]) -> None:
        for mesh, other in ((scans[0], scans[1]), (scans[1], scans[0])):
            start = time.perf_counter()
            found = label_scan(Mesh(mesh.vertices, mesh.faces), other.vertices.mean(axis=0))
            seconds = time.perf_counter() - start
            far, wrong = border_mm(mesh, found)
            rows[kind].append((far, wrong, found.weak_share > _WEAK_SHARE, seconds))
            if far > 0.3:
                print(f"{name}: {len(mesh.faces)} faces, {far:.2f} mm, {100 * wrong:.1f} % wrong")

    for seed in range(options.persons):
        drawn = draw_capture(ShortConfig(seed))
        kind = "surface" if drawn.traits.gums == "continuous" else "pieces"
        measure(kind, f"person {seed}", list(drawn.scans))
    for folder in options.capture:
        scans = load_capture(folder).scans
        measure("captures", folder, [load_mesh(scans.upper_teeth), load_mesh(scans.lower_teeth)])
    print("scans      number  median   p95 [mm]  over 0.3 mm (of these doubted)  doubted below 0.3 mm   slowest [s]")
    for kind, found in rows.items():
        far, _, doubted, seconds = np.array(found, dtype=float).T
        bad = far > 0.3
        print(
            f"{kind:10} {len(far):6} {np.median(far):7.3f} {np.percentile(far, 95):10.3f} {bad.sum():12} "
            f"({int(doubted[bad].sum())}) {int(doubted[~bad].sum()):30} {seconds.max():18.1f}"
        )


if __name__ == "__main__":
    main()
