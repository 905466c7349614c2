"""Make text from grammars: USD layers from OpenUSD's, TOML and JSON from schemas; everything follows from a Random.

With `hypothesis.strategies.randoms()` the same functions are strategies, whose findings are shrunk.
"""

import json
import re

from fuzz_mutate import PATHS, WORDS

OWN = ("./actor.usda", "./geo.usdc", "./rig.usdc", "./anim.usda", "./anim.usdc", "./actor.usdz", "./clip.1.usda")
ARGUMENTS = (*[""] * 7, ":SDF_FORMAT_ARGS:a=b", ":SDF_FORMAT_ARGS:target=x&b=c/d.usda", "[0/actor.usdc]")
TEMPLATES = ("./clip.#.usda", "./clip.#.usda", "../clip.#.usda", "/tmp/x.#.usda", "./#/a.usda", "#" * 999)
DEPTHS = (2, 20, 250, 260, 3000, 100_000)
TARGETS = ("/Actor", "/Actor/Skull", "/Actor/Mandible", "/A", "/A/B", "/Nothing", "/A/B/C")
VALUES = ("0", "1", "2", "24", "-2.5", "3e4", "7", "1e300", "-1e300", "inf", "-inf", "nan", "1e-320", "1000000000")
TYPES = ("Mesh", "Xform", "Scope", "GeomSubset", "SkelRoot", "Skeleton", "Camera", "Points", "PointInstancer", "")
SCALARS = ("double", "float", "int", "uchar", "bool", "string", "token", "asset", "double3", "point3f", "matrix4d",
           "quatf", "half", "int64", "timecode", "color3f", "texCoord2f")  # fmt: skip
PRIMS = ("A", "B", "Actor", "Mandible", "Skull")
NAMES = ("points", "material:binding", "skel:skeleton", "proxyPrim", "faceVertexIndices", "faceVertexCounts", "jaw:d1",
         "jaw:d2", "jaw:meta", "jaw:actor", "jaw:formatVersion", "jaw:landmarks", "jaw:landmarks:names", "purpose",
         "jaw:model:kind", "jaw:model:s0:a", "jaw:bounds:d1Max", "jaw:decoder:twists", "jaw:lengthUnit", "visibility",
         "xformOp:translate", "xformOp:orient", "xformOpOrder", "extent", "__proto__")  # fmt: skip


def usd_text(rng):
    """Return the text of a layer: composition arcs, clips, variants, format arguments, values, nesting."""
    head = ["subLayers = [@./actor.usda@]"] if rng.random() < 0.8 else []
    head += ["startTimeCode = 0\n    endTimeCode = 24"] if rng.random() < 0.8 else []
    head += [_layer_metadata(rng) for _ in range(rng.randrange(3))]
    prims = [_prim(rng, 0, name) for name in rng.sample(PRIMS, rng.randrange(1, 4))]
    if rng.random() < 0.08:
        prims.append(_deep(rng))
    if rng.random() < 0.06:
        prims.append(_many(rng))
    return "#usda 1.0\n(\n    " + "\n    ".join(head) + "\n)\n" + "\n".join(prims) + "\n"


def _layer_metadata(rng):
    return rng.choice((
        lambda: f"subLayers = [{', '.join(_asset(rng) + _offset(rng) for _ in range(rng.randrange(1, 4)))}]",
        lambda: f'defaultPrim = "{rng.choice(PRIMS)}"',
        lambda: f"customLayerData = {_dictionary(rng, 0)}",
        lambda: f'expressionVariables = {{ string X = "{rng.choice((*OWN, *PATHS[:6]))}" }}',
        lambda: f"relocates = {{ <{rng.choice(TARGETS)}>: <{rng.choice(TARGETS)}> }}",
        lambda: f"{rng.choice(('startTimeCode', 'endTimeCode', 'timeCodesPerSecond'))} = {rng.choice(VALUES)}",
        lambda: f"metersPerUnit = {rng.choice(('0.001', '1', '0', '-1', 'inf', 'nan'))}",
        lambda: f'doc = """{rng.choice(WORDS)}"""',
    ))()  # fmt: skip


