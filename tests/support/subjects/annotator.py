"""Annotator model: gum line bias, edge bias, temporal jitter and gross errors of hand-drawn masks."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask

REFERENCE_HEIGHT = 1080.0
#: Supersampling factor of the masks, an odd number. Without it, offsets of less than half a pixel would have no effect,
#: and larger ones would move straight edges by a whole pixel but oblique ones by less.
FINER = 3
_KEEP = 0.6  # frame-to-frame correlation of the varying jitter
_LEAST_SCALE = 0.45  # lower limit of the scale; annotators do not get more precise on small pictures
_NEAR_GUM_MM, _AWAY_FROM_GUM_MM = 0.8, 1.5
_GROSS = ("half", "cut", "blob")


@dataclass(frozen=True, eq=False)
class Annotator:
    """Habits of an annotator; px refer to a picture 1080 px high."""

    gum_mm: Array  # offset of the gum line, + into the gum, upper and lower arch, shape (2,)
    gum_tooth_mm: Array  # additional offset per arch and tooth (left 1..7, right 1..7), shape (2, 14)
    edge_px: float  # offset of all other edges, + outwards
    camera_px: Array  # additional offset of all edges per camera, shape (C,)
    wobble_px: float
    cell_px: float  # correlation length of the jitter
    constant_share: float  # fraction of the jitter's variance that is constant over time
    papilla: float  # fraction of the papilla between two teeth drawn as teeth, 0..1
    sliver_px: float  # narrower parts are omitted
    missing: float  # fraction of missing masks
    gross: float  # fraction of grossly wrong masks

    @property
    def kind(self) -> str:
        """Return the dominant habit, for tables."""
        if np.abs(self.gum_tooth_mm).max() > 0:
            return "gum by tooth"
        if np.abs(self.gum_mm).max() > 0.05:
            return "gum inside" if self.gum_mm.mean() < 0 else "gum outside"
        return "edges off" if abs(self.edge_px) > 0.4 else "neutral"


def draw_annotator(seed: int, cameras: int) -> Annotator:
    """Draw a random annotator for a number of cameras."""
    rng = np.random.default_rng([seed, 0xA220])
    by_tooth = rng.random() < 0.4
    return Annotator(
        gum_mm=np.clip(rng.uniform(-0.125, 0.105) + rng.normal(0.0, 0.025, 2), -0.14, 0.12),
        gum_tooth_mm=rng.normal(0.0, 0.03, (2, 14)) * by_tooth,
        edge_px=rng.uniform(-0.6, 1.0),
        camera_px=rng.normal(0.0, 0.15, cameras),
        wobble_px=rng.uniform(0.4, 1.0),
        cell_px=rng.uniform(20.0, 48.0),
        constant_share=rng.uniform(0.2, 0.6),
        papilla=rng.uniform(0.0, 0.8),
        sliver_px=rng.uniform(2.0, 7.0),
        missing=0.02 * (rng.random() < 0.5),
        gross=0.02 * (rng.random() < 0.5),
    )


class MaskDrawer:
    """Sequence of masks of one arch in one camera by one annotator."""

    def __init__(
        self, annotator: Annotator, arch: int, camera: int, size_px: tuple[int, int], rng: np.random.Generator
    ) -> None:
        """Initialise for masks of a width and height."""
        self._who, self._arch, self._camera, self._rng = annotator, arch, camera, rng
        self._size = size_px
        self._scale = FINER * max(size_px[1] / REFERENCE_HEIGHT, _LEAST_SCALE)
        self._cell = annotator.cell_px * self._scale
        rows, columns = (int(np.ceil(FINER * s / self._cell)) + 2 for s in size_px[::-1])
        self._constant = rng.normal(size=(2, rows, columns))
        self._varying = rng.normal(size=(2, rows, columns))

    def draw(
        self, tooth: NDArray[np.uint8], gum: Mask, window: tuple[int, int], px_per_mm: float
    ) -> NDArray[np.uint8] | None:
        """Return the mask (h, w) as drawn by this annotator, None if it is missing.

        Args:
            tooth: 1..14 on visible teeth of the arch, 0 elsewhere; part of a picture supersampled by `FINER`, shape
                (rows, columns).
            gum: visible gum of the arch, same shape.
            window: first column and row of that part, multiples of `FINER`.
            px_per_mm: resolution of that picture at the teeth.
        """
        who, rng = self._who, self._rng
        self._varying = _KEEP * self._varying + np.sqrt(1.0 - _KEEP**2) * rng.normal(size=self._varying.shape)
        forgotten, wrong = rng.random() < who.missing, rng.random() < who.gross
        if forgotten:
            return None
        part = self._outline(tooth, gum, window, px_per_mm)
        if wrong:
            part = _grossly_wrong(part, rng)
        part = part[FINER // 2 :: FINER, FINER // 2 :: FINER]  # centres of mask pixels
        mask = np.zeros(self._size[::-1], np.uint8)
        row, column = window[1] // FINER, window[0] // FINER
        mask[row : row + part.shape[0], column : column + part.shape[1]] = np.where(part, 255, 0)
        return mask

    def _outline(self, tooth: NDArray[np.uint8], gum: Mask, window: tuple[int, int], px_per_mm: float) -> Mask:
        who, scale = self._who, self._scale
        wobble, taste = self._fields(window, tooth.shape)
        mask = tooth > 0
        if not mask.any():
            return mask
        if who.papilla > 0:
            between = closed(mask, 1.8 * px_per_mm) & gum
            mask = mask | (between & (taste < 2.0 * who.papilla - 1.0))
        mask = opened(mask, who.sliver_px * scale)
        mask = blurred(mask.astype(np.float32), 1.5 * scale) > 0.5
        near = np.zeros(mask.shape, np.float32)
        if gum.any():
            to_gum_mm = np.maximum(outside_px(gum), 0.0) / px_per_mm
            near = np.clip((_AWAY_FROM_GUM_MM - to_gum_mm) / (_AWAY_FROM_GUM_MM - _NEAR_GUM_MM), 0.0, 1.0)
        gum_px = px_per_mm * (who.gum_mm[self._arch] + self._tooth_offsets(tooth, scale))
        edge_px = scale * who.edge_px
        shift = near * gum_px + (1.0 - near) * edge_px + scale * who.camera_px[self._camera]
        shift = blurred(shift.astype(np.float32), 3.0 * scale) + scale * who.wobble_px * wobble
        return np.asarray(outside_px(mask) < shift)

    def _fields(
        self, window: tuple[int, int], shape: tuple[int, ...]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return temporal jitter and constant bias over the window, each of about unit variance."""
        share = self._who.constant_share
        nodes = np.sqrt(share) * self._constant + np.sqrt(1.0 - share) * self._varying
        column, row, rows, columns = (k // FINER for k in (*window, *shape))
        out = []
        for layer in nodes:
            field = smooth_field(layer, self._cell / FINER, self._size)[row : row + rows, column : column + columns]
            # Cubic interpolation between independent nodes reduces the variance to about 0.55.
            out.append(enlarged(1.35 * field, FINER))
        return out[0], out[1]

    def _tooth_offsets(self, tooth: NDArray[np.uint8], scale: float) -> NDArray[np.float32]:
        """Extend the gum offsets of the teeth [mm] to their surroundings."""
        offsets = np.concatenate([[0.0], self._who.gum_tooth_mm[self._arch]]).astype(np.float32)
        if not offsets.any():
            return np.zeros(tooth.shape, np.float32)
        sigma = 5.0 * scale
        weight = blurred((tooth > 0).astype(np.float32), sigma)
        return np.asarray(blurred(offsets[tooth], sigma) / np.maximum(weight, np.float32(1e-3)), np.float32)


def _grossly_wrong(mask: Mask, rng: np.random.Generator) -> Mask:
    """Return a grossly wrong mask: half of it missing, or a large extra patch."""
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return mask
    out, kind = mask.copy(), _GROSS[int(rng.integers(3))]
    if kind == "half":
        out[:, : int(np.percentile(columns, rng.uniform(35, 65)))] = False
    elif kind == "cut":
        out[int(np.percentile(rows, rng.uniform(40, 65))) :] = False
    else:
        y, x = np.ogrid[: mask.shape[0], : mask.shape[1]]
        size = 0.25 * np.ptp(columns) + 2.0
        row, column = rng.choice(rows), rng.choice(columns)
        out |= ((y - row) / (0.7 * size)) ** 2 + ((x - column) / size) ** 2 <= 1.0
    return out


def outside_px(mask: Mask) -> NDArray[np.float32]:
    """Return the signed distance of every pixel (h, w) to a mask's outline [px], negative inside."""
    inside = mask.astype(np.uint8)
    if not inside.any():
        return np.full(mask.shape, np.inf, np.float32)
    away = cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5) - cv2.distanceTransform(inside, cv2.DIST_L2, 5)
    return np.asarray(away + np.where(mask, np.float32(0.5), np.float32(-0.5)), np.float32)


