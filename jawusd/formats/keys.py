"""Animation keys in `keys.json`: jaw parameters d at chosen frames."""

from __future__ import annotations

import json
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.text import Strict, read_model

#: Maximum number of frames, all of which are baked (an hour at 60 frames per second), and maximum frame number.
MOST_FRAMES, FARTHEST_FRAME = 220_000, 1e9
#: Frame rate of motions whose rate is not known [1/s].
DEFAULT_FPS = 24.0
_MAX_BYTES = 64 << 20
#: Maximum magnitude of a jaw parameter [mm]; larger values overflow when they are projected into the bound.
FARTHEST_MM = 1e6
Finite = Annotated[float, Field(allow_inf_nan=False)]
_Parameter = Annotated[float, Field(allow_inf_nan=False, ge=-FARTHEST_MM, le=FARTHEST_MM)]


class Key(Strict):
    """Animation key: the jaw parameters d [mm] at one frame, and optionally their slopes."""

    frame: Finite = Field(description="a number")
    d: tuple[_Parameter, _Parameter, _Parameter] = Field(
        description="three numbers: d1, d2, d3 (opening, laterotrusion, protrusion) [mm], "
        f"each within +-{FARTHEST_MM:g}"
    )
    tangents: tuple[_Parameter | None, _Parameter | None, _Parameter | None] | None = Field(
        None,
        description="three numbers: slopes of d1, d2, d3 at the key [mm per frame], used by smooth interpolation; null "
        "and without this entry: the slope with which the curve is monotone between keys",
    )


class Keys(Strict):
    """Animation with keys at strictly increasing frames, at `fps` frames per second."""

    fps: float = Field(gt=0, le=10000, allow_inf_nan=False, description="a number above 0, at most 10000 [1/s]")
    interpolation: Literal["linear", "smooth"] = Field("linear", description='"linear" or "smooth"')
    keys: tuple[Key, ...] = Field(min_length=1, description='a list of keys, such as [{"frame": 0, "d": [0, 0, 0]}]')

    @model_validator(mode="after")
    def _rising(self) -> Keys:
        frames = [key.frame for key in self.keys]
        if frames[-1] - frames[0] > MOST_FRAMES or max(abs(frames[0]), abs(frames[-1])) > FARTHEST_FRAME:
            found = f"frames {frames[0]:g} to {frames[-1]:g}"
            raise ValueError(f"{found}; they must span at most {MOST_FRAMES} frames within +-{FARTHEST_FRAME:g}")
        for before, after in zip(frames, frames[1:], strict=False):
            if after <= before:
                raise ValueError(f"frames must increase, but frame {after:g} follows {before:g}")
        return self

    def arrays(self) -> tuple[Array, Array]:
        """Return the key frames (K,) and their jaw parameters d [mm] (K, 3)."""
        return np.array([key.frame for key in self.keys]), np.array([key.d for key in self.keys])

    def tangents(self) -> Array:
        """Return the slopes of d at the keys [mm per frame] (K, 3); NaN where they are not given."""
        return np.array([[np.nan] * 3 if key.tangents is None else key.tangents for key in self.keys], dtype=np.float64)


def load_keys(path: AnyPath) -> Keys:
    """Read animation keys.

    Raises:
        FormatError: the file does not contain animation keys; the message names the wrong entry.
    """
    return read_model(path, _MAX_BYTES, Keys)


def save_keys(path: AnyPath, keys: Keys) -> None:
    """Write animation keys atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    write_text_atomic(path, json.dumps(keys.model_dump(mode="json", exclude_none=True), indent=1) + "\n")