def _prim(rng, level, name):
    kind = rng.choice(("def", "over", "over", "class"))
    lines = [_prim_metadata(rng) for _ in range(rng.randrange(4))]
    body = [_property(rng, called) for called in rng.sample(NAMES, rng.randrange(4))]
    if level < 3:
        body += [_prim(rng, level + 1, called) for called in rng.sample(PRIMS, rng.randrange(2))]
        if rng.random() < 0.2:
            inner = _prim(rng, level + 1, "B")
            body.append(f'variantSet "v" = {{\n"x" {{\n{inner}\n}}\n"y" (\n{_prim_metadata(rng)}\n) {{\n}}\n}}')
    head = f'{kind} {rng.choice(TYPES)} "{name}"'
    return head + " (\n" + "\n".join(lines) + "\n) {\n" + "\n".join(body) + "\n}"


def _prim_metadata(rng):
    edit = rng.choice(("", "", "prepend ", "append ", "delete ", "add "))
    return rng.choice((
        lambda: f"{edit}references = {_arcs(rng)}",
        lambda: f"{edit}payload = {_arcs(rng)}",
        lambda: f"{edit}{rng.choice(('inherits', 'specializes'))} = <{rng.choice(TARGETS)}>",
        lambda: f'variants = {{ string v = "{rng.choice(("x", "y", "none", ""))}" }}\n{edit}variantSets = "v"',
        lambda: f'{edit}apiSchemas = ["{rng.choice(("JawRigAPI", "SkelBindingAPI", "CollectionAPI:x", "Nothing"))}"]',
        lambda: f"clips = {{ dictionary default = {{\n{_clips(rng)}\n}} }}",
        lambda: f"{rng.choice(('active', 'instanceable', 'hidden'))} = {rng.choice(('true', 'false'))}",
        lambda: f"{rng.choice(('customData', 'assetInfo'))} = {_dictionary(rng, 0)}",
        lambda: f'kind = "{rng.choice(("component", "assembly", "subcomponent", "x"))}"',
    ))()  # fmt: skip


def _clips(rng):
    lines = ['string primPath = "/Actor"', "double2[] active = [(0, 0)]", "double2[] times = [(0, 0), (9, 9)]"]
    if rng.random() < 0.5:
        first, last = rng.choice(VALUES), rng.choice(VALUES)
        lines += [f'string templateAssetPath = "{rng.choice(TEMPLATES)}"', "double templateStride = 1",
                  f"double templateStartTime = {first}", f"double templateEndTime = {last}"]  # fmt: skip
    else:
        lines += [f"asset[] assetPaths = [{_asset(rng)}]"]
    if rng.random() < 0.3:
        lines.append(f"asset manifestAssetPath = {_asset(rng)}")
    rng.shuffle(lines)
    return "\n".join(lines[: rng.randrange(2, len(lines) + 1)])


def _arcs(rng):
    found = []
    for target in rng.sample(TARGETS, rng.randrange(1, 3)):
        named = _asset(rng)
        found.append(rng.choice((f"<{target}>", f"{named}<{target}>{_offset(rng)}", named)))
    return found[0] if len(found) == 1 else f"[{', '.join(found)}]"


def _asset(rng):
    path = rng.choice(OWN if rng.random() < 0.85 else PATHS) + rng.choice(ARGUMENTS)
    if rng.random() < 0.1:
        path = rng.choice(('`"${X}"`', f'`"{path}"`', f'`if(eq(${{X}}, "a"), "{path}", "./geo.usdc")`'))
    return f"@@@{path}@@@" if rng.random() < 0.1 else f"@{path}@"


def _offset(rng):
    return "" if rng.random() < 0.7 else f" (offset = {rng.choice(VALUES)}; scale = {rng.choice(VALUES)})"


def _property(rng, name):
    if rng.random() < 0.15:
        return f"rel {name} = [{', '.join(f'<{to}>' for to in rng.sample(TARGETS, 2))}]"
    kind = rng.choice(SCALARS)
    many = rng.random() < 0.4
    declared = f"{rng.choice(('', 'custom ', 'uniform '))}{kind}{'[]' if many else ''} {name}"
    value = _array(rng, kind) if many else _scalar(rng, kind)
    form = rng.randrange(5)
    if form == 0:
        return f"{declared}.timeSamples = {{ {rng.choice(VALUES)}: {value}, 7: None, 8: {value} }}"
    if form == 1:
        return f"{declared}.connect = <{rng.choice(TARGETS)}.{rng.choice(NAMES)}>"
    if form == 2 and kind in ("double", "float") and not many:
        return f"{declared}.spline = {{ bezier, {rng.choice(VALUES)}: {rng.choice(VALUES)}; post linear, }}"
    return f"{declared} = {value}" + (f" ( customData = {_dictionary(rng, 2)} )" if rng.random() < 0.1 else "")


