"""Masks of teeth that the network draws in photographs of real teeth, against drawn outlines.

    python tests/benchmarks/front_end/photographs.py NET CLONE [--out FOLDER]

CLONE is that of `SJTUzhou/3D-Teeth-Reconstruction-from-Five-Intra-oral-Images` (MIT), see tests/benchmarks/real.
Printed is the intersection over union with the areas in closed outlines, beside what `jawusd` finds without scans.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "real"))
from compare import Network
from patients import BESIDE_PX, COLOUR, LARGEST_TOOTH, LINE, VIEWS, labels, overlap

from jawusd.media.pictures import read_picture
from jawusd.segmentation.rows import tooth_rows

WIDTH_PX = 480  # of the photographs for the network: about 5 px/mm


def closed_areas(lines: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return what lies in closed lines no larger than a tooth can be, shape (h, w)."""
    parts, count = ndimage.label(~ndimage.binary_dilation(lines > LINE))
    sizes = ndimage.sum_labels(np.ones_like(parts), parts, np.arange(1, count + 1))
    small = np.isin(parts, 1 + np.flatnonzero(sizes < LARGEST_TOOTH * lines.size))
    return ndimage.binary_dilation(small, iterations=3)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("net", type=Path)
    parser.add_argument("clone", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    network = Network(options.net)
    print(f"{'patient':<9}{'photograph':<12}{'network':>9}{'rows of teeth':>15}")
    for patient in (0, 1):
        for name, view in VIEWS.items():
            picture = read_picture(options.clone / "seg" / "valid" / "image" / f"{patient}-{view}.png", COLOUR)
            rgb = np.ascontiguousarray(picture[..., ::-1])
            area = closed_areas(labels(options.clone, patient, name))
            judged = ndimage.distance_transform_edt(~area) < BESIDE_PX
            height, width = rgb.shape[:2]
            small = cv2.resize(rgb, (WIDTH_PX, WIDTH_PX * height // width), interpolation=cv2.INTER_AREA)
            ratio = cv2.resize(network.log_ratio(small), (width, height))
            found = (ratio > 0) & judged
            rows = tooth_rows(rgb)
            bare = overlap(rows.masks.any(axis=0) & judged, area) if rows is not None else "none"
            print(f"{patient:<9}{name:<12}{overlap(found, area):>9}{bare:>15}", flush=True)
            if options.out:
                options.out.mkdir(parents=True, exist_ok=True)
                shown = np.where((ratio > 0)[..., None], rgb // 2 + np.array([0, 127, 0], np.uint8), rgb)
                cv2.imwrite(str(options.out / f"{patient}_{name}.jpg"), shown[..., ::-1])


if __name__ == "__main__":
    main()
