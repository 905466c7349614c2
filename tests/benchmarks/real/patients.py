"""Photographs of real teeth: crowns of two patients aligned with drawn outlines, and automatic masks against them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from report import Origin, table, title
from scipy import ndimage
from sources import PATIENTS

from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, so3_log, transform_point, transform_points
from jawusd.media.overlay import save_png
from jawusd.media.pictures import read_gray, read_picture
from jawusd.meshes.meshio import load_mesh
from jawusd.photographs.align import (
    _AT_WIDTH_PX,
    _TURN_PX,
    PhotoAlignment,
    _lower_incisor,
    _refined,
    align_photographs,
    drawn_over,
    read_drawing,
)
from jawusd.photographs.solve import Bite, Contact, match, seen_outlines
from jawusd.segmentation.arches import ScanSurface, expect_crowns
from jawusd.segmentation.camera import Scene
from jawusd.segmentation.colours import ColourModel, SegmentationConfig
from jawusd.segmentation.picture import Window
from jawusd.segmentation.rows import tooth_rows
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.initialization.occlusion import measure_occlusion

Array = np.ndarray
COLOUR = 1  # cv2.IMREAD_COLOR
VIEWS = {"front": 4, "left": 2, "right": 3}  # with the teeth together, and their numbers in the names of the files
ROWS = ("Upper", "Lower")
LINE = 64  # gray from which a pixel belongs to a line; its blur reaches three times as far
DRAWN_PX = 5.0  # width of the drawn lines
LARGEST_TOOTH = 0.05  # share of a picture: closed lines around more enclose no tooth
BESIDE_PX = 20  # masks are judged as far as this beyond the areas
ORIGIN = Origin(f"`{PATIENTS.repository}` seg/valid and demo/ref_mesh", PATIENTS.licence, "patients")
PALETTE = np.array([[60, 220, 60], [60, 160, 255]])


def run(data: Path, out: Path) -> None:
    """Print the tables of both patients and write pictures."""
    title("Photographs of patients", ORIGIN)
    folder = PATIENTS.found(data)
    aligned: list[PhotoAlignment] = []

    def outlines() -> Iterator[list[str]]:
        for patient in (0, 1):
            aligned.append(align(folder, patient))
            yield from outline_rows(patient, aligned[patient])

    print("Outlines [px at 1440 px width]; T_upper_lower by a photograph alone and by the two others [mm]:\n")
    fits = ("rms", "median", "without gum lines", "each tooth moved")
    header = ("patient", "photograph", "focal", *fits, "alone to all", "others to all")
    table(header, outlines(), ORIGIN)
    print("Crowns in occlusion as the photographs close them; gaps are negative where crowns overlap:\n")
    table(
        ("patient", "gap left [mm]", "gap right [mm]", "overlap [mm]", "opposed, share", "overjet [mm]"),
        (occlusion_row(folder, patient, found) for patient, found in enumerate(aligned)),
        ORIGIN,
    )
    print("Automatic masks against the areas of the drawn outlines, intersection over union:\n")
    table(
        ("patient", "photograph", "upper", "lower", "both", "both, without scans", "outlines closed"),
        (row for patient, found in enumerate(aligned) for row in mask_rows(folder, patient, found, out)),
        ORIGIN,
    )


def align(folder: Path, patient: int) -> PhotoAlignment:
    """Align a patient's crowns with the lines drawn in three photographs, focal lengths unknown."""
    lines = [read_drawing(labels(folder, patient, view), view) for view in VIEWS]
    return align_photographs(lines, meshes(folder, patient), lambda stage, done, total: None)


def occlusion_row(folder: Path, patient: int, found: PhotoAlignment) -> list[str]:
    """Return the row of a patient: how the crowns meet in the bite that all photographs share."""
    upper, lower = meshes(folder, patient)
    lower = replace(lower, vertices=transform_points(found.bite.T_upper_lower, lower.vertices))
    scans = [prepare_scan(mesh, row.lower()) for mesh, row in zip((upper, lower), ROWS, strict=True)]
    met = measure_occlusion(scans, found.rows.usual.T_anatomical_upper)
    figures = (*met.side_gaps_mm, met.depth_mm, met.opposite, -met.lower_ahead_mm)
    return [str(patient), *(f"{figure:.2f}" for figure in figures)]


