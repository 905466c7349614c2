"""Animation keys: `keys.json`, parameters d at chosen frames."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from jawusd.errors import FormatError
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.text import read_text
from jawusd.geometry.arrays import Array

#: Keys are written out frame by frame: an hour at 60 per second fits.
MOST_FRAMES, FARTHEST_FRAME = 220_000, 1e9
_MAX_BYTES = 64 << 20
#: Largest parameter [mm], a kilometre: squares and products of larger ones overflow on the way into the bound.
FARTHEST_MM = 1e6
Finite = Annotated[float, Field(allow_inf_nan=False)]
_Parameter = Annotated[float, Field(allow_inf_nan=False, ge=-FARTHEST_MM, le=FARTHEST_MM)]


class Key(BaseModel):
    """Hold the parameters d [mm] at one frame."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    frame: Finite
    d: tuple[_Parameter, _Parameter, _Parameter]


class Keys(BaseModel):
    """Hold an animation: frames rise strictly, `fps` frames per second."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    fps: Annotated[float, Field(gt=0, le=10000, allow_inf_nan=False)]
    interpolation: Literal["linear", "smooth"] = "linear"
    keys: Annotated[tuple[Key, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _rising(self) -> Keys:
        frames = [key.frame for key in self.keys]
        if frames[-1] - frames[0] > MOST_FRAMES or max(abs(frames[0]), abs(frames[-1])) > FARTHEST_FRAME:
            found = f"frames {frames[0]:g} to {frames[-1]:g}"
            raise ValueError(f"{found}: allowed are {MOST_FRAMES} within +-{FARTHEST_FRAME:g}")
        for before, after in zip(frames, frames[1:], strict=False):
            if after <= before:
                raise ValueError(f"frames must rise, frame {after:g} follows {before:g}")
        return self

    def arrays(self) -> tuple[Array, Array]:
        """Return the key frames (K,) and their parameters d [mm] (K, 3)."""
        return np.array([key.frame for key in self.keys]), np.array([key.d for key in self.keys])


def load_keys(path: str | os.PathLike[str]) -> Keys:
    """Read animation keys.

    Raises:
        FormatError: not such a file; the message names the entry.
    """
    path = Path(path)
    text = read_text(path, _MAX_BYTES)
    try:
        return Keys.model_validate_json(text)
    except ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(str(part) for part in problem["loc"])
        raise FormatError(f"{where or 'the file'}: {problem['msg']}.", path=path) from error


def save_keys(path: str | os.PathLike[str], keys: Keys) -> None:
    """Write animation keys atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    write_text_atomic(path, json.dumps(keys.model_dump(mode="json"), indent=1) + "\n")