def blurred(values: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """Return a picture (h, w) blurred by a Gaussian."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma_px), np.float32)


def closed(mask: Mask, width_px: float) -> Mask:
    """Return the morphological closing of a mask by a disc: gaps up to a width are filled."""
    return _eroded(~_eroded(~mask, 0.5 * width_px), 0.5 * width_px)


def opened(mask: Mask, width_px: float) -> Mask:
    """Return the morphological opening of a mask by a disc: parts narrower than a width are removed."""
    return ~_eroded(~_eroded(mask, 0.5 * width_px), 0.5 * width_px)


def _eroded(mask: Mask, radius_px: float) -> Mask:
    """Erode a mask by a radius, except at the picture's border."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    return np.asarray(inside - 0.5 > radius_px)


def smooth_field(nodes: Array, cell_px: float, size_px: tuple[int, int]) -> NDArray[np.float32]:
    """Interpolate grid values (rows, columns) cubically to a picture of a width and height."""
    height, width = int(np.ceil(nodes.shape[0] * cell_px)), int(np.ceil(nodes.shape[1] * cell_px))
    field = cv2.resize(nodes.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(field[: size_px[1], : size_px[0]], np.float32)


def enlarged(field: NDArray[np.float32], times: int) -> NDArray[np.float32]:
    """Upsample a smooth picture (h, w) by a factor in both directions."""
    return np.asarray(cv2.resize(field, None, fx=times, fy=times, interpolation=cv2.INTER_LINEAR), np.float32)


def write_mask(path: str, mask: NDArray[np.uint8]) -> None:
    """Write a mask (h, w) as a PNG file.

    Raises:
        OSError: the file cannot be written.
    """
    cv2.imencode(".png", mask, (cv2.IMWRITE_PNG_COMPRESSION, 1))[1].tofile(path)
