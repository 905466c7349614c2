"""Read TOML and JSON and check their values; errors name the file."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from jawusd.base.errors import AnyPath, FormatError, errors_name_file
from jawusd.base.tables import read_text
from jawusd.formats.capture_keys import table_model

Model = TypeVar("Model", bound=BaseModel)


class Strict(BaseModel):
    """Base class of the content of files: immutable, and unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True, populate_by_name=True)


_MOST_TOML_BYTES = 4 << 20
_SHOWN = 80  # maximum length of a quoted line in messages [characters]
# Maximum number of parts of a dotted key; tomllib needs quadratic time, which is hours for a key of 200 kB.
_MOST_DOTS = 64
_NAME = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:{_NAME}[ \t]*+\.[ \t]*+){{{_MOST_DOTS}}}", re.ASCII)
T = TypeVar("T")
#: Frame offset of a camera.
Frames = Annotated[int, Field(ge=-10_000_000, le=10_000_000)]


def read_toml(path: AnyPath) -> dict[str, object]:
    """Return the content of a TOML file.

    Raises:
        FormatError: the file is missing, too large, not text or not TOML.
    """
    path = Path(path)
    text = read_text(path, _MOST_TOML_BYTES)
    if _LONG_KEY.search(text):
        raise FormatError(f"has a dotted key with more than {_MOST_DOTS} parts.", path=path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # raised also for numbers of more than 4300 digits
        said, hint = _not_toml(text, str(error))
        raise FormatError(f"is not valid TOML: {said}.", path=path, hint=hint) from error


def _not_toml(text: str, said: str) -> tuple[str, str]:
    place = re.search(r" \(at line (\d+), column \d+\)$", said)
    line = text.split("\n")[int(place[1]) - 1].strip() if place else ""
    if place:
        said = f"line {place[1]}, {line[:_SHOWN]}: {said[: place.start()]}"
    if "\\" in line:
        return said, 'Write paths with slashes, such as "video/left.mp4", also on Windows.'
    if re.search("[\u2018-\u201f\u00ab\u00bb]", line):
        return said, 'Write straight quotes, such as name = "anna"; word processors replace them with curly ones.'
    return said, 'Write text in quotes, such as name = "anna", and tables in brackets, such as [scans].'


@errors_name_file
def read_json(path: Path, most_bytes: int) -> object:
    """Return the content of a JSON file of at most `most_bytes`.

    Raises:
        FormatError: the file is missing, too large, not text or not JSON.
    """
    text = read_text(path, most_bytes)
    if not text.strip():
        raise FormatError("is empty.")
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        line = text.split("\n")[error.lineno - 1].strip()
        before = text[: error.pos].rstrip()[-1:]
        hint = "Put names and text in straight double quotes, and commas between entries but not after the last."
        if re.match(r"//|/\*|#", text[error.pos :]):
            hint = "Remove comments: JSON has none."
        elif before == ",":
            hint = "Remove the comma before it, or add the missing entry."
        said = f"line {error.lineno}, {line[:_SHOWN]}: {error.msg}" if line else f"line {error.lineno}: {error.msg}"
        raise FormatError(f"is not JSON: {said}.", hint=hint) from error
    except (ValueError, RecursionError) as error:  # raised for numbers of more than 4300 digits, and for deep nesting
        raise FormatError(f"is not JSON ({error}).") from error


def read_model(path: AnyPath, most_bytes: int, model: type[Model], hint: str | None = None) -> Model:
    """Read a JSON file of at most `most_bytes` as a pydantic model, whose field descriptions are used in messages.

    Raises:
        FormatError: the file is not JSON, or a value is missing or wrong.
    """
    try:
        return model.model_validate(read_json(Path(path), most_bytes))
    except ValidationError as error:
        raise FormatError(f"{_fault(error, model)}.", path=path, hint=hint) from error


def _fault(error: ValidationError, model: type[BaseModel]) -> str:
    """Return the message for a validation error, such as `keys, entry 1: d needs three numbers`."""
    problem = error.errors()[0]
    kind, given = problem["type"], problem["input"]
    names: list[str] = []
    needed = "a JSON object"
    above: type[BaseModel] | None = model
    at: type[BaseModel] | None = model
    for part in problem["loc"]:
        if isinstance(part, str):
            field = None if at is None else at.model_fields.get(part)
            names.append(part)
            above, at = at, None if field is None else table_model(field)[0]
            needed = (field and field.description) or problem["msg"]
        elif at is not None:
            names.append(f"entry {part + 1}")
            needed = "a JSON object"
    name = names.pop() if names else "the file"
    where = f"{', '.join(names)}: " if names else ""
    if kind == "value_error":
        return str(problem["ctx"]["error"])
    if kind == "extra_forbidden" and above is not None:
        return f'{where}unknown key "{name}"; allowed keys: {", ".join(above.model_fields)}'
    found = "" if isinstance(given, dict) else f", found {json.dumps(given, default=str):.{_SHOWN}}"
    return f"{where}{name} needs {needed}{found}"


def of_kind(found: object, kind: type[T], name: str, path: AnyPath, hint: str) -> T:
    """Return a named value of a JSON file, validated against a type.

    Raises:
        FormatError: the value has another type.
    """
    try:
        return TypeAdapter(kind).validate_python(found)
    except ValidationError as error:
        fault = error.errors()[0]
        where = ".".join(map(str, (name, *fault["loc"])))
        raise FormatError(f"is damaged ({where}: {fault['msg']}).", path=path, hint=hint) from error
