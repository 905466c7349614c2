"""Read the nodes of a Nuke script, with their knobs and connections.

A script is a list of nodes: `Class {`, one knob per line, `}`. A node pops its inputs from a stack (one unless `inputs`
is given) and pushes itself; `set` names a node, and `push` pushes a named node again. Knobs with default values are
omitted. The value of an animated knob is a curve such as `{curve x1001 0.5 x1002 0.6}`, where frame numbers have the
prefix x.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError
from jawusd.formats.text import read_text

SAME = 1e-3  # tolerance for equal values: relative for lengths, in rad for rotations

_MOST_BYTES = 64 << 20
_MOST_LEVELS = 4  # maximum nesting of braces in a knob
_START = re.compile(r"^\s*(?P<kind>\w+)\s*\{\s*$")
_KNOB = re.compile(r"^\s*(?P<name>\w+)(?:\s+(?P<value>.*))?$", re.DOTALL)
_BRACE = re.compile(r"(?<!\\)[{}]")


@dataclass(frozen=True)
class NukeNode:
    """A node of a Nuke script."""

    kind: str  # node class, such as "Camera2"
    knobs: Mapping[str, str]  # knob values by knob name, as written in the script
    parent: NukeNode | None  # the node connected to the first input

    @property
    def name(self) -> str:
        """Name of the node, or its class if it has no name."""
        return self.knobs.get("name", self.kind).strip().strip('"')


def read_nuke_script(path: Path) -> list[NukeNode]:
    """Return the nodes of a script in file order, including those inside groups.

    Raises:
        FormatError: the file cannot be read.
    """
    nodes: list[NukeNode] = []
    stack: list[NukeNode | None] = []
    named: dict[str, NukeNode | None] = {}
    lines = iter(read_text(path, _MOST_BYTES).splitlines())
    for line in lines:
        start = _START.match(line)
        words = line.split()
        if start:
            body, depth = [], 1
            for inner in lines:
                depth += _depth(inner)
                if depth < 1:
                    break
                body.append(inner)
            knobs = _knobs(body)
            count = int(knobs["inputs"]) if knobs.get("inputs", "").isdecimal() else 1
            fed = [stack.pop() for _ in range(min(count, len(stack)))]
            nodes.append(NukeNode(start["kind"], knobs, fed[0] if fed else None))
            stack.append(nodes[-1])
        elif words[:1] == ["push"] and len(words) == 2:
            stack.append(named.get(words[1].lstrip("$")))
        elif words[:1] == ["set"] and len(words) == 4 and stack:
            named[words[1]] = stack[-1]
    return nodes


def _depth(line: str) -> int:
    return sum(1 if brace == "{" else -1 for brace in _BRACE.findall(line))


def _knobs(body: list[str]) -> dict[str, str]:
    """Return the knobs of a node; a knob with open braces continues on the next line."""
    out: dict[str, str] = {}
    text, depth = "", 0
    for line in body:
        text, depth = f"{text}\n{line}" if depth else line, depth + _depth(line)
        knob = _KNOB.match(text)
        if depth == 0 and knob:
            out[knob["name"]] = (knob["value"] or "").strip()
    return out


def knob_values(node: NukeNode, knob: str, default: tuple[float, ...]) -> Array:
    """Return the values of a knob at its key frames, shape (F, C), where C is the length of the default.

    Raises:
        CalibrationError: the knob has an expression or another value that is not a number.
    """
    text = node.knobs.get(knob)
    if text is None:
        return np.array([default])
    try:
        channels = _channels(text, len(default))
        values = [[float(word) for word in words if not _is_sign(word)] for words in channels]
    except ValueError as error:
        raise CalibrationError(
            f'node {node.name}: {knob} is "{text:.60}"; expected numbers.',
            hint="Bake expressions, or export again from the tracking program.",
        ) from error
    frames = max((len(column) for column in values), default=0)
    filled = [column * frames if len(column) == 1 else column for column in values]
    if len(filled) != len(default) or any(len(column) != frames for column in filled) or not frames:
        raise CalibrationError(f'node {node.name}: {knob} is "{text:.60}"; expected {len(default)} numbers.')
    table = np.array(filled).T
    if not np.isfinite(table).all():
        raise CalibrationError(f"node {node.name}: {knob} has a value that is not finite.")
    return table


def steady_values(node: NukeNode, knob: str, default: tuple[float, ...]) -> Array:
    """Return the values of a constant knob, shape (C,); see `knob_values`.

    Raises:
        CalibrationError: the knob is animated.
    """
    table = knob_values(node, knob, default)
    if np.ptp(table, axis=0).max() > SAME * max(1e-6, float(np.abs(table[0]).max())):
        raise CalibrationError(
            f"node {node.name}: {knob} is animated; it must be constant.",
            hint="The lenses of a capture do not change: solve with a fixed focal length, and export again.",
        )
    return np.asarray(table[0], np.float64)


def _channels(text: str, count: int) -> list[list[str]]:
    """Return the words of each channel: {1 2 3}, {curve ...}, {{curve ...} 2 3} and the like."""
    levels: list[list[object]] = [[]]
    for word in re.findall(r"[{}]|[^\s{}]+", text):
        if word == "{":
            if len(levels) > _MOST_LEVELS:
                raise ValueError("too many braces")
            levels.append([])
        elif word == "}" and len(levels) > 1:
            inner = levels.pop()
            levels[-1].append(inner)
        else:
            levels[-1].append(word)
    items = _unwrapped(levels[0])
    if any(isinstance(item, list) for item in items):
        return [[str(word) for word in _unwrapped(item if isinstance(item, list) else [item])] for item in items]
    plain = [str(item) for item in items]
    return [plain] if count == 1 else [[word] for word in plain]


def _unwrapped(items: list[object]) -> list[object]:
    while len(items) == 1 and isinstance(items[0], list):
        items = items[0]
    return items


def _is_sign(word: str) -> bool:
    """Return whether a word of a curve is not a value but the keyword, a frame, an interpolation type or a slope."""
    return word == "curve" or bool(re.fullmatch(r"[A-Za-z]|[a-z]-?[\d.]+(?:e[-+]?\d+)?", word))
