"""A person's own mapping from ARKit's jaw weights to d: a JSON file, format jawusd-arkit/1."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from jawusd.base.arrays import Array
from jawusd.base.tables import read_text
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.text import parse_model

_MAX_BYTES = 1 << 20
_WITHIN = "numbers within +-10000"
_Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e4, le=1e4)]
_Weights = tuple[_Number, _Number, _Number, _Number]


class ArkitMapping(BaseModel):
    """Hold what the weights of one person mean; four numbers are of JawOpen, JawLeft, JawRight, JawForward.

    d = rest_mm + (gain_mm + u_open * opened_gain_mm) @ u, where u is how far each weight is from its neutral value,
    less the dead zone, and 0 inside of it; u_open is JawOpen's. What a gain says of another direction than its weight's
    own is the cross-talk; opened gains, because reach to the sides and forward changes as the jaw opens.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["jawusd-arkit/1"] = Field("jawusd-arkit/1", description='"jawusd-arkit/1"')
    actor: str = Field(description="the actor's name")
    neutral: _Weights = Field(description=f"four {_WITHIN}")
    dead_zone: tuple[Annotated[_Number, Field(ge=0)], ...] = Field(
        min_length=4, max_length=4, description=f"four {_WITHIN}, none below 0"
    )
    rest_mm: tuple[_Number, _Number, _Number] = Field(description=f"three {_WITHIN} [mm]")
    gain_mm: tuple[_Weights, _Weights, _Weights] = Field(description=f"three rows of four {_WITHIN} [mm]")
    opened_gain_mm: tuple[_Weights, _Weights, _Weights] = Field(description=f"three rows of four {_WITHIN} [mm]")

    def d(self, weights: Array) -> Array:
        """Return the jaw parameters [mm], shape (..., 3), of weights (..., 4); NaN gives NaN."""
        gains = np.concatenate([self.gain_mm, self.opened_gain_mm], axis=1)
        moved = moved_terms(weights, np.array(self.neutral), np.array(self.dead_zone))
        return np.array(self.rest_mm) + moved @ gains.T


def moved_terms(weights: Array, neutral: Array, dead_zone: Array) -> Array:
    """Return u and u_open * u of weights (..., 4), see `ArkitMapping`, shape (..., 8)."""
    change = weights - neutral
    u = np.sign(change) * np.maximum(np.abs(change) - dead_zone, 0.0)
    return np.concatenate([u, u[..., :1] * u], axis=-1)


def load_mapping(path: str | os.PathLike[str]) -> ArkitMapping:
    """Read a mapping.

    Raises:
        FormatError: not such a file; the message names the entry.
    """
    path = Path(path)
    hint = "Such a file is written by `jawusd arkit-fit`."
    return parse_model(read_text(path, _MAX_BYTES), path, ArkitMapping, hint)


def save_mapping(path: str | os.PathLike[str], mapping: ArkitMapping) -> None:
    """Write a mapping atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    write_text_atomic(path, json.dumps(mapping.model_dump(mode="json"), indent=1) + "\n")
