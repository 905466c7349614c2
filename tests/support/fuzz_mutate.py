"""Damage valid files: bytes, text, JSON and the structure of npz, zip and PNG; everything follows from a generator."""

import io
import json
import pickle
import re
import struct
import zipfile
import zlib

import numpy as np

NUMBERS = (
    "nan", "NaN", "inf", "-inf", "Infinity", "-1", "0", "-0.0", "1", "2", "1e308", "-1e308", "1e999", "1e-320", "1e16",
    "9007199254740993", "2147483648", "4294967296", "99999999999999999999", "1" + "0" * 400, "0x10", "1_0", "true",
    "null", '""', "[]", "{}", "٣", "1,5", "--1", "1e", "01", "[1]", "{a=1}", "16777216", "1000000000",
)  # fmt: skip
PATHS = (
    "../secret.txt", "../outside.usda", "link_out/outside.usda",
    "../../../../../../etc/passwd", "/etc/passwd", "/dev/zero", "/dev/stdin", "/proc/self/mem", "~/x",
    "..", ".", "", "/", "//host/share", "C:\\x", "\\\\host\\x", "a\\u0000b", "link_out", "link_out/secret.txt", "%s%n",
    "%99999999d", "%06d%06d", "%d.png", "x" * 5000, "é" * 300, "file:///etc/passwd", "http://127.0.0.1:9/x.usda",
)  # fmt: skip
WORDS = ("", "\0", "\ufeff", "\u202e", "💀", "__class__", "../", "#", '"', "'", "\\", "\n", "{", "[", "<<", "e" * 3000)


def damaged_bytes(rng, data):
    """Return bytes with one fault, or a few."""
    data = bytearray(data)
    for _ in range(_how_many(rng)):
        data = _BYTE_FAULTS[rng.integers(len(_BYTE_FAULTS))](rng, data)
    return bytes(data)


def _how_many(rng):
    # Several faults at once are mostly stopped by the first.
    return 1 if rng.random() < 0.7 else int(rng.integers(2, 5))


def _at(rng, data):
    # Headers decide most: half of all faults lie in the first 400 bytes or the last 100.
    if not data:
        return 0
    kind = rng.integers(4)
    if kind == 0:
        return int(rng.integers(min(len(data), 400)))
    if kind == 1:
        return int(max(0, len(data) - 1 - rng.integers(100)))
    return int(rng.integers(len(data)))


def _flip(rng, data):
    if data:
        data[_at(rng, data)] ^= 1 << rng.integers(8)
    return data


def _set(rng, data):
    if data:
        data[_at(rng, data)] = int(rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.integers(256)]))
    return data


def _number(rng, data):
    width = int(rng.choice([2, 4, 8]))
    value = int(rng.choice([0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 10**9])) % (1 << (8 * width))
    at = _at(rng, data)
    data[at : at + width] = value.to_bytes(width, str(rng.choice(["little", "big"])))
    return data


def _cut(rng, data):
    return data[: _at(rng, data)]


def _drop(rng, data):
    at = _at(rng, data)
    del data[at : at + int(rng.integers(1, 200))]
    return data


def _double(rng, data):
    at = _at(rng, data)
    part = data[at : at + int(rng.integers(1, 300))]
    return data[:at] + part * int(rng.choice([2, 3, 50])) + data[at:]


def _insert(rng, data):
    at = _at(rng, data)
    return data[:at] + rng.bytes(int(rng.integers(1, 64))) + data[at:]


def _zero(rng, data):
    at = _at(rng, data)
    n = min(int(rng.integers(1, 400)), len(data) - at)
    data[at : at + n] = bytes(n)
    return data


def _move(rng, data):
    a, b = sorted((_at(rng, data), _at(rng, data)))
    return data[b:] + data[:a] + data[a:b]


_BYTE_FAULTS = (_flip, _flip, _set, _set, _number, _number, _cut, _drop, _double, _insert, _zero, _move)

