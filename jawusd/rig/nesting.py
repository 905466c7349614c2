"""How deeply layers are nested: OpenUSD recurses for every bracket and path element, until its stack ends."""

from __future__ import annotations

import re
from pathlib import Path

from pxr import Sdf, Tf, Usd

#: Brackets within brackets, and elements of a path, that are read. Stages of studios have some twenty; OpenUSD ends the
#: process at 1,000 where a thread has a stack of 512 kB, as on macOS, and between 3,000 and 20,000 where it has 8 MB.
MOST_LEVELS = 256

_ZipFile = Sdf.ZipFile if hasattr(Sdf, "ZipFile") else Usd.ZipFile  # where OpenUSD 24.11 and 25.05 have it
_OPENING, _CLOSING = b"([{", b")]}"
_STEPS = bytes.maketrans(_OPENING + _CLOSING, b"\x01" * 3 + b"\xff" * 3)
_OTHERS = bytes(set(range(256)) - set(_OPENING + _CLOSING))
_BINARY = b"PXR-USDC"
_CHUNK = 1 << 24
# Tokens of OpenUSD's grammar (sdf/textFileFormatParser.h) in which brackets are text. Every one begins with characters
# as they are: so they are found several times as fast.
_TEXT = re.compile(
    rb"""
      \"\"\"(?:[^"\\]++|\\.|"(?!""))*+(?:"{3}|\Z) | "(?:[^"\\\r\n]++|\\.)*+"
    | '''(?:[^'\\]++|\\.|'(?!''))*+(?:'{3}|\Z) | '(?:[^'\\\r\n]++|\\.)*+'
    | @@@(?:\\@@@|(?!@@@)[^\r\n])*+@{3,5} | @[^@\r\n]*+@
    | \#[^\n]*+ | //[^\n]*+ | /\*(?:[^*]++|\*(?!/))*+(?:\*/|\Z)
    """,
    re.VERBOSE | re.DOTALL,
)
_HEADER = re.compile(rb"#[^\r\n]*+")
_EXPRESSION = re.compile(rb"[\"'@]+`")
_LONG_PATH = re.compile(rb"<(?:[^<>/\n]*+/){%d}" % (MOST_LEVELS + 1))


def is_too_deep(file: Path) -> bool:
    """Tell whether a file holds text layers nested deeper than `MOST_LEVELS`, before OpenUSD parses them."""
    with file.open("rb") as opened:
        first = opened.read(len(_BINARY))
        if first == _BINARY:
            return False
        if not first.startswith(b"PK"):
            return _is_deep(first + opened.read())
    try:
        package = _ZipFile.Open(str(file))  # finds what OpenUSD finds, where a package contradicts itself
    except Tf.ErrorException:
        return False
    names = package.GetFileNames() if package else []
    return any(_is_deep(package.GetFile(name)) for name in names)


def _is_deep(data: bytes) -> bool:
    if data.startswith(_BINARY) or sum(map(data.count, (b"(", b"[", b"{", b"/"))) <= MOST_LEVELS:
        return False
    header = _HEADER.match(data)
    body = data[header.end() if header else 0 :]
    bare = _TEXT.sub(b"", body)
    if _LONG_PATH.search(bare) or _levels(bare) > MOST_LEVELS:
        return True
    if b"`" not in data:
        return False
    # OpenUSD parses expressions by recursion too
    expressions = (token[0] for token in _TEXT.finditer(body) if _EXPRESSION.match(token[0]))
    return any(text.count(b"(") + text.count(b"[") > MOST_LEVELS for text in expressions)


def _levels(text: bytes) -> int:
    """Return how many brackets are open at most, at any place of a text."""
    import numpy as np  # few texts come here; the copy of a process that reads them first is made before it is loaded

    steps = np.frombuffer(text.translate(_STEPS, _OTHERS), np.int8)
    level = deepest = 0
    for first in range(0, len(steps), _CHUNK):
        levels = level + np.cumsum(steps[first : first + _CHUNK], dtype=np.int32)
        level, deepest = int(levels[-1]), max(deepest, int(levels.max()))
    return deepest


def has_deep_arc(prim: Sdf.PrimSpec) -> bool:
    """Tell whether a prim inherits from, specializes or refers to one that lies deeper than `MOST_LEVELS`."""
    paths: list[Sdf.Path] = []
    for name in ("inheritPaths", "specializes"):
        if prim.HasInfo(name):
            paths += prim.GetInfo(name).GetAddedOrExplicitItems()
    for name in ("references", "payload"):
        if prim.HasInfo(name):
            paths += [arc.primPath for arc in prim.GetInfo(name).GetAddedOrExplicitItems()]
    return any(path.pathElementCount > MOST_LEVELS for path in paths)
