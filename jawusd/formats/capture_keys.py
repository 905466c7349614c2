"""What the keys of a capture.toml mean, and the list of all of them, made from the models that read the file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo


@dataclass(frozen=True)
class Key:
    """Describe one key of a file to people: stands in the annotation of the model's field."""

    meaning: str
    example: str = ""  # as written in the file, to the right of the =
    unit: str = ""


@dataclass(frozen=True)
class KeyEntry:
    """Hold one key of the reference."""

    table: str  # as the file writes it: "", "[scans]", "[[camera]]"
    name: str
    kind: str  # "text", "number", "path", ...
    default: str  # "" if it must be given, "none" if leaving it out means something of its own
    key: Key


def describe_key(field: FieldInfo) -> Key:
    """Return what a field's annotation says of it."""
    return next((item for item in field.metadata if isinstance(item, Key)), Key(""))


def entries(
    model: type[BaseModel], table: str = "", prefix: str = "", skipped: tuple[str, ...] = ()
) -> Iterator[KeyEntry]:
    """Yield the keys of a model and of the tables in it, in the order of the file.

    Args:
        model: the model of the table.
        table: what the file calls it.
        prefix: what comes before its keys, where they are written in the table above: "masks.".
        skipped: fields that are not read from the file.
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
            inner.append((f"[[{written}]]" if many else f"[{written}]", "", below))
    for written, before, below in inner:
        yield from entries(below, written, before, skipped)


def table_model(field: FieldInfo) -> tuple[type[BaseModel] | None, bool]:
    """Return the model of a field that is a table of its own, and whether there may be several of them."""
    for part in _parts(field.annotation):
        if isinstance(part, type) and issubclass(part, BaseModel):
            return part, False
        if get_origin(part) is tuple:
            item = get_args(part)[0]
            if isinstance(item, type) and issubclass(item, BaseModel):
                return item, True
    return None, False


def _parts(annotation: object) -> list[object]:
    """Return the members of a union without None, annotations taken off; other types alone."""
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
    """Return keys as text: a heading per table, a line with name, kind and default per key, its meaning below."""
    import textwrap

    lines: list[str] = []
    table = None
    for entry in listed:
        if entry.table != table:
            table = entry.table
            lines += ["", table or "(top of the file, before the first table)"]
        unit = f" [{entry.key.unit}]" if entry.key.unit else ""
        need = "must be given" if entry.default == "" else f"default {entry.default}"
        lines.append(f"  {entry.name}{unit}: {entry.kind}; {need}")
        lines += textwrap.wrap(
            entry.key.meaning, width, initial_indent="      ", subsequent_indent="      ", break_on_hyphens=False
        )
        if entry.key.example:
            lines.append(f"      {entry.name} = {entry.key.example}")
    return lines[1:]
