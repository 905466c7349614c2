"""Authoring with a rig: curves between key frames, slider ranges, and ranges normalised for retargeting."""

from __future__ import annotations

from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.evaluator.arrays import RigArrays
from jawusd.evaluator.batching import as_floats, as_keys, as_rows, in_chunks, pairs_in_chunks
from jawusd.evaluator.bounds import Ranges, SliceHull, denormalized, normalized
from jawusd.evaluator.clamping import Inside, kept_inside
from jawusd.evaluator.interpolation import interpolated
from jawusd.evaluator.search import nearest_distance


class RigAuthoring(RigArrays):
    """Authoring functions of a rig: motions of d, and ranges within the bound.

    Attributes:
        bound: The slice bound.
    """

    bound: SliceHull

    def interpolate(
        self,
        frames: ArrayLike,
        d_keys: ArrayLike,
        at: ArrayLike,
        method: Literal["linear", "smooth"] = "linear",
        *,
        inside: bool = True,
    ) -> Array:
        """Return jaw parameters between keys.

        Args:
            frames: Increasing key times, shape (K,).
            d_keys: Jaw parameters [mm] at the keys, shape (K, 3).
            at: Query times, any shape; before the first key and after the last one, d is constant.
            method: "linear" for straight lines in d as in the paper, or "smooth" for a C1 curve, monotone between keys.
            inside: Where the smooth curve between two valid keys would leave the bound, follow the bound instead; the
                curve is then only continuous. See `keep_inside` for keys outside the bound.

        Returns:
            Jaw parameters [mm], shape (*at.shape, 3).

        Raises:
            ValueError: wrong shapes, keys that are not finite, frames that do not increase, or an unknown method.
        """
        frames, keys = as_keys(frames, d_keys)
        times, batch = as_rows(as_floats(at, "at")[..., None], (1,), "at")
        d = interpolated(frames, keys, times[:, 0], method, self.bound if inside else None)
        return d.reshape(*batch, 3)

    def keep_inside(self, times: ArrayLike, d: ArrayLike) -> Inside:
        """Return a motion clamped to the bound, both at its samples and on the straight lines between them.

        Poses outside the bound are moved inside continuously, and no step becomes more than 5 % longer than in the
        given motion. Where the path inside the bound is too long for this limit, the motion just before and after it is
        retimed as well.

        Args:
            times: Increasing sample times, shape (F,).
            d: Jaw parameters [mm], interpolated linearly, shape (F, 3).

        Returns:
            The samples at the given times, and additional ones where straight lines between them would leave the bound.

        Raises:
            ValueError: wrong shapes, samples that are not finite, or times that do not increase.
            EvaluatorError: the bound of the rig is empty.
        """
        return kept_inside(self.bound, *as_keys(times, d))

    def ranges(self, d1: ArrayLike, d2: ArrayLike = 0.0, d3: ArrayLike = 0.0) -> Ranges:
        """Return the valid ranges of d2 and of d3, each varied with the other two parameters fixed.

        Args:
            d1: Opening [mm]; d1, d2, d3 broadcast to one shape (...).
            d2: Laterotrusion [mm] while d3 varies.
            d3: Protrusion [mm] while d2 varies.

        Returns:
            The limits [mm]; NaN where no value is valid. The bound ends a few tenths of a mm inside ``d_range[0]``;
            beyond its ends, the limits at the nearest valid opening are returned.
        """
        each = (as_floats(x, name) for x, name in ((d1, "d1"), (d2, "d2"), (d3, "d3")))
        d = np.stack(np.broadcast_arrays(*each), axis=-1)
        rows, batch = as_rows(d, (3,), "d")
        within = (rows[:, 0] >= self.d_range[0, 0]) & (rows[:, 0] <= self.d_range[0, 1])
        rows = np.where(within[:, None], in_chunks(self.bound.nearest_opening, rows), rows)
        ends = [pairs_in_chunks(partial(self.bound.chord, axis=axis), rows) for axis in (1, 2)]
        return Ranges(*(end.reshape(batch) for pair in ends for end in pair))

    def normalized(self, d: ArrayLike) -> Array:
        """Return d as fractions of this subject's ranges, for retargeting to another subject.

        The opening is divided by the full opening; d2 and d3 are divided by the range on their side of the habitual
        path at that opening (at least 0.5 mm).

        Args:
            d: Jaw parameters [mm], shape (..., 3).

        Returns:
            Fractions, shape (..., 3): 1 is the full range.
        """
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(lambda d: normalized(self.bound, self.d_range, d), rows).reshape(*batch, 3)

    def denormalized(self, shares: ArrayLike) -> Array:
        """Return the jaw parameters [mm], shape (..., 3), of fractions (..., 3): the inverse of `normalized`."""
        rows, batch = as_rows(shares, (3,), "shares")
        return in_chunks(lambda n: denormalized(self.bound, self.d_range, n), rows).reshape(*batch, 3)

    def captured_distance(self, d: ArrayLike) -> Array:
        """Return the distance (...) [mm] from d (..., 3) to the d of the nearest captured pose; inf if none."""
        rows, batch = as_rows(d, (3,), "d")
        return in_chunks(lambda d: nearest_distance(self.captured_d, d), rows).reshape(batch)

    def landmark_sigma_mm(self, d: ArrayLike) -> Array:
        """Return the root mean square error of the model at its landmarks, shape (..., n) [mm]; 0 if unknown.

        It was estimated from held-out frames, and grows with the distance from the captured poses.

        Args:
            d: Jaw parameters [mm], shape (..., 3).
        """
        near_mm, growth = self.error_growth.T
        distance_mm = self.captured_distance(d)[..., None] if len(self.captured_d) else 0.0
        return np.asarray(near_mm + growth * distance_mm)