def _scalar(rng, kind):
    if kind == "asset":
        return _asset(rng)
    if kind in ("string", "token"):
        return json.dumps(rng.choice((*WORDS[3:8], "mm", "rad", "anchored", "curves", "{}", '{"kind": 1}', "[" * 999)))
    if kind in ("int", "int64", "uchar", "bool"):
        return rng.choice(("0", "1", "1", "7" if kind != "bool" else "0", "-1" if kind[0] == "i" else "1"))
    size = {"double3": 3, "point3f": 3, "color3f": 3, "texCoord2f": 2, "quatf": 4}.get(kind)
    number = lambda: rng.choice(VALUES if rng.random() < 0.2 else ("0", "1", "-2.5", "3e4", "255"))  # noqa: E731
    if kind == "matrix4d":
        return f"( {', '.join('(' + ', '.join(number() for _ in range(4)) + ')' for _ in range(4))} )"
    return number() if size is None else f"({', '.join(number() for _ in range(size))})"


def _array(rng, kind):
    return "[" + ", ".join(_scalar(rng, kind) for _ in range(rng.choice((0, 1, 2, 6, 30)))) + "]"


def _dictionary(rng, level):
    found = [f"{kind} k{i} = {_scalar(rng, kind)}" for i, kind in enumerate(rng.sample(SCALARS[:10], 2))]
    if level < 3 and rng.random() < 0.5:
        found.append(f"dictionary {rng.choice(('sha256', 'inner'))} = {_dictionary(rng, level + 1)}")
    return "{ " + "\n".join(found) + " }"


def _deep(rng):
    n = rng.choice(DEPTHS)
    return rng.choice((
        'def "a" {\n' * n + "}\n" * n,
        'def "D" ( customData = {' + "dictionary a = {\n" * n + "}\n" * n + "} ) {}",
        'def "D" {\n' + 'variantSet "v" = { "x" {\n' * n + "}}\n" * n + "}",
        'def "D" { double[] x = ' + "[" * n + "1" + "]" * n + " }",
        'def "D" ( inherits = <' + "/a" * n + "> ) {}",
        'def "D" ( references = @`' + "if(true, " * n + '"x"' + ")" * n + "`@ ) {}",
    ))  # fmt: skip


def _many(rng):
    """Return prims whose composition grows: each refers twice to the one before, or all in a row."""
    arc, n = rng.choice(("references", "inherits", "specializes", "payload")), rng.choice((5, 12, 16, 60))
    if rng.random() < 0.5 and n < 20:
        twice = f'def "L%d" {{ def "a" ({arc} = </L%d>) {{}}\ndef "b" ({arc} = </L%d>) {{}}\n}}\n'
        return 'def "L0" {}\n' + "".join(twice % (i + 1, i, i) for i in range(n))
    return "".join(f'def "C{i}" ({arc} = </C{i + 1}>) {{}}\n' for i in range(n))


def from_schema(schema, rng, like=None, words=(), root=None):
    """Return a value that a JSON schema describes, one in fifty of its parts wrong.

    Args:
        schema: as pydantic's `model_json_schema` gives it.
        rng: a Random.
        like: a valid value; about half of its parts are taken as they are.
        words: strings to take now and then in place of made-up ones.
        root: the schema that references are in.
    """
    root = root or schema
    if rng.random() < 0.015:
        return rng.choice((None, True, -1, 0, 1e308, 10**30, "", [], {}, [[[]]], {"": {}}, rng.choice(WORDS)))
    if like is not None and rng.random() < 0.5:
        return like
    if "$ref" in schema:
        return from_schema(root["$defs"][schema["$ref"].rsplit("/", 1)[1]], rng, like, words, root)
    for choice in ("enum", "anyOf", "oneOf"):
        if choice in schema:
            picked = schema[choice][0] if rng.random() < 0.6 else rng.choice(schema[choice])
            return picked if choice == "enum" else from_schema(picked, rng, like, words, root)
    if "const" in schema:
        return schema["const"]
    make = {"object": _object, "array": _list, "string": _string, "boolean": lambda *_: rng.random() < 0.5,
            "integer": _number, "number": _number}.get(schema.get("type"))  # fmt: skip
    return make(schema, rng, like, words, root) if make else None


