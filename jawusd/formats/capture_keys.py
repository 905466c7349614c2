"""Keys of capture.toml: reference and validation errors, both derived from the pydantic models that read the file."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, Field, ValidationError
from pydantic.fields import FieldInfo

_CLOSE = 0.6  # minimum difflib ratio of a misspelt and a suggested key; 0.89 for "mask" and "masks"
_REFERENCE = "`jawusd init --reference` lists all keys."
_ALLOWED_SHOWN = 300  # maximum length of a list of keys in a message [characters]

T = TypeVar("T")
Location = tuple[int | str, ...]
FrameNumber = Annotated[int, Field(ge=0)]
FrameRate = Annotated[float, Field(gt=0, le=10000)]  # [1/s]
_UNKNOWN = "extra_forbidden"  # pydantic's error type for unknown keys
#: Messages by pydantic's error type; names in braces are keys of the error's context.
_WORDS = {
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be {ge:g} or more",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be {le:g} or less",
    "literal_error": "must be {expected}",
    "string_pattern_mismatch": "is empty or has characters that are not allowed; use only {signs}",
    "string_too_short": "is empty",
    "too_short": "has {actual_length} entries; at least {min_length} are needed",
    "too_long": "has {actual_length} entries; at most {max_length} are allowed",
    "missing": "is missing",
    "too_few": "has too few entries",
}
_NEEDED = (
    (("float", "finite"), "a number is needed"),
    (("int",), "a whole number is needed"),
    (("string",), 'text in quotes is needed, such as "left"'),
    (("path",), 'a path in quotes is needed, such as "left.mp4"'),
    (("bool",), "true or false is needed"),
    (("tuple", "list"), "a list in brackets is needed"),
    (("model", "dict"), "a table is needed"),
)


@dataclass(frozen=True)
class Key:
    """Documentation of one key."""

    meaning: str
    example: str = ""  # example value as written in the file
    unit: str = ""


def key(meaning: str, example: str = "", unit: str = "") -> FieldInfo:
    """Return the annotation of a model field with its documentation (see `Key`)."""
    field: FieldInfo = Field(description=meaning, json_schema_extra={"example": example, "unit": unit})
    return field


@dataclass(frozen=True)
class KeyEntry:
    """One key in the reference of capture.toml."""

    table: str  # table header as written in the file: "", "[scans]" or "[[camera]]"
    name: str
    kind: str  # kind of the value: "text", "number", "path", ...
    default: str  # default value; "" for required keys, "none" for optional keys without a default
    key: Key


def describe_key(field: FieldInfo) -> Key:
    """Return the documentation of a field made by `key`."""
    documented = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    return Key(field.description or "", *(str(documented.get(name, "")) for name in ("example", "unit")))


def entries(
    model: type[BaseModel], table: str = "", prefix: str = "", skipped: tuple[str, ...] = ()
) -> Iterator[KeyEntry]:
    """Yield the keys of a model and of its nested tables, in file order, without the `skipped` fields.

    `table` is the model's header in the file, `prefix` that of keys written in the table above, such as "masks.".
    """
    inner: list[tuple[str, str, type[BaseModel]]] = []
    for field_name, field in model.model_fields.items():
        if field_name in skipped:
            continue
        name = field.alias or field_name
        below, many = table_model(field)
        if below is None or describe_key(field).meaning:
            yield KeyEntry(table, prefix + name, _kind(field.annotation), _default(field), describe_key(field))
        elif table.startswith("[[") and not many:
            inner.append((table, f"{prefix}{name}.", below))
        else:
            written = f"{table.strip('[]')}.{name}".lstrip(".")
            inner.append((_header(written, many), "", below))
    for written, before, below in inner:
        yield from entries(below, written, before, skipped)


def table_model(field: FieldInfo) -> tuple[type[BaseModel] | None, bool]:
    """Return the model of a field that is a table, and whether it is an array of tables."""
    for part in _parts(field.annotation):
        if isinstance(part, type) and issubclass(part, BaseModel):
            return part, False
        if get_origin(part) is tuple:
            item = get_args(part)[0]
            if isinstance(item, type) and issubclass(item, BaseModel):
                return item, True
    return None, False


def _parts(annotation: object) -> list[object]:
    """Return the members of a union type except None, without annotations; for other types, the type itself."""
    if get_origin(annotation) is Annotated:
        return _parts(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return [part for item in get_args(annotation) if item is not NoneType for part in _parts(item)]
    return [annotation]


_NAMES: dict[object, str] = {str: "text", float: "number", int: "whole number", bool: "true or false", Path: "path"}


def _kind(annotation: object) -> str:
    out = []
    for part in _parts(annotation):
        origin, inner = get_origin(part), get_args(part)
        if origin is Literal:
            out.append(" or ".join(json.dumps(value) for value in inner))
        elif origin in (tuple, list):
            out.append(f"list of {_kind(inner[0])}")
        elif origin is dict:
            out.append(f"table of {_kind(inner[1])}")
        elif isinstance(part, type) and issubclass(part, BaseModel):
            out.append("table")
        else:
            out.append(_NAMES.get(part, "text"))
    return " or ".join(out)


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return ""
    if field.default is None or field.default == ():
        return "none"
    return json.dumps(field.default)


def reference_lines(listed: list[KeyEntry], width: int = 100) -> list[str]:
    """Return keys as text: per table a heading; per key a line with name, kind and default, then its meaning."""
    import textwrap

    lines: list[str] = []
    table = None
    for entry in listed:
        if entry.table != table:
            table = entry.table
            lines += ["", table or "(top of the file, before the first table)"]
        unit = f" [{entry.key.unit}]" if entry.key.unit else ""
        need = "required" if entry.default == "" else f"default {entry.default}"
        lines.append(f"  {entry.name}{unit}: {entry.kind}; {need}")
        lines += textwrap.wrap(
            entry.key.meaning, width, initial_indent="      ", subsequent_indent="      ", break_on_hyphens=False
        )
        if entry.key.example:
            lines.append(f"      {entry.name} = {entry.key.example}")
    return lines[1:]


def problems_of(
    error: ValidationError, model: type[BaseModel], data: Mapping[str, object]
) -> list[tuple[str, str | None]]:
    """Return the problems of a model's validation of `data`: sentences that name table and key, and hints or None."""
    found = error.errors()
    unknown = [(problem["loc"][:-1], str(problem["loc"][-1])) for problem in found if problem["type"] == _UNKNOWN]
    deeper = {problem["loc"][:depth] for problem in found for depth in range(len(problem["loc"]))}
    out = []
    for problem in sorted(found, key=lambda problem: problem["type"] != _UNKNOWN):
        location, kind = problem["loc"], problem["type"]
        if kind == "too_short" and location in deeper:
            continue  # errors of the list's entries are reported instead
        if kind == _UNKNOWN:
            out.append(_unknown_key(str(location[-1]), location[:-1], model, place(location[:-1], data)))
        elif kind == "missing" and any(
            table == location[:-1] and _meant(key, [str(location[-1])]) for table, key in unknown
        ):
            continue  # a misspelt key, which is reported as an unknown key
        else:
            out.append(_wrong_value(problem, location, model, data))
    return out


