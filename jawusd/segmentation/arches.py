"""Both arches in one image: projected crowns, cut with costs from colour, position and edges, and refined borders."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.formats.mesh import Mesh, crown_face_mask
from jawusd.geometry import Camera, transform_points
from jawusd.meshes.raster import draw_depth_labels
from jawusd.segmentation.colours import ColourModel, SegmentationConfig, log_chroma

OTHER, UPPER, LOWER = 0, 1, 2
_TAU = _SIGMA = 0.35  # step sizes tau and sigma of the primal-dual iteration, which converges if 8 tau sigma < 1
_NEVER = 30.0  # magnitude of log-odds that act as a hard constraint
_FEWEST_OPEN = 20  # minimum number of undecided pixels between the arches for re-estimating their border


@dataclass(frozen=True, eq=False)
class ScanSurface:
    """Scan of one arch, split into teeth and other faces for rasterisation."""

    vertices: Array  # scan coordinates [mm], shape (V, 3)
    crown_faces: NDArray[np.int32]  # faces of the teeth, int32, shape (F, 3)
    gum_faces: NDArray[np.int32]  # other faces, which only occlude, int32, shape (G, 3)

    @classmethod
    def of(cls, mesh: Mesh) -> ScanSurface:
        """Split the faces of a teeth scan into teeth and other faces, by the label of most of their corners."""
        crown = crown_face_mask(mesh)
        return cls(mesh.vertices, mesh.faces[crown], mesh.faces[~crown])


@dataclass(frozen=True, eq=False)
class Expectation:
    """Expected crowns in an image; lengths [px] are in pixels of this image."""

    labels: NDArray[np.uint8]  # labels of the visible crowns: OTHER, UPPER or LOWER, shape (h, w)
    # signed distance to the outline of each arch's visible crowns, positive inside, shape (2, h, w)
    inside_px: NDArray[np.float32]


def expect_crowns(scans: tuple[ScanSurface, ScanSurface], poses: Array, camera: Camera) -> Expectation:
    """Render both arches at poses (2, 4, 4), T_world_upper and T_world_lower, with a pinhole camera."""
    width, height = camera.size_px
    inverse_depth, labels = np.zeros((height, width), np.float32), np.zeros((height, width), np.uint8)
    for scan, pose, label in zip(scans, poses, (UPPER, LOWER), strict=True):
        world = transform_points(pose, scan.vertices)
        points = np.column_stack([camera.project_pinhole(world), camera.depth(world)]).astype(np.float32)
        draw_depth_labels(points, scan.gum_faces, 0, 0, False, inverse_depth, labels, OTHER)
        draw_depth_labels(points, scan.crown_faces, 0, 0, False, inverse_depth, labels, label)
    away = np.stack([_signed_distance(labels == label) for label in (UPPER, LOWER)])
    return Expectation(labels, np.where(away > 0, away - np.float32(0.5), away + np.float32(0.5)))


@numba.njit(nogil=True, cache=True)
def _iterate(
    cost: NDArray[np.float32],
    edge: NDArray[np.float32],
    u: NDArray[np.float32],
    spans: NDArray[np.int64],
    steps: int,
) -> None:
    """Run the first-order primal-dual iteration (Chambolle and Pock 2011) of the relaxed Potts energy.

    Shapes: cost (3, h, w); edge (2, h, w), weights of the links to the right and down; u (3, h, w), updated in place;
    spans (h, 2), the range of free columns in each row; pixels outside this range are fixed.
    """
    n, h, w = cost.shape
    px, py = np.zeros_like(u), np.zeros_like(u)
    bar = u.copy()
    for _ in range(steps):
        for k in range(n):
            for y in range(h):
                for x in range(spans[y, 0], spans[y, 1]):
                    gx = bar[k, y, x + 1] - bar[k, y, x] if x + 1 < w else np.float32(0.0)
                    gy = bar[k, y + 1, x] - bar[k, y, x] if y + 1 < h else np.float32(0.0)
                    a = px[k, y, x] + np.float32(_SIGMA) * gx
                    b = py[k, y, x] + np.float32(_SIGMA) * gy
                    la, lb = edge[0, y, x], edge[1, y, x]
                    px[k, y, x] = min(max(a, -la), la)
                    py[k, y, x] = min(max(b, -lb), lb)
        for y in range(h):
            for x in range(spans[y, 0], spans[y, 1]):
                v0 = v1 = v2 = np.float32(0.0)
                for k in range(3):
                    div = px[k, y, x] + py[k, y, x]
                    if x > 0:
                        div -= px[k, y, x - 1]
                    if y > 0:
                        div -= py[k, y - 1, x]
                    v = u[k, y, x] + np.float32(_TAU) * (div - cost[k, y, x])
                    if k == 0:
                        v0 = v
                    elif k == 1:
                        v1 = v
                    else:
                        v2 = v
                s0, s1, s2 = _to_simplex(v0, v1, v2)
                bar[0, y, x] = 2 * s0 - u[0, y, x]
                bar[1, y, x] = 2 * s1 - u[1, y, x]
                bar[2, y, x] = 2 * s2 - u[2, y, x]
                u[0, y, x], u[1, y, x], u[2, y, x] = s0, s1, s2


@numba.njit(nogil=True, cache=True)
def _to_simplex(a: np.float32, b: np.float32, c: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """Project three label weights onto the probability simplex."""
    high = max(a, b, c)
    low = min(a, b, c)
    mid = a + b + c - high - low
    t = (a + b + c - np.float32(1.0)) / np.float32(3.0)
    if low - t < 0:
        t = (high + mid - np.float32(1.0)) * np.float32(0.5)
        if mid - t < 0:
            t = high - np.float32(1.0)
    zero = np.float32(0.0)
    return max(a - t, zero), max(b - t, zero), max(c - t, zero)


def cut_three_ways(
    cost: NDArray[np.float32],
    edge: NDArray[np.float32],
    start: NDArray[np.float32],
    free: Mask,
    steps: int,
) -> NDArray[np.float32]:
    """Return the label weights of the minimal cut, shape (3, h, w); they are non-negative and their sum is 1.

    The energy is the cost of the labels plus the weighted length of the borders between them: the convex relaxation of
    the Potts model with one indicator per label (Zach et al. 2008), and with links to the right and down.

    Args:
        cost: cost of each label at each pixel, shape (3, h, w).
        edge: cost of a border between a pixel and its right and lower neighbour, shape (2, h, w).
        start: initial label weights, shape (3, h, w).
        free: pixels to be labelled, shape (h, w); the other pixels keep their initial weights.
    """
    u = np.ascontiguousarray(start, np.float32).copy()
    spans = np.zeros((cost.shape[1], 2), np.int64)
    for y in np.flatnonzero(free.any(1)):
        columns = np.flatnonzero(free[y])
        spans[y] = columns[0], columns[-1] + 1
    # Each border is part of the outlines of two labels, but its cost counts only once.
    half = np.ascontiguousarray(0.5 * edge, np.float32)
    _iterate(np.ascontiguousarray(cost, np.float32), half, u, spans, steps)
    return u


@dataclass(frozen=True, eq=False)
class Seeds:
    """Annotations in a working image."""

    known: Mask  # annotated pixels of each arch, shape (2, h, w)
    share: NDArray[np.float32]  # annotated tooth coverage, shape (2, h, w)

    def pinned(self, shares: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return coverages of both arches, shape (2, h, w), with annotated pixels replaced by the annotation."""
        shares = np.where(self.known, self.share, shares)
        other = self.known & (self.share > 0.5)
        return np.where(other[::-1] & ~self.known, 0, shares)