def _object(schema, rng, like, words, root):
    like = like if isinstance(like, dict) else {}
    required = schema.get("required", ())
    found = {name: from_schema(part, rng, like.get(name), words, root)
             for name, part in schema.get("properties", {}).items()
             if rng.random() < (0.995 if name in required else 0.9 if name in like else 0.3)}  # fmt: skip
    extra = schema.get("additionalProperties")
    if isinstance(extra, dict):
        named = (*like, *like, *words, "a")
        found |= {rng.choice(named): from_schema(extra, rng, None, words, root) for _ in range(rng.randrange(4))}
    if rng.random() < 0.01:
        found[rng.choice(("unknown", "__class__", ""))] = 1
    return found


def _list(schema, rng, like, words, root):
    like = like if isinstance(like, list) else []
    parts = schema.get("prefixItems")
    if not parts or rng.random() < 0.05:
        count = rng.choice((schema.get("minItems", 0), 1, 2, 3, 3, len(like), len(like), 70))
        parts = [schema.get("items", {"type": "number"})] * count
    likes = [*like, *[None] * len(parts)]
    return [from_schema(part, rng, valid, words, root) for part, valid in zip(parts, likes)]


def _string(schema, rng, like, words, root):
    fitting = [word for word in words if re.search(schema.get("pattern", ""), word)]
    return rng.choice(fitting) if fitting and rng.random() < 0.95 else rng.choice((*PATHS, *WORDS))


def _number(schema, rng, like, words, root):
    low = schema.get("minimum", schema.get("exclusiveMinimum", -1000))
    high = schema.get("maximum", schema.get("exclusiveMaximum", 1000))
    if rng.random() < 0.02:
        return rng.choice((low - 1, high + 1, 2**63, -(2**31)))
    whole = rng.randint(int(low), int(min(high, low + 100)))
    return whole if schema["type"] == "integer" or rng.random() < 0.3 else rng.uniform(low, high)


def toml_text(data):
    """Return a table as TOML: its tables inline."""
    return "".join(f"{json.dumps(str(key))} = {_toml(value)}\n" for key, value in data.items() if value is not None)


def _toml(value):
    if isinstance(value, dict):
        parts = (f"{json.dumps(str(key))} = {_toml(part)}" for key, part in value.items() if part is not None)
        return "{" + ", ".join(parts) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(part) for part in value if part is not None) + "]"
    if isinstance(value, bool | str):
        return json.dumps(value)
    return repr(value)


def schema_of(value):
    """Return a JSON schema that a value meets, where no reader states one."""
    if isinstance(value, dict):
        return {"type": "object", "properties": {k: schema_of(v) for k, v in value.items()}, "required": list(value)}
    if isinstance(value, list | tuple):
        return {"type": "array", "prefixItems": [schema_of(v) for v in value], "items": schema_of((*value, 0.0)[0])}
    if value is None:
        return {"enum": [None]}
    return {"type": {bool: "boolean", int: "integer", float: "number"}.get(type(value), "string")}


def words_of(value):
    """Return the strings in a value, keys too."""
    if isinstance(value, dict):
        return [word for key, part in value.items() for word in (key, *words_of(part))]
    if isinstance(value, list | tuple):
        return [word for part in value for word in words_of(part)]
    return [value] if isinstance(value, str) else []


def capture_schema():
    """Return the schema of capture.toml as people write it."""
    from jawusd.formats.capture import Capture

    schema = Capture.model_json_schema()
    parts = schema["properties"]
    del parts["folder"]
    parts |= {"format": {"enum": ["jawusd-capture/1"]}, "units": {"enum": ["mm"]}}
    return schema | {"required": ["name", "fps", "scans", "camera", "format", "units"]}
