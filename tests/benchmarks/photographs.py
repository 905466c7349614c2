"""Align a patient's photographs with their crowns: python tests/benchmarks/photographs.py FOLDER [--out DIR]

FOLDER holds outlines_front.png, outlines_left.png, outlines_right.png (lines drawn along the teeth), photo_*.png of the
same names, and upper_crowns.ply, lower_crowns.ply in frames of their own. With --crowns OTHER the crowns of somebody
else are taken, whose misfit should be large. --out writes the outlines over the photographs: drawn ones red, crowns
green (upper) and blue (lower).

    rms, median   distance of every drawn point from the nearest outline of like direction [px at 1440 px]
    free          rms of those that do not run along the gum, by the crowns
    between       rms of those with teeth on both sides, by the drawing alone
    outside       rms of the others: lines drawn along gum and cheek
    misfit        of the row that fits worse, see `AlignedPhoto`
    hand          misfit of the other handedness over that of this one, at the start
    alone, pair   the bite from one photograph alone, and from the others without it: how far they place the lower
                  incisor from where all do, and from one another [mm]; focal lengths are then free again
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label

from jawusd.geometry import transform_point
from jawusd.media.overlay import save_png
from jawusd.media.pictures import read_gray, read_picture
from jawusd.meshes.meshio import load_mesh
from jawusd.photographs.align import (
    _line_distances,
    _lower_incisor,
    _refined,
    _rms,
    align_photographs,
    drawn_over,
    read_drawing,
)
from jawusd.photographs.solve import Bite, Contact

COLOUR = 1  # cv2.IMREAD_COLOR
VIEWS = ("front", "left", "right")
LINE, BESIDE_PX = 0.25, 7.0  # share of a line's brightness where it ends, and how far from there its middle is at most


def main() -> None:
    """Print the table of a patient."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("folder", type=Path)
    arguments.add_argument("--crowns", type=Path)
    arguments.add_argument("--out", type=Path)
    given = arguments.parse_args()
    begun = time.process_time()
    pictures = [read_gray(given.folder / f"outlines_{view}.png") for view in VIEWS]
    drawings = [read_drawing(picture, view) for picture, view in zip(pictures, VIEWS, strict=True)]
    meshes = [load_mesh((given.crowns or given.folder) / f"{row}_crowns.ply") for row in ("upper", "lower")]
    found = align_photographs(drawings, meshes, lambda stage, done, total: None)
    joint, point = found.bite, _lower_incisor(found.rows)
    contact = Contact([crowns.scan for crowns in found.rows.fine])

    def incisor(numbers: list[int]) -> np.ndarray:
        photos = tuple(joint.photos[k] for k in numbers)
        lines = [photo.drawing for photo in photos]
        bite = _refined(Bite(photos, joint.T_upper_lower, joint.gum_mm), lines, found.rows, contact)
        return transform_point(bite.T_upper_lower, point)

    everywhere = transform_point(joint.T_upper_lower, point)
    print(f"{'':6} mirrored  focal    rms  median   free  between  outside  misfit  hand   alone   pair  alone to pair")
    for k, photo in enumerate(found.result.photos):
        alone, pair = incisor([k]), incisor([j for j in range(len(VIEWS)) if j != k])
        distance = _line_distances(joint.photos[k], joint, found.rows)[0]
        beside = outside(pictures[k], drawings[k].pixels)
        off = [np.linalg.norm(difference) for difference in (alone - everywhere, pair - everywhere, alone - pair)]
        print(
            f"{photo.name:6} {'yes' if photo.mirrored else 'no':>8}  {photo.focal_px:5.0f}  {photo.outline_rms_px:5.2f}"
            f"  {photo.outline_median_px:6.2f}  {photo.free_rms_px:5.2f}"
            f"  {_rms(distance[~beside]):7.2f}  {_rms(distance[beside]):7.2f}  {photo.misfit:6.3f}"
            f"  {photo.other_hand:4.2f}  {off[0]:6.2f} {off[1]:6.2f}  {off[2]:13.2f}"
        )
        if given.out is not None:
            overlay(given, found, k)
    print(f"crowns run {found.result.depth_mm:.2f} mm into one another; gum lines {found.result.gum_mm.round(2)} mm")
    for finding in found.result.findings:
        print(finding.line())
    print(f"{time.process_time() - begun:.0f} s of processor time")


def outside(picture: NDArray[np.uint8], pixels: np.ndarray) -> NDArray[np.bool_]:
    """Return which points of lines (N, 2) [px] border on what no line encloses, shape (N,)."""
    areas, _ = label(picture < LINE * picture.max())
    edge = np.unique(np.concatenate([areas[0], areas[-1], areas[:, 0], areas[:, -1]]))
    away = distance_transform_edt(~np.isin(areas, edge[edge > 0]))
    column, row = np.round(pixels).astype(int).T
    return away[row, column] < BESIDE_PX * picture.shape[1] / 1440.0


def overlay(given: argparse.Namespace, found, number: int) -> None:
    """Write one photograph with the drawn lines and the outlines of the crowns."""
    told, lines = found.result.photos[number], found.bite.photos[number].drawing
    picture = np.ascontiguousarray(read_picture(given.folder / f"photo_{told.name}.png", COLOUR)[..., ::-1])
    column, row = np.round(lines.pixels).astype(int).T
    picture[row, picture.shape[1] - 1 - column if told.mirrored else column] = (255, 40, 40)
    given.out.mkdir(parents=True, exist_ok=True)
    save_png(given.out / f"{given.folder.name}_{told.name}.png", drawn_over(picture, found, number))


if __name__ == "__main__":
    main()
