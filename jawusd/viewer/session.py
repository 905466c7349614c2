"""State of one visitor's work on a rig, independent of the page: parameters, pins, keys and undo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.formats.keys import DEFAULT_FPS, Keys
from jawusd.geometry import LANDMARKS
from jawusd.geometry.se3 import se3_inverse, transform_point
from jawusd.viewer.motion import Clip, KeyTrack, at_frames, with_key
from jawusd.viewer.readouts import Readout, measure_pose, triple

Interpolation = Literal["linear", "smooth"]

# Weight of a pinned landmark's squared distance relative to that of the dragged point: dragging by 5 mm moves the
# pinned landmark by a fraction of a millimetre.
_PIN_WEIGHT = 100.0
# Cosine of the angle between viewing direction and vertical above which a view counts as from above or below.
_STEEP = 0.8
_MOST_UNDO = 200
_SHARES = np.linspace(1.0, 0.0, 65)


@dataclass(frozen=True)
class Pin:
    """Position of a landmark at the time it was pinned, in the mandible and in the skull frame [mm]."""

    name: str
    p_mandible: tuple[float, float, float]
    p_skull: tuple[float, float, float]


@dataclass(frozen=True)
class Work:
    """The state that undo restores."""

    d: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pins: tuple[Pin, ...] = ()
    keys: KeyTrack = ()
    fps: float = DEFAULT_FPS
    interpolation: Interpolation = "smooth"


class Session:
    """Posing, dragging and keying of a rig by one visitor; with `keep_valid`, sliders stay inside the bound."""

    def __init__(self, rig: JawRig, fps: float) -> None:
        self.rig = rig
        self.work = Work(d=triple(rig.project(np.zeros(3))), fps=fps)
        self.keep_valid = True
        self._undo: list[Work] = []
        self._redo: list[Work] = []
        self._gesture: str | None = None
        self._handle: Array | None = None
        self._played: tuple[tuple[Keys, bool], Clip] | None = None  # cached clip and the keys it was made from

    @property
    def d(self) -> Array:
        """Return the current parameters [mm], shape (3,)."""
        return np.array(self.work.d)

    @property
    def dragging(self) -> bool:
        """Return whether a point of the mandible is grabbed."""
        return self._handle is not None

    def pose(self) -> Array:
        """Return the current T_skull_mandible, shape (4, 4)."""
        return self.rig.pose(self.d)

    def readout(self) -> Readout:
        """Return the measures of the current pose."""
        return measure_pose(self.rig, self.d)

    def limits(self) -> Array:
        """Return the lower and upper limit of each parameter [mm], shape (3, 2).

        Those of d1 are its full range; those of d2 and d3 enclose valid poses with the other parameters as they are, or
        with the other one of d2 and d3 at 0. If there are none, both limits are the current value.
        """
        d = self.d
        found, alone = np.moveaxis(np.reshape(self.rig.ranges(d[0], [d[1], 0.0], [d[2], 0.0]), (2, 2, 2)), 2, 0)
        for other in (alone, d[1:, None]):
            found = np.where(np.isfinite(found).all(axis=1, keepdims=True), found, other)
        return np.vstack([self.rig.d_range[0], found])

    def set_parameter(self, index: int, value: float) -> None:
        """Set d1, d2 or d3 (index 0 .. 2) [mm] from a slider; successive moves of one slider are a single undo step.

        With `keep_valid`, a change of the opening scales d2 and d3 down; changes of d2 and d3 stop at the bound. Raises
        ValueError if the value is not finite.
        """
        if not np.isfinite(value):
            raise ValueError(f"d{index + 1} must be finite, got {value}")
        d = self.d
        d[index] = value
        kept = self._kept(d, index) if self.keep_valid else d
        self._change(f"d{index + 1}", replace(self.work, d=triple(kept)))

    def set_pose(self, d: ArrayLike) -> None:
        """Set all parameters [mm] (3,); with `keep_valid` they are clamped to the bound."""
        d = np.asarray(d, dtype=np.float64)
        self._change(None, replace(self.work, d=triple(self._inside(d) if self.keep_valid else d)))

    def show(self, d: ArrayLike) -> None:
        """Show parameters [mm] (3,) of a motion, unchanged and without an undo step."""
        self.work = replace(self.work, d=triple(np.asarray(d, dtype=np.float64)))
        self._gesture = None

    def set_keep_valid(self, keep: bool) -> None:
        """Set whether sliders stay inside the bound; switching it on clamps the pose."""
        self.keep_valid = bool(keep)
        self._gesture = None
        if keep and not self.rig.is_inside(self.d):
            self.set_pose(self.d)

    def _inside(self, d: Array) -> Array:
        return d if self.rig.is_inside(d) else self.rig.project(d)

    def _kept(self, d: Array, index: int) -> Array:
        """Return d (3,) clamped to the bound while changing parameter `index` as little as possible."""
        if float(self.rig.margin(d)) >= 0.0:
            return d
        d = d.copy()
        if index == 0:
            d[0] = np.clip(d[0], *self.rig.d_range[0])
            tried = d * np.stack([np.ones_like(_SHARES), _SHARES, _SHARES], axis=1)
            valid = np.flatnonzero(self.rig.margin(tried) >= 0.0)
            return tried[valid[0]] if valid.size else self.rig.project(d)
        ends = np.array(self.rig.ranges(*d))[2 * (index - 1) : 2 * index]
        if np.isfinite(ends).all():
            d[index] = np.clip(d[index], *ends)
        return self._inside(d)

    def grab(self, p_skull: ArrayLike) -> None:
        """Grab the point of the mandible at p_skull [mm] in the skull frame, shape (3,)."""
        self._handle = transform_point(se3_inverse(self.pose()), np.asarray(p_skull, dtype=np.float64))
        self._gesture = None

    def drag_to(self, p_skull: ArrayLike, sight: ArrayLike | None = None) -> Array:
        """Move the grabbed point to the pointer at p_skull (3,) [mm], by inverse kinematics that respects the pins.

        With a viewing direction `sight` (3,), the point moves to the line through p_skull in this direction, and its
        depth follows the habitual path; without it, or if the view is from above or below, so that its depth is the
        opening, it moves to p_skull itself. Returns the target that it was moved towards, shape (3,) [mm]. Positions
        and directions are in the skull frame. Raises RuntimeError if nothing is grabbed.
        """
        if self._handle is None:
            raise RuntimeError("`drag_to` was called before `grab`")
        target = np.asarray(p_skull, dtype=np.float64)
        look = np.zeros(3) if sight is None else np.asarray(sight, dtype=np.float64)
        if abs(self.rig.T_anatomical_skull[1, :3] @ look) > _STEEP * np.linalg.norm(look):
            look = np.zeros(3)
        handles = np.array([self._handle, *(pin.p_mandible for pin in self.work.pins)])
        targets = np.array([target, *(pin.p_skull for pin in self.work.pins)])
        weights = [1.0] + [_PIN_WEIGHT] * len(self.work.pins)
        free = np.vstack([look, np.zeros((len(self.work.pins), 3))])
        d, _ = self.rig.ik(handles, targets, start=self.d, weights=weights, sight=free)
        self._change("drag", replace(self.work, d=triple(d)))
        held = transform_point(self.rig.pose(d), self._handle)
        return target + look * (float(look @ (held - target)) / max(float(look @ look), 1e-300))

    def release(self) -> None:
        """Release the grabbed point."""
        self._handle = None
        self._gesture = None

    def grabbed_point(self) -> Array | None:
        """Return the position of the grabbed point [mm], skull frame, shape (3,); None if nothing is grabbed."""
        return None if self._handle is None else transform_point(self.pose(), self._handle)

    def set_pin(self, name: str, on: bool) -> None:
        """Pin or unpin one of `geometry.LANDMARKS`. Pins constrain dragging, not sliders."""
        pins = tuple(pin for pin in self.work.pins if pin.name != name)
        if on:
            place = self.rig.landmarks[LANDMARKS.index(name)]
            pins += (Pin(name, triple(place), triple(transform_point(self.pose(), place))),)
        self._change(None, replace(self.work, pins=pins))

    def set_keys(self, keys: KeyTrack) -> None:
        """Replace the keys."""
        self._change(None, replace(self.work, keys=keys))

    def move_keys(self, frames: Sequence[float], shown: float) -> None:
        """Move the keys to other frames and show the frame `shown`; successive moves are a single undo step.

        Raises like `motion.at_frames`.
        """
        self._change("move keys", replace(self.work, keys=at_frames(self.work.keys, frames)))
        clip = self.key_clip()
        if clip is not None:
            self.work = replace(self.work, d=triple(clip.at(shown)))

    def add_key(self, frame: float) -> None:
        """Set a key with the current pose at a frame, replacing any key there."""
        self.set_keys(with_key(self.work.keys, frame, self.work.d))

    def load_keys(self, loaded: Keys) -> None:
        """Replace the keys, the frame rate and the interpolation with those of a file."""
        work = replace(self.work, keys=loaded.keys, fps=loaded.fps, interpolation=loaded.interpolation)
        self._change(None, work)

    def set_interpolation(self, interpolation: Interpolation) -> None:
        """Set the interpolation between keys."""
        self._change(None, replace(self.work, interpolation=interpolation))

    def set_fps(self, fps: float) -> None:
        """Set the frames per second; raises ValueError if they are out of range."""
        if not 0 < fps <= 1000:
            raise ValueError(f"fps must be above 0 and at most 1000, got {fps}")
        self._change("fps", replace(self.work, fps=float(fps)))

    def saved_keys(self) -> Keys | None:
        """Return the keys in the form in which they are saved; None without keys."""
        work = self.work
        return Keys(fps=work.fps, interpolation=work.interpolation, keys=work.keys) if work.keys else None

    def key_clip(self) -> Clip | None:
        """Return the keys' animation as `jawusd animate` writes it, clamped if `keep_valid`; None without keys."""
        saved = self.saved_keys()
        if saved is None:
            return None
        if self._played is None or self._played[0] != (saved, self.keep_valid):
            self._played = (saved, self.keep_valid), self._clip_of(saved)
        return self._played[1]

    def _clip_of(self, saved: Keys) -> Clip:
        frames, d_keys = saved.arrays()
        times = np.union1d(np.arange(np.ceil(frames[0]), np.floor(frames[-1]) + 1), frames)
        d = self.rig.interpolate(frames, d_keys, times, saved.interpolation, inside=False, tangents=saved.tangents())
        if self.keep_valid:
            times, d, _ = self.rig.keep_inside(times, d)
        return Clip("keys", times, d, saved.fps)

    def undo(self) -> bool:
        """Undo the last change; return whether there was one."""
        return self._step(self._undo, self._redo)

    def redo(self) -> bool:
        """Redo the last undone change; return whether there was one."""
        return self._step(self._redo, self._undo)

    def _step(self, source: list[Work], other: list[Work]) -> bool:
        if not source:
            return False
        other.append(self.work)
        self.work = source.pop()
        self._gesture = None
        return True

    def _change(self, gesture: str | None, work: Work) -> None:
        """Replace the undoable state; successive changes of one gesture are a single undo step."""
        if gesture is None or gesture != self._gesture:
            self._undo.append(self.work)
            del self._undo[:-_MOST_UNDO]
        self._redo.clear()
        self._gesture = gesture
        self.work = work