def meshes(folder: Path, patient: int) -> list[Mesh]:
    """Return the crowns of both rows, each in a frame of its own."""
    place = folder / "demo" / "ref_mesh" / str(patient)
    return [load_mesh(place / f"Ref_{row}_Mesh_Tag={patient}.obj") for row in ROWS]


def labels(folder: Path, patient: int, view: str) -> Array:
    """Return the drawn lines of a photograph, gray, 0 where there is none."""
    return read_gray(folder / "seg" / "valid" / "label" / f"{patient}-{VIEWS[view]}.png")


def outline_rows(patient: int, found: PhotoAlignment) -> list[list[str]]:
    """Return the rows of a patient: how outlines fit, and how photographs agree on the bite at the lower incisor."""
    joint, point = found.bite, _lower_incisor(found.rows)
    contact = Contact([crowns.scan for crowns in found.rows.fine])

    def bite(numbers: list[int]) -> Array:
        photos = tuple(joint.photos[k] for k in numbers)
        start = Bite(photos, joint.T_upper_lower, joint.gum_mm)
        return _refined(start, [photo.drawing for photo in photos], found.rows, contact).T_upper_lower

    def apart(T: Array) -> str:
        off = np.linalg.norm(transform_point(T, point) - transform_point(joint.T_upper_lower, point))
        turn = np.degrees(np.linalg.norm(so3_log(T[:3, :3] @ joint.T_upper_lower[:3, :3].T)))
        return f"{off:.2f} ({turn:.1f} degrees)"

    rows = []
    for k, photo in enumerate(found.result.photos):
        figures = (photo.outline_rms_px, photo.outline_median_px, photo.free_rms_px)
        others = [j for j in range(len(VIEWS)) if j != k]
        told = [f"{value:.2f}" for value in (*figures, moved_singly_rms_px(found, k))]
        rows.append([str(patient), photo.name, f"{photo.focal_px:.0f}", *told, apart(bite([k])), apart(bite(others))])
    return rows


def moved_singly_rms_px(found: PhotoAlignment, number: int) -> float:
    """Return the rms of outlines [px at 1440 px width] if every tooth could move in the picture by itself.

    An alignment of whole rows has less freedom: what remains here is between the drawn lines and the crowns.
    """
    photo = found.bite.photos[number]
    to_usual = _AT_WIDTH_PX / photo.drawing.size_px[0]
    seen = seen_outlines(found.rows.fine, photo, found.bite)
    for _ in range(8):
        own = match(seen, photo.drawing, _TURN_PX / to_usual)
        moved = seen.pixels.copy()
        for tooth in np.unique(own.outlines.tooth):
            drawn = own.outlines.tooth == tooth
            normals, off = own.outlines.normals[drawn], -own.off_px[drawn] * to_usual
            weighted = normals / (1 + (off / DRAWN_PX) ** 2)[:, None]
            step = np.linalg.lstsq(weighted.T @ normals, weighted.T @ off, rcond=1e-3)[0]
            moved[seen.tooth == tooth] += step / to_usual
        seen = replace(seen, pixels=moved)
    apart = match(seen, photo.drawing, _TURN_PX / to_usual).outlines.pixels - photo.drawing.pixels
    return float(to_usual * np.sqrt((apart**2).sum(axis=1).mean()))


def mask_rows(folder: Path, patient: int, found: PhotoAlignment, out: Path) -> list[list[str]]:
    """Return the rows of a patient: masks by the aligned crowns and colours, and by the picture alone."""
    scans = tuple(ScanSurface.of(mesh) for mesh in meshes(folder, patient))
    return [mask_row(folder, patient, found, k, scans, out) for k in range(len(VIEWS))]