def place(location: Location, data: Mapping[str, object]) -> str:
    """Return a table's name for messages: `[scans]`, `[[camera]] 2 ("left")`, `[[bootstrap.upper]] 1, views 2`."""
    if not location:
        return ""
    at: object = data
    names: list[str] = []
    counted = ""
    for part in location:
        if isinstance(part, int):
            at = at[part] if isinstance(at, list) and part < len(at) else None
            named = at.get("name") if isinstance(at, dict) else None
            label = f' ("{named}")' if isinstance(named, str) else ""
            where = f"[[{'.'.join(names)}]]" if not counted else f"{counted}, {' '.join(names)}"
            counted, names = f"{where.rstrip()} {part + 1}{label}", []
        else:
            at = at.get(part) if isinstance(at, dict) else None
            names.append(part)
    if counted:
        return f"{counted}, {'.'.join(names)}" if names else counted
    return f"[{'.'.join(names)}]"


def _unknown_key(key: str, table: Location, model: type[BaseModel], where: str) -> tuple[str, str | None]:
    """Return the message and hint for an unknown key: the allowed keys, and a suggestion."""
    allowed = _keys(_model_at(table, model))
    inside = f"{where}: " if where else ""
    meant = _meant(key, allowed)
    if meant:
        advice = f'Did you mean "{meant}"?'
    elif where and key in _keys(model):
        advice = f'"{key}" goes at the top of the file, before the first [table].'
    elif owner := _owner(key, model):
        advice = f'"{key}" belongs to {owner}.'
    else:
        advice = _REFERENCE
    listed = ", ".join(allowed if table else ["format", "units", *allowed])
    return f'{inside}unknown key "{key}"; allowed keys: {listed[:_ALLOWED_SHOWN]}.', advice


