"""Occlusion estimated from photographs: photos.json, format jawusd-photos/1."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.finding import Finding

FORMAT = "jawusd-photos/1"


@dataclass(frozen=True, eq=False)
class AlignedPhoto:
    """Pose and lens of one photograph, in pixels of the image as stored, mirrored or not."""

    name: str
    size_px: tuple[int, int]
    mirrored: bool  # whether it was taken via a mirror; poses then refer to the horizontally flipped image
    focal_px: float
    distortion: float  # radial distortion, OpenCV's k1
    middle_px: Array  # principal point, shape (2,)
    T_cam_upper: Array  # transform from upper scan to camera, shape (4, 4)
    outline_rms_px: float  # rms distance of drawn points from the outlines, in px of an image 1440 px wide
    outline_median_px: float
    free_rms_px: float  # outline_rms_px without the points on gum lines
    # mean squared distance of the worse arch in position and direction, relative to 0.5 mm; each square is capped at 1
    misfit: float
    other_hand: float  # ratio of the misfits with the opposite and with the chosen handedness, at the initial pose [-]
    T_upper_lower_alone: Array  # bite estimated from this photograph alone, shape (4, 4)
    # distance between T_upper_lower_alone and the bite shared by all photographs, at the lower incisor
    alone_off_mm: float

    def as_json(self) -> dict[str, object]:
        """Return the fields as plain data for JSON."""
        u, v = self.middle_px.tolist()
        given: dict[str, object] = asdict(self)
        del given["middle_px"], given["distortion"]
        return given | {
            "size_px": list(self.size_px),
            "camera_matrix": [[self.focal_px, 0.0, u], [0.0, self.focal_px, v], [0.0, 0.0, 1.0]],
            "distortions": [self.distortion, 0.0, 0.0, 0.0, 0.0],
            "T_cam_upper": self.T_cam_upper.tolist(),
            "T_upper_lower_alone": self.T_upper_lower_alone.tolist(),
        }


@dataclass(frozen=True, eq=False)
class AlignedPhotos:
    """Photographs and the bite estimated from all of them."""

    T_upper_lower: Array  # transform from lower to upper scan with the teeth together, shape (4, 4)
    gum_mm: Array  # offset of drawn gum lines from the scans' towards the gum, upper and lower, shape (2,)
    depth_mm: float  # penetration depth of the crowns in the common bite
    photos: tuple[AlignedPhoto, ...]
    findings: tuple[Finding, ...]

    def as_json(self) -> dict[str, object]:
        """Return the content of photos.json as plain data."""
        return {
            "format": FORMAT,
            "units": "mm",
            "T_upper_lower": self.T_upper_lower.tolist(),
            "gum_mm": self.gum_mm.tolist(),
            "depth_mm": self.depth_mm,
            "photos": [photo.as_json() for photo in self.photos],
            "findings": [finding.as_json() for finding in self.findings],
        }


def save_photographs(path: AnyPath, photographs: AlignedPhotos) -> None:
    """Write photos.json atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    write_text_atomic(path, json.dumps(photographs.as_json(), indent=1) + "\n")
