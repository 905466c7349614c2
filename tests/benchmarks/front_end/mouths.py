"""Mouths to learn from: label maps of synthetic persons, painted at random each time they are taken.

Nothing of any renderer, camera or person that results are told on: shapes come from `subjects.dentition`, and
colours, light, lenses, noise and compression are drawn far wider than footage has them, so that a network must go by
what stays (Billot et al. 2023, SynthSeg, do so with scans of heads).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from subjects.short_capture import ShortConfig, draw_capture, labelled

from jawusd.base.arrays import Array

CROP_PX = 160
PX_PER_MM = (2.5, 9.0)  # of the crops; trackers work at 7.2 at most
UPPER, LOWER, OTHER = 0, 1, 2  # classes
_UPPER_TEETH, _LOWER_TEETH, _GUMS, _SOFT = range(1, 15), range(41, 55), (40, 80), 90  # labels
_VIEWS = 4  # of each person


class Mouth(NamedTuple):
    """Hold what is seen of a mouth: labels and inverse depth [1/mm], shape (h, w), and pixels per mm at the teeth."""

    labels: NDArray[np.uint8]
    depth: NDArray[np.float32]
    px_per_mm: float


def label_maps(seeds: range) -> Iterator[Mouth]:
    """Yield the mouths of persons in some of their cameras, as `labelled` draws them."""
    for seed in seeds:
        capture = draw_capture(ShortConfig(seed))
        rng = np.random.default_rng([seed, 0xF0])
        for _ in range(_VIEWS):
            camera, t = int(rng.integers(len(capture.cameras))), float(rng.uniform(0, capture.config.frames - 1))
            labels, _, depth = labelled(capture, camera, t)
            teeth = classes(labels) != OTHER
            if teeth.sum() > 500:
                yield Mouth(labels, depth, float(capture.cameras[camera].K[0, 0] * np.median(depth[teeth])))


def classes(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the class of every pixel."""
    out = np.full(labels.shape, OTHER, np.uint8)
    out[np.isin(labels, _UPPER_TEETH)] = UPPER
    out[np.isin(labels, _LOWER_TEETH)] = LOWER
    return out


def crop(mouth: Mouth, rng: np.random.Generator) -> tuple[NDArray[np.uint8], Array]:
    """Return labels and depth of a square part at a random size, turned and mirrored at random; outside it is skin."""
    labels, depth = mouth.labels, mouth.depth
    scale = np.exp(rng.uniform(*np.log(PX_PER_MM))) / mouth.px_per_mm
    angle = rng.normal(scale=12.0)
    teeth = np.argwhere(classes(labels) != OTHER)
    y, x = teeth[rng.integers(len(teeth))]
    M = cv2.getRotationMatrix2D((float(x), float(y)), angle, scale)
    if rng.random() < 0.5:
        M = np.array([[-1.0, 0, 2 * x], [0, 1.0, 0]]) @ np.vstack([M, [0, 0, 1]])
    M[:, 2] += CROP_PX / 2 - np.array([x, y]) + rng.uniform(-30, 30, 2)
    size = (CROP_PX, CROP_PX)
    turned = cv2.warpAffine(labels, M, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=_SOFT)
    far = cv2.warpAffine(depth.astype(np.float32), M, size, flags=cv2.INTER_LINEAR)
    return turned, far