def _wrong_value(
    problem: Mapping[str, object], location: Location, model: type[BaseModel], data: Mapping[str, object]
) -> tuple[str, str | None]:
    kind, given = str(problem["type"]), problem.get("input")
    context = problem.get("ctx")
    values: dict[str, object] = context if isinstance(context, dict) else {}
    while location and isinstance(location[-1], int) and kind == "missing":
        location, kind, values = location[:-1], "too_few", {}
    if not location or isinstance(location[-1], int) or (kind == "value_error" and _model_at(location, model)):
        name, said = "", place(location, data)
    else:
        name = str(location[-1])
        said = f"{place(location[:-1], data)} {name}".strip()
    if kind == "value_error":
        inside = f"{said}: " if said else ""
        return f"{inside}{str(values.get('error', problem['msg'])).rstrip('.')}.", None
    if kind in ("tuple_type", "list_type") and isinstance(given, dict):
        return f"[{name}] is a single table; write [[{name}]], with double brackets, for each one.", None
    field = _named(location[-1], _model_at(location[:-1], model)) if location else None
    below, many = (None, False) if field is None else table_model(field)
    doc = Key("") if field is None else describe_key(field)
    if below is not None and not doc.meaning and kind == "missing":
        return f"{_header(name, many)} is missing.", _REFERENCE
    words = _WORDS.get(kind)
    if "pattern" in values:
        values = {**values, "signs": _signs(str(values["pattern"]))}
    message = str(problem["msg"])
    needed = next((needed for kinds, needed in _NEEDED if kind.startswith(kinds)), message[:1].lower() + message[1:])
    text = words.format(**{"actual_length": "too many", **values}) if words else needed
    unit = f" ({doc.unit})" if doc.unit and (" number " in text or kind.startswith(("greater", "less"))) else ""
    shows_form = kind not in ("too_long", "too_short", "string_too_short")
    hint = f"For example: {name} = {doc.example}." if doc.example and shows_form else None
    return f"{said or 'the file'}{_found(kind, given)} {text}{unit}.".replace("'", '"'), hint


def _signs(pattern: str) -> str:
    """Return the characters that a pattern of one character class allows; return other patterns unchanged."""
    inside = re.fullmatch(r"\^\[(.+)\]\+\$", pattern)
    if inside is None:
        return f"{pattern.strip('^$')}"
    signs = [sign.removeprefix("\\") for sign in re.findall(r"\w-\w|\\?.", inside[1])]
    return " ".join("spaces" if sign == " " else sign for sign in signs)


def _found(kind: str, given: object) -> str:
    if kind in ("missing", "too_few", "too_short", "too_long") or isinstance(given, dict | list | tuple):
        return "" if kind in _WORDS else ":"
    shown = json.dumps(given, ensure_ascii=False) if isinstance(given, str | bool | int | float) else str(given)
    return f" = {shown:.80}" if kind in _WORDS else f" = {shown:.80}:"


def _meant(key: str, allowed: Iterable[str]) -> str:
    """Return the allowed key most similar to a misspelt one, "" if there is none."""
    plain = {re.sub(r"[^a-z0-9]", "", name.lower()): name for name in allowed}
    close = difflib.get_close_matches(re.sub(r"[^a-z0-9]", "", key.lower()), plain, n=1, cutoff=_CLOSE)
    return plain[close[0]] if close else ""


def _keys(model: type[BaseModel] | None) -> list[str]:
    """Return the keys of a model as written in the file; the folder of a capture is not written."""
    fields = {} if model is None else model.model_fields
    return [field.alias or name for name, field in fields.items() if name != "folder"]


def _model_at(table: Location, model: type[BaseModel]) -> type[BaseModel] | None:
    at: type[BaseModel] | None = model
    for part in table:
        if isinstance(part, str):
            field = _named(part, at)
            at = None if field is None else table_model(field)[0]
    return at


def _named(key: int | str, model: type[BaseModel] | None) -> FieldInfo | None:
    fields = {} if model is None else model.model_fields
    return next((field for name, field in fields.items() if key in (name, field.alias)), None)


def _owner(key: str, model: type[BaseModel]) -> str:
    """Return the name, as written in the file, of the table that contains a key, or "" if there is none."""
    for name, field in model.model_fields.items():
        below, many = table_model(field)
        if below is not None and key in _keys(below):
            return _header(field.alias or name, many)
    return ""


def _header(name: str, many: bool) -> str:
    return f"[[{name}]]" if many else f"[{name}]"
