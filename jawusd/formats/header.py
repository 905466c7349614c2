"""Check the JSON that jawusd stores: what readers use of it has the types that writers gave it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from jawusd.base.errors import FormatError

T = TypeVar("T")
#: Frames that a camera is off by.
Frames = Annotated[int, Field(ge=-10_000_000, le=10_000_000)]

_Table = dict[str, dict[str, float]]
_ByCamera = dict[str, list[float]]


class _Header(BaseModel):
    """Values that are missing, or of other names, are no faults: other programs and older versions lack them."""

    model_config = ConfigDict(strict=True, extra="ignore")


class _Warning(_Header):
    code: str
    message: str


class _Registration(_Header):
    applied: bool
    frames: list[int]
    shift_mm: list[float]
    turn_deg: list[float]
    T: list[list[float]]


class ModelHeader(_Header):
    """The header of a model."""

    actor: str = ""
    method: str = ""
    fps: float | None = None
    warnings: list[_Warning] = []
    errors: dict[str, _Table] = {}
    uncertainty: _Table = {}
    excluded_frames: dict[str, list[int]] = {}
    trimmed_frames: list[int] = []
    inferred: list[str] = []
    registration: _Registration | None = None


class TracksHeader(_Header):
    """The header of tracks."""

    fps: float | None = None
    tolerance_mm: float = 0.0
    prior_spread_mm: float = 0.0
    correlation_px: float = 0.0
    findings: list[dict[str, str | float | int]] = []
    start: dict[str, object] = {}
    focal: _ByCamera = {}
    delays_frames: dict[str, float] = {}
    outline_bias_px: _ByCamera = {}
    gum_bias_px: _ByCamera = {}
    gum_line_mm: list[float] = []
    calibration_rescaled_px: dict[str, list[list[int]]] = {}
    registration: _Registration | None = None


def check_header(meta: Mapping[str, object], kind: type[_Header], path: str | os.PathLike[str]) -> None:
    """Check the values of a header.

    Raises:
        FormatError: one has another type than its readers expect.
    """
    try:
        kind.model_validate(meta)
    except ValidationError as error:
        fault = error.errors()[0]
        name = ".".join(map(str, fault["loc"]))
        raise FormatError(f'"meta" has no readable "{name}": {fault["msg"]}.', path=path) from error


def of_kind(found: object, kind: type[T], name: str, path: str | os.PathLike[str], hint: str) -> T:
    """Return a value of a JSON file by a name as a kind, as a typed dictionary.

    Raises:
        FormatError: it is of another kind.
    """
    try:
        return TypeAdapter(kind).validate_python(found)
    except ValidationError as error:
        fault = error.errors()[0]
        where = ".".join(map(str, (name, *fault["loc"])))
        raise FormatError(f"is damaged ({where}: {fault['msg']}).", path=path, hint=hint) from error