def cut_arches(
    rgb: NDArray[np.uint8],
    expected: Expectation,
    model: ColourModel,
    config: SegmentationConfig,
    px_per_mm: float,
    reach_mm: float,
    seeds: Seeds | None = None,
) -> NDArray[np.float32]:
    """Segment an image (h, w, 3); return the coverage of both arches, 0 .. 1, shape (2, h, w).

    Tooth pixels lie within `reach_mm` of the projected crowns; `seeds` are hard constraints.
    """
    inside = expected.inside_px / px_per_mm
    demanded = model.surroundings_quantile(config.surroundings_share) + config.doubt
    odds = model.log_odds(rgb) - np.float32(np.clip(demanded, *config.doubt_range))
    cost = np.zeros((3, *rgb.shape[:2]), np.float32)
    apart = np.clip(config.rows_per_mm * (inside[0] - inside[1]) / 2, -3, 3)
    for label, arch, sign in ((UPPER, 0, 1.0), (LOWER, 1, -1.0)):
        place = np.clip(config.place_per_mm * inside[arch], -config.place_most[0], config.place_most[1])
        cost[label] = -odds - place - sign * np.minimum(sign * apart, 0.0)
        cost[label][inside[arch] < -reach_mm] = _NEVER
    free: Mask = np.any(inside >= -reach_mm, axis=0)
    if seeds is not None:
        tooth, other = seeds.known & (seeds.share > 0.5), seeds.known & (seeds.share <= 0.5)
        for label, arch in ((UPPER, 0), (LOWER, 1)):
            cost[label][tooth[arch]] = -_NEVER
            cost[label][other[arch]] = _NEVER
        free |= tooth.any(0)
    start = np.stack([expected.labels == label for label in (OTHER, UPPER, LOWER)]).astype(np.float32)
    shares = cut_three_ways(cost, _edge_prices(rgb, config), start, free, config.steps)
    return shares[1:]