_NUMBER = re.compile(r"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
_QUOTED = re.compile(r'"([^"\n]*)"|@([^@\n]*)@')
_NAME = re.compile(r"[A-Za-z_][A-Za-z_0-9:]*")


def damaged_text(rng, text):
    """Return text with one fault, or a few, of its words, numbers, paths or lines."""
    for _ in range(_how_many(rng)):
        text = _TEXT_FAULTS[rng.integers(len(_TEXT_FAULTS))](rng, text)
    return text


def _one(rng, pattern, text, new):
    found = list(pattern.finditer(text))
    if not found:
        return text
    match = found[rng.integers(len(found))]
    return text[: match.start()] + new(match) + text[match.end() :]


def _pick(rng, values):
    return values[rng.integers(len(values))]


def _other_number(rng, text):
    return _one(rng, _NUMBER, text, lambda match: _pick(rng, NUMBERS))


def _near_number(rng, text):
    return _one(rng, _NUMBER, text, lambda match: repr(float(match[0]) * float(rng.normal(1, 3))))


def _other_path(rng, text):
    def new(match):
        mark = match[0][0]
        return f"{mark}{_pick(rng, PATHS)}{mark}"

    return _one(rng, _QUOTED, text, new)


def _other_name(rng, text):
    names = _NAME.findall(text) or ["x"]
    return _one(rng, _NAME, text, lambda match: str(_pick(rng, [_pick(rng, names), _pick(rng, WORDS), match[0] + "_"])))


def _nested(rng, text):
    depth, pair = int(rng.choice([2, 50, 2000, 100_000])), _pick(rng, ("[]", "{}", "()", '{"a":}'))
    opening, closing = pair[:-1], pair[-1]
    return _one(rng, _NUMBER, text, lambda match: opening * depth + match[0] + closing * depth)


def _line(rng, text):
    lines = text.splitlines(keepends=True)
    if not lines:
        return text
    i, j = rng.integers(len(lines)), rng.integers(len(lines))
    kind = rng.integers(4)
    if kind == 0:
        del lines[i]
    elif kind == 1:
        lines.insert(j, lines[i])
    elif kind == 2:
        lines[i], lines[j] = lines[j], lines[i]
    else:
        lines[i] = lines[i] * int(rng.choice([2, 1000]))
    return "".join(lines)


def _word(rng, text):
    at = int(rng.integers(len(text) + 1))
    return text[:at] + _pick(rng, WORDS) + text[at:]


def _short(rng, text):
    return text[: rng.integers(len(text) + 1)]


_TEXT_FAULTS = (
    _other_number, _other_number, _other_number, _near_number, _other_path, _other_path, _other_name, _other_name,
    _nested, _line, _line, _word, _short,
)  # fmt: skip


def damaged_either(rng, data):
    """Return a text file's bytes with faults of its text, or now and then of its bytes."""
    if rng.random() < 0.2:
        return damaged_bytes(rng, data)
    return damaged_text(rng, data.decode()).encode("utf-8", "surrogatepass")


def damaged_json(rng, data):
    """Return JSON with one value replaced by one of another kind, size or depth; now and then damaged as text."""
    if rng.random() < 0.5:
        return damaged_either(rng, data)
    tree = json.loads(data)
    places = list(_places(tree))
    holder, key = places[rng.integers(len(places))]
    if isinstance(holder, dict) and rng.random() < 0.3:
        holder[_pick(rng, WORDS) + key] = holder.pop(key)
    else:
        values = [None, True, 0, -1, 1e308, float("nan"), 10**30, "", "x", [], {}, [[1]], {"a": 1}, "../x", "1" * 9999]
        holder[key] = _pick(rng, values)
    return json.dumps(tree).encode()


def _places(tree):
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items:
        yield tree, key
        if isinstance(value, dict | list):
            yield from _places(value)


class _Planted:
    """Would write a file if anybody unpickled it."""

    def __reduce__(self):
        return (open, ("pickle_ran.txt", "w"))


def damaged_npz(rng, data):
    """Return an npz with faults of its arrays, its header, or its bytes."""
    if rng.random() < 0.3:
        return damaged_bytes(rng, data)
    with np.load(io.BytesIO(data)) as archive:
        arrays = {name: archive[name] for name in archive.files}
    raw = {}
    for _ in range(rng.integers(1, 3)):
        _ARRAY_FAULTS[rng.integers(len(_ARRAY_FAULTS))](rng, arrays, raw)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            if name not in raw:
                member = io.BytesIO()
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
                archive.writestr(f"{name}.npy", member.getvalue())
        for name, content in raw.items():
            archive.writestr(f"{name}.npy" if "/" not in name else name, content)
    return out.getvalue()


def _some(rng, arrays):
    return list(arrays)[rng.integers(len(arrays))]


def _dtype(rng, arrays, raw):
    name = _some(rng, arrays)
    kind = rng.choice(["f4", "f2", "i8", "u1", "c16", "S3", "U2", "M8[s]", "bool", ">f8", "V4"])
    with np.errstate(all="ignore"):
        try:
            arrays[name] = arrays[name].astype(kind)
        except (TypeError, ValueError):
            arrays[name] = np.zeros(3, kind)


def _shape(rng, arrays, raw):
    name = _some(rng, arrays)
    a = arrays[name]
    arrays[name] = _pick(rng, [a[None], a.ravel(), a[..., None], a.T, a[:0] if a.ndim else a[None], a.ravel()[:1],
                               np.repeat(a[None], 2, 0) if a.ndim else a, a[1:] if a.ndim else a])  # fmt: skip


def _value(rng, arrays, raw):
    name = _some(rng, arrays)
    a = arrays[name]
    if a.dtype.kind not in "fiub" or not a.size:
        return
    a = a.copy()
    value = rng.choice([0, -1, 1, 1e9, 1e300, np.nan, np.inf, -np.inf, 1e-300, 127])
    with np.errstate(all="ignore"):
        value = np.array(value).astype(a.dtype)
    if rng.random() < 0.5:
        a[...] = value
    else:
        a.reshape(-1)[rng.integers(a.size)] = value
    arrays[name] = a


def _lost(rng, arrays, raw):
    name = _some(rng, arrays)
    if len(arrays) > 1:
        value = arrays.pop(name)
        if rng.random() < 0.5:
            arrays[name + "_"] = value


def _meta(rng, arrays, raw):
    text = damaged_json(rng, str(arrays.get("meta", "{}")).encode() or b"{}") if rng.random() < 0.9 else b"[]"
    value = np.array(text.decode("utf-8", "replace").rstrip("\0"))
    arrays["meta"] = _pick(rng, [value, value, value, value[None], np.array(text), np.array(3.0)])


def _giant_header(rng, arrays, raw):
    shape = _pick(rng, [(10**12,), (10**6, 10**6), (0, 10**9), (-1,), (2**63,), (10**8, 4)])
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    raw[_some(rng, arrays)] = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + bytes(64)


def _deep_header(rng, arrays, raw):
    header = ("(" * 5000 + ")" * 5000).encode()
    raw[_some(rng, arrays)] = b"\x93NUMPY\x02\x00" + struct.pack("<I", len(header)) + header


def _pickled(rng, arrays, raw):
    header = b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }".ljust(117) + b"\n"
    start = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    raw[_some(rng, arrays)] = start + pickle.dumps([_Planted()])