def painted(labels: NDArray[np.uint8], depth: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a picture (h, w, 3) of a label map in colours, light, blur and noise drawn at random."""
    shape = labels.shape
    linear = _albedo(labels, rng) * _shading(labels, depth, rng)[..., None]
    linear += _highlights(labels, depth, rng)[..., None]
    linear *= np.exp(rng.normal(scale=0.12, size=3)) * np.exp(0.4 * _smooth(shape, 60, rng))[..., None]
    linear = _blurred(linear, rng)
    shown = np.clip(linear * rng.uniform(0.5, 1.4), 0, 1) ** rng.uniform(0.35, 0.7)
    shown += rng.normal(scale=rng.uniform(0.0, 0.05), size=shown.shape)
    picture = np.clip(255 * shown, 0, 255).astype(np.uint8)
    if rng.random() < 0.7:
        _, code = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(30, 95))])
        picture = cv2.imdecode(code, cv2.IMREAD_COLOR)
    return picture


def _albedo(labels: NDArray[np.uint8], rng: np.random.Generator) -> Array:
    """Return linear colours (h, w, 3): enamel, gum, lips, skin, tongue, and what lies behind."""
    shape = labels.shape
    out = np.empty((*shape, 3))
    out[:] = _colour(rng, (0.0, 1.0), (0.1, 0.7), (0.01, 0.25))  # the dark of the mouth, hair, a retractor
    soft = labels == _SOFT
    away = cv2.distanceTransform(soft.astype(np.uint8), cv2.DIST_L2, 3)
    skin, lip = _colour(rng, (0.0, 0.12), (0.15, 0.7), (0.1, 0.8)), _colour(rng, (0.93, 1.04), (0.2, 0.8), (0.1, 0.7))
    share = 1.0 / (1.0 + np.exp(-(away - rng.uniform(4, 45)) / rng.uniform(1, 6)))
    mottled = np.exp(rng.uniform(0.02, 0.2) * _smooth(shape, rng.uniform(1.5, 8), rng))
    out[soft] = ((lip + share[..., None] * (skin - lip)) * mottled[..., None])[soft]
    for label in _GUMS:
        gum = labels == label
        out[gum] = (_colour(rng, (0.93, 1.05), (0.2, 0.75), (0.15, 0.8)) * mottled[..., None])[gum]
    enamel = _colour(rng, (0.06, 0.17), (0.0, 0.45), (0.35, 1.0))
    root = cv2.distanceTransform((~np.isin(labels, _GUMS)).astype(np.uint8), cv2.DIST_L2, 3)
    stain = 1.0 - rng.uniform(0, 0.4) * np.exp(-root / rng.uniform(2, 12))
    for label in np.unique(labels[classes(labels) != OTHER]):
        tooth = labels == label
        own = enamel * np.exp(rng.normal(scale=0.08, size=3) * [0.5, 0.6, 1.2])
        out[tooth] = (own * stain[..., None])[tooth]
    if rng.random() < 0.1:  # something in front: a finger, a retractor's arm
        centre, axes = rng.uniform(0, shape[0], 2), rng.uniform(10, 50, 2)
        colour = _colour(rng, (0.0, 1.0), (0.0, 0.5), (0.2, 1.0))
        front = np.zeros(shape, np.uint8)
        cv2.ellipse(front, (centre, 2 * axes, float(rng.uniform(0, 180))), 1, -1)
        out[(front > 0) & soft] = colour
    return out


def _shading(labels: NDArray[np.uint8], depth: Array, rng: np.random.Generator) -> Array:
    """Return how much light falls on every pixel (h, w): from one side, less deep in the mouth and beside edges."""
    normal = _normals(depth, rng)
    light = np.array([*rng.normal(scale=0.8, size=2), 1.0])
    facing = np.clip(normal @ (light / np.linalg.norm(light)), 0, None)
    ambient = rng.uniform(0.15, 0.8)
    known = depth > 0
    depth_mm = np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0)
    nearest = np.percentile(depth_mm[known], 2) if known.any() else 0.0
    deep = np.where(known & (labels != _SOFT), np.exp(-np.clip(depth_mm - nearest, 0, 80) / rng.uniform(15, 80)), 1.0)
    front = cv2.GaussianBlur(np.where(known, depth, 0).astype(np.float32), (0, 0), rng.uniform(2, 8))
    hidden = np.clip((front - depth) / max(float(depth.max()), 1e-6) * rng.uniform(0, 60), 0, 0.8)
    return (ambient + (1 - ambient) * facing) * deep * (1 - hidden)


def _highlights(labels: NDArray[np.uint8], depth: Array, rng: np.random.Generator) -> Array:
    """Return reflections of lamps (h, w) on wet surfaces."""
    bumps = np.stack([_smooth(labels.shape, 8, rng) for _ in range(3)], -1)
    normal = _normals(depth, rng) + rng.uniform(0, 0.04) * bumps
    out = np.zeros(labels.shape)
    for _ in range(rng.integers(0, 4)):
        towards = np.array([*rng.normal(scale=0.4, size=2), 1.0])
        facing = np.clip(normal @ (towards / np.linalg.norm(towards)), 0, 1)
        out += rng.uniform(0.1, 1.0) * facing ** rng.uniform(20, 200)
    return np.where(depth > 0, out, 0.0)


def _normals(depth: Array, rng: np.random.Generator) -> Array:
    """Return unit normals (h, w, 3) from inverse depth, bumpy at random; towards the camera where there is nothing."""
    smooth = cv2.GaussianBlur(depth.astype(np.float64), (0, 0), 1.0)
    known = depth > 0
    mm = np.where(known, 1.0 / np.maximum(smooth, 1e-9), 0.0)
    slope = 5.0 * np.stack([np.gradient(mm, axis=1), np.gradient(mm, axis=0)], -1)  # about five pixels to a millimetre
    slope = np.clip(np.where(known[..., None], slope, 0.0), -3, 3)
    normal = np.dstack([slope, np.ones(depth.shape)])
    return normal / np.linalg.norm(normal, axis=2, keepdims=True)


def _blurred(linear: Array, rng: np.random.Generator) -> Array:
    """Return a picture out of focus and moved while it was taken."""
    out = cv2.GaussianBlur(linear, (0, 0), rng.uniform(0.3, 1.6))
    length = rng.exponential(1.5)
    if length > 1.0:
        size = 2 * int(np.ceil(length)) + 1
        kernel = np.zeros((size, size), np.float32)
        middle = size // 2
        step = length / 2 * np.array([np.cos(a := rng.uniform(0, np.pi)), np.sin(a)])
        ends = [tuple(int(round(v)) for v in middle + sign * step) for sign in (-1, 1)]
        cv2.line(kernel, ends[0], ends[1], 1.0)
        out = cv2.filter2D(out, -1, kernel / kernel.sum())
    return out


def _smooth(shape: tuple[int, int], scale_px: float, rng: np.random.Generator) -> Array:
    """Return smooth noise (h, w) of unit variance."""
    coarse = rng.normal(size=[max(2, int(np.ceil(s / scale_px)) + 2) for s in shape])
    return cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)


def _colour(rng: np.random.Generator, hue: tuple[float, float], satur: tuple[float, float], value: tuple[float, float]):
    """Return a linear colour within bounds of hue (may pass 1), saturation and value."""
    h, s, v = rng.uniform(*hue) % 1.0, rng.uniform(*satur), rng.uniform(*value)
    k = (np.array([5.0, 3.0, 1.0]) + 6 * h) % 6
    return (v - v * s * np.clip(np.minimum(k, 4 - k), 0, 1)) ** 2.2
