"""Looks of synthetic subjects in the studio: colours of teeth, gum and skin, light, and the placement of cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from subjects.short_take import draw_cameras
from turned_cameras import turned

from jawusd.base.arrays import Array
from jawusd.geometry import Camera, se3_inverse
from jawusd.synthetic.anatomy import Surface
from jawusd.synthetic.render import OTHER, Renderer
from jawusd.synthetic.take import T_WORLD_SCAN, build_cameras

SIZES_PX = ((1280, 720), (1600, 900), (1920, 1080))
KINDS = ("upright", "turned", "two sides")


@dataclass(frozen=True, eq=False)
class Look:
    """Appearance of a subject and of the images.

    Attributes:
        kind: placement of the cameras, of `KINDS`.
        cameras: cameras before their images are turned; the world is as in `T_WORLD_SCAN`.
        turns: number of counter-clockwise quarter turns of each image.
        tints: factors of the red, green and blue reflectance of teeth, gum and face, shape (3, 3).
        white: factors of the red, green and blue channel, shape (3,).
        gamma: exponent of the image values.
        noise: standard deviation of sensor noise [grey levels of 255].
    """

    kind: str
    cameras: list[Camera]
    turns: list[int]
    tints: Array
    white: Array
    gamma: float
    noise: float

    def placed(self) -> list[Camera]:
        """Return the cameras of the turned images."""
        out = []
        for camera, turns in zip(self.cameras, self.turns, strict=True):
            for _ in range(turns):
                camera = turned(camera)
            out.append(camera)
        return out

    def developed(self, color: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return an image (h, w, 3) with exposure, white balance, contrast and noise of the look."""
        values = 255.0 * np.clip(color / 255.0 * self.white, 0.0, 1.0) ** self.gamma
        return np.clip(np.rint(values + rng.normal(0.0, self.noise, color.shape)), 0, 255).astype(np.uint8)


def plain_look(size_px: tuple[int, int]) -> Look:
    """Return the look of the studio's own cameras and colours."""
    return Look("upright", build_cameras(size_px), [0, 0, 0], np.ones((3, 3)), np.ones(3), 1.0, 1.3)


def draw_look(seed: int) -> Look:
    """Draw a look; its kind follows the seed: upright, turned and two side cameras in turn."""
    rng, kind = np.random.default_rng([seed, 0x100C]), KINDS[seed % len(KINDS)]
    size = SIZES_PX[int(rng.integers(len(SIZES_PX)))]
    placed, T_world_bite = draw_cameras(rng, 3, size)
    T_cam_world = [camera.T_cam_world @ T_world_bite @ se3_inverse(T_WORLD_SCAN) for camera in placed]
    cameras = [replace(camera, T_cam_world=T) for camera, T in zip(placed, T_cam_world, strict=True)]
    if kind == "two sides":
        cameras = [replace(camera, name=f"cam{k}") for k, camera in enumerate(cameras[1:])]
    turns = rng.integers(1, 4, len(cameras)).tolist() if kind == "turned" else [0] * len(cameras)
    teeth = rng.uniform(0.75, 1.15) * np.array([1.0, rng.uniform(0.92, 1.02), rng.uniform(0.75, 1.05)])
    gum = rng.uniform(0.5, 1.1) * np.array([1.0, rng.uniform(0.8, 1.1), rng.uniform(0.8, 1.1)])
    dark = rng.uniform(0.0, 1.0)  # of the skin
    face = (1.0 - dark) * np.array([1.1, 1.1, 1.1]) + dark * np.array([0.32, 0.24, 0.2])
    white = rng.uniform(0.55, 1.15) * rng.uniform(0.9, 1.1, 3)
    noise = float(rng.choice([1.0, 2.0, 4.0]))
    return Look(kind, cameras, turns, np.stack([teeth, gum, face]), white, rng.uniform(0.85, 1.2), noise)


class TintedRenderer(Renderer):
    """Renderer that multiplies the colours of teeth, gum and face by the tints of a look."""

    def __init__(self, look: Look) -> None:
        super().__init__(look.cameras)
        self._tints = look.tints

    def add(self, name: str, surface: Surface, label: int = OTHER) -> None:
        """Add or replace a surface with tinted colours."""
        row = 0 if "teeth" in name else 1 if "gum" in name else 2
        super().add(name, replace(surface, colors=np.clip(surface.colors * self._tints[row], 0.0, 1.0)), label)