def separate_arches(
    shares: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    expected: Expectation,
    config: SegmentationConfig,
    px_per_mm: float,
) -> NDArray[np.float32]:
    """Return the coverage of both arches, shape (2, h, w), after re-estimating the border between them from edges.

    The sum of both coverages is unchanged. Edges between upper and lower teeth are too weak for the common edge weight,
    with which the border would stay at its predicted position.
    """
    inside = expected.inside_px / px_per_mm
    teeth = shares.sum(0)
    open_px = (teeth > 0.5) & (np.abs(inside[0] - inside[1]) < 2 * config.arch_band_mm)
    if open_px.sum() < _FEWEST_OPEN:
        return shares
    rows, columns = np.flatnonzero(open_px.any(1)), np.flatnonzero(open_px.any(0))
    box = (slice(max(0, rows[0] - 2), rows[-1] + 3), slice(max(0, columns[0] - 2), columns[-1] + 3))
    upper, open_px = (shares[0] >= shares[1])[box], open_px[box]
    apart = np.clip(config.rows_per_mm * (inside[0] - inside[1])[box] / 2, -3, 3)
    cost = np.full((3, *upper.shape), _NEVER, np.float32)
    for label, mine, sign in ((UPPER, upper, 1.0), (LOWER, ~upper, -1.0)):
        cost[label] = np.where(open_px, -sign * apart, np.where(mine, -_NEVER, _NEVER))
    start = np.stack([np.zeros_like(upper), upper, ~upper]).astype(np.float32)
    prices = _edge_prices(rgb[box], config, open_px)
    found = cut_three_ways(cost, prices, start, open_px, config.arch_steps)
    share = cv2.GaussianBlur(found[UPPER], (0, 0), _ARCH_BLUR_PX)
    out = shares.copy()
    near = cv2.dilate(open_px.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    for r, part in ((0, share), (1, 1 - share)):
        out[r][box] = np.where(near, teeth[box] * part, shares[r][box])
    return out


def _edge_prices(rgb: NDArray[np.uint8], config: SegmentationConfig, where: Mask | None = None) -> NDArray[np.float32]:
    """Return the cost of a border between each pixel and its right and lower neighbour, shape (2, h, w).

    The edge contrast is normalised by the mean contrast (Boykov and Jolly 2001) of the image or of its part `where`.
    """
    smooth = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB), (0, 0), 0.8).astype(np.float32)
    out = np.full((2, *rgb.shape[:2]), config.border, np.float32)
    squares = [((smooth[:, 1:] - smooth[:, :-1]) ** 2).sum(2), ((smooth[1:] - smooth[:-1]) ** 2).sum(2)]
    parts = squares if where is None else (squares[0][where[:, 1:]], squares[1][where[1:]])
    scale = sum(float(part.mean()) for part in parts) + 1e-6
    low = config.border_on_edge
    out[0, :, :-1] *= low + (1 - low) * np.exp(-squares[0] / scale)
    out[1, :-1] *= low + (1 - low) * np.exp(-squares[1] / scale)
    return out


_EVEN = 1e-4  # variance added to the variance of the log colours [-], for errors of half an 8-bit step
_FEWEST = 100  # minimum number of pixels near the border for estimating the covariance of colours
_ARCH_BLUR_PX = 0.8  # sigma of the blur that makes the coverage fractional at the border between the arches
_FAR_BLUR_PX = 2.0  # sigma of the blur that assigns tooth pixels far from both arches to the nearer arch


