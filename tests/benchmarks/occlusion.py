"""How often a valid bite is refused or warned of, and how often a wrong one is found, over persons and scanners.

    python tests/benchmarks/occlusion.py --persons 130
    python tests/benchmarks/occlusion.py --persons 14 --faults

Prints how many persons of the population each finding names, the range of every figure that the checks look at, and,
with --faults, what is said of scans that were moved, turned, scaled, mirrored or exchanged.
"""

import argparse
import sys
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from subjects.short_capture import ShortConfig, draw_capture

from jawusd.formats.mesh import Mesh, painted_labels
from jawusd.geometry import anatomical_frame, se3_exp, se3_inverse, transform_points
from jawusd.meshes.scan_labels import label_scan
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.initialization.occlusion import measure_occlusion
from jawusd.tracking.initialization.scan_checks import occlusion_findings

UNPAINTED = 0.3  # share of scanners


def turned(points, degrees):
    """Return points turned about their middle."""
    middle = points.mean(0)
    return (points - middle) @ se3_exp([*np.deg2rad(degrees), 0, 0, 0])[:3, :3].T + middle


# Vertices of both arches in the bite's frame (left, up, front) to those of the wrong bite.
MOVES = {
    "lower 1 mm down": lambda u, v: (u, v - [0, 1.0, 0]),
    "lower 6 mm down": lambda u, v: (u, v - [0, 6.0, 0]),
    "lower 1 mm up": lambda u, v: (u, v + [0, 1.0, 0]),
    "lower 2 mm up": lambda u, v: (u, v + [0, 2.0, 0]),
    "lower 6 mm up": lambda u, v: (u, v + [0, 6.0, 0]),
    "lower 20 mm up": lambda u, v: (u, v + [0, 20.0, 0]),
    "lower 6 mm aside": lambda u, v: (u, v + [6.0, 0, 0]),
    "lower 40 mm aside": lambda u, v: (u, v + [40.0, 0, 0]),
    "lower 6 mm back": lambda u, v: (u, v - [0, 0, 6.0]),
    "lower rolled 3 degrees": lambda u, v: (u, turned(v, (0, 0, 3))),
    "lower pitched 3 degrees": lambda u, v: (u, turned(v, (3, 0, 0))),
    "lower upside down": lambda u, v: (u, turned(v, (0, 0, 180))),
    "upper upside down": lambda u, v: (turned(u, (0, 0, 180)), v),
    "lower back to front": lambda u, v: (u, turned(v, (0, 180, 0))),
    "lower x 1.3": lambda u, v: (u, 1.3 * v),
    "upper x 1.3": lambda u, v: (1.3 * u, v),
    "both x 1.3": lambda u, v: (1.3 * u, 1.3 * v),
    "both x 2": lambda u, v: (2.0 * u, 2.0 * v),
    "lower mirrored": lambda u, v: (u, v * [-1, 1, 1]),
}


def wrong(name, scans, T_scan_bite):
    """Return both scans with a fault."""
    if name == "files exchanged":
        return scans[::-1]
    if name == "same file twice":
        return [scans[0], scans[0]]
    moved = MOVES[name](*(transform_points(se3_inverse(T_scan_bite), mesh.vertices) for mesh in scans))
    return [replace(mesh, vertices=transform_points(T_scan_bite, v)) for mesh, v in zip(scans, moved, strict=True)]


def prepared(scans):
    """Return the scans ready for tracking, labelled by their shape if they are not painted."""
    middles = [mesh.vertices.mean(0) for mesh in scans]
    labelled = [
        mesh
        if painted_labels(mesh) is not None
        else Mesh(mesh.vertices, mesh.faces, mesh.colors, label_scan(mesh, middles[1 - k]).labels)
        for k, mesh in enumerate(scans)
    ]
    return [prepare_scan(mesh, name) for mesh, name in zip(labelled, ("upper", "lower"), strict=True)]


def figures(scans):
    """Return every figure of a bite by name."""
    T = anatomical_frame(*(scan.crown_vertices(6000) for scan in scans))
    found = measure_occlusion(scans, T)
    values = {field.name: np.ravel(getattr(found, field.name)) for field in fields(found)}
    left, right = values.pop("side_gaps_mm")
    values["one_sided_mm"] = np.abs([left - right])
    return {name: np.asarray(value, float) for name, value in values.items() if value.dtype != object}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--persons", type=int, default=130)
    parser.add_argument("--faults", action="store_true")
    options = parser.parse_args()
    names = [*MOVES, "files exchanged", "same file twice"] if options.faults else []
    said = {name: Counter() for name in ("valid", *names)}
    worst = {name: Counter() for name in said}
    ranges = {}
    for seed in range(options.persons):
        drawn = draw_capture(ShortConfig(seed, unpainted=UNPAINTED))
        for name in said:
            try:
                scans = prepared(
                    list(drawn.scans) if name == "valid" else wrong(name, list(drawn.scans), drawn.T_scan_bite)
                )
                found = occlusion_findings(scans, None)[1]
            except Exception as error:
                said[name][type(error).__name__] += 1
                worst[name]["refused"] += 1
                continue
            said[name].update({finding.kind for finding in found})
            severities = {finding.severity for finding in found}
            worst[name]["refused" if "error" in severities else "warned" if severities else "accepted"] += 1
            if name == "valid":
                for key, value in figures(scans).items():
                    ranges.setdefault(key, []).extend(value[np.isfinite(value)])
    for name, counts in worst.items():
        listed = ", ".join(f"{kind} {count}" for kind, count in said[name].most_common())
        print(f"{name:24s} {dict(counts)}  {listed}")
    for name, values in ranges.items():
        low, middle, high = np.percentile(values, [0, 50, 100])
        print(f"{name:24s} {low:8.3f} .. {middle:8.3f} .. {high:8.3f}")


if __name__ == "__main__":
    main()