def mask_row(folder: Path, patient: int, found: PhotoAlignment, number: int, scans: tuple, out: Path) -> list[str]:
    """Return the row of a photograph, and write its masks over it."""
    told, photo = found.result.photos[number], found.bite.photos[number]
    picture = read_picture(folder / "seg" / "valid" / "image" / f"{patient}-{VIEWS[told.name]}.png", COLOUR)
    picture, drawn = picture[..., ::-1], labels(folder, patient, told.name)
    if told.mirrored:
        picture, drawn = picture[:, ::-1], drawn[:, ::-1]
    picture = np.ascontiguousarray(picture)
    size = (picture.shape[1], picture.shape[0])
    k1 = [photo.pose.opencv_k1(size), 0.0, 0.0, 0.0]
    lens = Camera(told.name, size, photo.pose.camera_matrix(size), np.array(k1), photo.pose.T_cam_upper)
    poses = np.stack([np.eye(4), found.bite.T_upper_lower])
    expected = expect_crowns(scans, poses, lens)
    px_per_mm = photo.pose.focal_px / float((photo.pose.T_cam_upper @ [*scans[0].vertices.mean(axis=0), 1.0])[2])
    masks = automatic(picture, lens, expected, px_per_mm)
    areas, closed = drawn_areas(drawn, expected.labels)
    # what lies beside the closed outlines belongs to teeth whose lines are open: nobody says where they end
    judged = ndimage.distance_transform_edt(~areas.any(axis=0)) < BESIDE_PX
    rows = tooth_rows(picture)
    bare = overlap(rows.masks.any(axis=0) & judged, areas.any(axis=0)) if rows is not None else "no rows found"
    masks &= judged
    both = overlap(masks.any(axis=0), areas.any(axis=0))
    save_overlay(out / f"patient_{patient}_{told.name}", picture, masks, areas, found, number)
    single = [overlap(mask, area) for mask, area in zip(masks, areas, strict=True)]
    return [str(patient), told.name, *single, both, bare, str(closed)]


def automatic(picture: Array, lens: Camera, expected, px_per_mm: float) -> Array:
    """Return the masks of both rows (2, h, w) that the colours under and around the aligned crowns tell."""
    config = SegmentationConfig()
    colours = ColourModel(config.memory_frames)
    inside = expected.inside_px.max(axis=0) / px_per_mm
    around = inside < -config.outer_mm
    colours.learn(picture, inside > config.inner_mm, around & (inside > -config.outer_mm - config.margin_mm))
    scene = Scene(Window(lens, picture, (0, 0)), expected, colours, px_per_mm)
    return scene.cut(config, config.reach_mm[-1])[0] > 0.5


def drawn_areas(lines: Array, expected: Array) -> tuple[Array, int]:
    """Return the areas (2, h, w) in closed lines, to their middle, by the row of the crowns there, and their number."""
    drawn = lines > LINE
    half_px = ndimage.distance_transform_edt(drawn)[drawn].max()
    parts, count = ndimage.label(~ndimage.binary_dilation(drawn))
    sizes = ndimage.sum_labels(np.ones_like(parts), parts, np.arange(1, count + 1))
    areas, closed = np.zeros((2, *lines.shape), dtype=bool), 0
    for part in 1 + np.flatnonzero(sizes < LARGEST_TOOTH * lines.size):
        here = parts == part
        seen = [np.count_nonzero(expected[here] == row) for row in (1, 2)]
        if max(seen) * 2 > np.count_nonzero(here):
            areas[int(np.argmax(seen))] |= ndimage.binary_dilation(here, iterations=1 + int(half_px))
            closed += 1
    return areas, closed


def overlap(one: Array, other: Array) -> str:
    """Return the intersection over union of two masks, as it is printed."""
    return f"{np.count_nonzero(one & other) / max(1, np.count_nonzero(one | other)):.3f}"


def save_overlay(path: Path, picture: Array, masks: Array, areas: Array, found: PhotoAlignment, number: int) -> None:
    """Write the outlines of crowns over the photograph, and masks (tinted) with the borders of drawn areas (red)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    upright = picture[:, ::-1] if found.result.photos[number].mirrored else picture
    save_png(path.with_name(path.name + "_crowns.png"), drawn_over(np.ascontiguousarray(upright), found, number))
    tinted = picture.astype(np.float64)
    for mask, colour in zip(masks, PALETTE, strict=True):
        tinted[mask] = 0.6 * tinted[mask] + 0.4 * colour
    for area in areas:
        border = area & ~ndimage.binary_erosion(area, iterations=2)
        tinted[border] = (255, 40, 40)
    save_png(path.with_name(path.name + "_masks.png"), tinted.astype(np.uint8))
