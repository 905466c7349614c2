"""The numbers of the segmentation, each with its unit and reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SegmentationConfig:
    """Set up the segmentation; px are pixels of the working picture."""

    # Working resolution at the teeth [px/mm]: that of the tracker.
    working_px_per_mm: float = 7.2
    # Surroundings looked at around the projected crowns [mm]: lips, gum and tongue, not the room behind.
    margin_mm: float = 4.0
    # Distance inside projected crowns from which colours are learned as crowns [mm]: above the error of the poses.
    inner_mm: float = 0.4
    # Distance outside all projected crowns from which colours are learned as surroundings [mm].
    outer_mm: float = 1.0
    # How far teeth may reach beyond their projection [mm]: in the first round, and once the poses have been aligned.
    reach_mm: tuple[float, ...] = (1.6, 1.0)
    # Frames over which colours are remembered [-]: light changes with the head, not from frame to frame.
    memory_frames: float = 24.0
    # Share of the surroundings below whose log-odds a colour cannot be tooth [-], and how much higher [-] its log-odds
    # must be where place gives no evidence: how well colours separate the two differs from person to person.
    surroundings_share: float = 0.95
    doubt: float = 1.5
    # Bounds of the log-odds demanded in all [-].
    doubt_range: tuple[float, float] = (-1.0, 1.0)
    # Log-odds of being tooth per mm inside the projected outline [1/mm], and the most that place alone may count
    # against and for it.
    place_per_mm: float = 2.0
    place_most: tuple[float, float] = (1.5, 1.0)
    # Price of a border in log-odds per pixel of its length [-], and the share left of it on the strongest edges.
    border: float = 4.0
    border_on_edge: float = 0.15
    # Log-odds between the arches per mm from their projected common border [1/mm]; segment.json has this name.
    rows_per_mm: float = 2.0
    # How far borders may move to where the picture changes [mm] and how far to either side colours are compared [mm].
    border_band_mm: float = 0.4
    border_side_mm: float = 0.8
    # Blur of the colours compared [px], and standard deviations the sides must differ by [-].
    border_blur_px: float = 0.7
    border_contrast: float = 2.0
    # Shares by which outlines of the upper and lower arch are moved outwards [-], as drawn masks teach: the soft border
    # from 0 to 1 is about 3 px wide.
    wider: tuple[float, float] = (0.0, 0.0)
    # Share of its outline that must show in the picture for a part to be tooth [-], and pixels below which it is none.
    founded_share: float = 0.5
    speck_px: int = 25
    # Iterations of the cut [-].
    steps: int = 40
    # How far from where it is expected the border between the arches is searched [mm], and iterations for that [-].
    arch_band_mm: float = 1.0
    arch_steps: int = 60
    # Weight of a person's mask in the colours [frames].
    key_weight: float = 12.0
    # Overlap with a finished mask below which a cut is wrong [-]: good ones reach 0.85 on the worst frames.
    key_overlap: float = 0.8
    # Fewest pixels that make a mask [px]: 4 square millimetres.
    least_px: int = 200