def _bare_pickle(rng, arrays, raw):
    raw[_some(rng, arrays)] = pickle.dumps(_Planted())


def _bomb(rng, arrays, raw):
    raw[_some(rng, arrays)] = bytes(int(rng.choice([10**6, 60 * 10**6])))


def _climbing_member(rng, arrays, raw):
    raw[_pick(rng, ["../climbed.npy", "/tmp/climbed.npy", "a/../../climbed.npy"])] = b"x"


_ARRAY_FAULTS = (
    _dtype, _dtype, _shape, _shape, _value, _value, _value, _lost, _meta, _meta, _meta, _giant_header, _deep_header,
    _pickled, _bare_pickle, _climbing_member,
)  # fmt: skip


def damaged_zip(rng, data):
    """Return an archive with one member damaged and sums made right again, or damaged as bytes."""
    if rng.random() < 0.4:
        return damaged_bytes(rng, data)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = _some(rng, members)
    kind = rng.integers(6)
    how = zipfile.ZIP_STORED
    if kind == 0:
        members[_pick(rng, ["../climbed.usda", "/tmp/climbed.usda"])] = members.pop(name)
    elif kind == 1:
        how = zipfile.ZIP_DEFLATED
    elif kind == 2:
        members["more.bin"] = bytes(40 * 10**6)
        how = zipfile.ZIP_DEFLATED
    else:
        members[name] = damaged_either(rng, members[name]) if name.endswith("a") else damaged_bytes(rng, members[name])
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", how) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


def damaged_png(rng, data):
    """Return a PNG with a chunk changed and its checksum made right again, or damaged as bytes."""
    if rng.random() < 0.4:
        return damaged_bytes(rng, data)
    chunks, at = [], 8
    while at + 8 <= len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        chunks.append([data[at + 4 : at + 8], data[at + 8 : at + 8 + length]])
        at += 12 + length
    kind = rng.integers(4)
    if kind == 0:
        size = [int(rng.choice([0, 1, 64, 48, 65535, 10**6, 2**31 - 1, 2**32 - 1])) for _ in range(2)]
        chunks[0][1] = struct.pack(">II", *size) + chunks[0][1][8:]
    elif kind == 1:
        head = bytearray(chunks[0][1])
        head[8 + rng.integers(5)] = rng.integers(256)
        chunks[0][1] = bytes(head)
    elif kind == 2:
        i = rng.integers(len(chunks))
        chunks[i][1] = damaged_bytes(rng, chunks[i][1])
    else:
        text = zlib.compress(bytes(20 * 10**6), 9)
        chunks.insert(1, [b"zTXt", b"Comment\0\0" + text])
    out = data[:8]
    for name, body in chunks:
        out += struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
    return out