def refine_borders(
    shares: NDArray[np.float32], rgb: NDArray[np.uint8], config: SegmentationConfig, px_per_mm: float
) -> tuple[NDArray[np.float32], Mask]:
    """Return coverages (2, h, w) with soft borders, 0.5 at the outline, and a mask of visible borders, shape (h, w).

    Pixels along the border are reclassified by Fisher's discriminant between the local mean colours on both sides
    (local region statistics, Lankton & Tannenbaum 2008), since the midpoint between tooth and surrounding colour varies
    locally. Invisible borders are not moved; parts with hardly any visible border are discarded.
    """
    colours = _blurred(log_chroma(rgb), config.border_blur_px)
    band, window = config.border_band_mm * px_per_mm, 2 * round(config.border_side_mm * px_per_mm) + 1
    inside = _signed_distance(shares.sum(0) > 0.5)
    sides = _compare_sides(inside, colours, window)
    if sides is None:
        return shares, np.zeros(rgb.shape[:2], bool)
    share, contrast = sides
    clear = contrast > config.border_contrast
    moved = clear & (np.abs(inside) < band)
    teeth = np.where(moved, np.clip(share, 0, 1), inside > 0).astype(np.float32)
    teeth[_spurious(teeth > 0.5, clear, config)] = 0.0
    near = [_blurred(arch, _ARCH_BLUR_PX) for arch in shares]
    far = [_blurred(arch, _FAR_BLUR_PX) for arch in shares]
    upper, lower = np.where(near[0] + near[1] > 0.2, near, far)
    teeth = _blurred(teeth, config.border_blur_px)
    return teeth * np.stack([upper, lower]) / np.maximum(upper + lower, 1e-6), clear


def _blurred(image: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.float32)


def _signed_distance(region: Mask) -> NDArray[np.float32]:
    """Return the signed distance to a region's outline, positive inside [px]; a large negative value if empty."""
    if not region.any():
        return np.full(region.shape, -1e3, np.float32)
    inner = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, 5)
    return inner - cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, 5)


def _compare_sides(
    inside: NDArray[np.float32], colours: NDArray[np.float32], window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Compare every pixel with the local mean colours on both sides of the border; None if one side is empty.

    Return the tooth coverage, 0.5 midway between the sides, and the separation of their colours in standard deviations,
    0 unless both sides are nearby; shape (h, w) each.
    """
    near = np.abs(inside) < window / 2
    sides = ((inside > 1) & near, (inside < -1) & near)
    means = [_mean_near(side, colours, window) for side in sides]
    rest = [(colours - mean)[side] for (mean, _), side in zip(means, sides, strict=True)]
    if min(map(len, rest)) < _FEWEST:
        return None
    precision = np.linalg.inv(np.cov(np.concatenate(rest).T) + _EVEN * np.eye(3)).astype(np.float32)
    (tooth, has_tooth), (other, has_other) = means
    apart = tooth - other
    direction = apart @ precision
    contrast = (direction * apart).sum(2)
    share = 0.5 + (direction * (colours - (tooth + other) / 2)).sum(2) / np.maximum(contrast, 1e-6)
    return share, np.where(has_tooth & has_other, np.sqrt(np.maximum(contrast, 0)), 0)


def _mean_near(side: Mask, colours: NDArray[np.float32], window: int) -> tuple[NDArray[np.float32], Mask]:
    """Return the local mean colour of one side at every pixel, and a mask of pixels with enough of this side nearby."""
    weight = side.astype(np.float32)
    count = cv2.boxFilter(weight, -1, (window, window), normalize=False)
    total = cv2.boxFilter(colours * weight[..., None], -1, (window, window), normalize=False)
    return np.asarray(total / np.maximum(count, 1)[..., None], np.float32), np.asarray(count >= window)


def _spurious(teeth: Mask, clear: Mask, config: SegmentationConfig) -> Mask:
    """Return a mask of specks and of parts with hardly any visible border, shape (h, w)."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(teeth.astype(np.uint8))
    outline = teeth & (cv2.erode(teeth.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    length = np.bincount(parts[outline], minlength=count)
    founded = np.bincount(parts[outline & clear], minlength=count)
    bad = (founded < config.founded_share * length) | (stats[:, cv2.CC_STAT_AREA] < config.speck_px)
    bad[0] = False
    return bad[parts]
