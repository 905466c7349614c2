"""The pages of capture.toml, of the USD attributes, and of errors: from the models, the schema and the exceptions."""

import re
from pathlib import Path

from pxr import Sdf
from reference_commands import escaped

import jawusd.base.errors
from jawusd.cli.commands import EXIT_CODES
from jawusd.evaluator.kinds import D_RANGE_ATTRIBUTES, every_array
from jawusd.formats.capture import capture_keys

SCHEMA = Path(__file__).resolve().parents[2] / "schemas" / "schema.usda"

CAPTURE = """# capture.toml

This page is generated from the models that read the file. `jawusd init --reference` prints the same text. Paths are
relative to the file and must stay below its folder, unless `--allow-outside` is given. [From masks](../guides/masks.md)
and [From footage alone](../guides/footage.md) explain which keys a capture needs. `jawusd init FOLDER` writes a
commented file from the contents of a folder, and `jawusd check FOLDER` reports errors in it.

"""

USD = """# USD attributes

This page is generated from `schemas/schema.usda`. `JawRigAPI` is a codeless, single-apply schema. Attributes are read
by their names, and a program needs the schema only for its documentation and limits. `import jawusd` registers it with
OpenUSD, if it runs before the first stage is opened. Other programs find it through `PXR_PLUGINPATH_NAME`;
`jawusd info --schema` prints the value.

Matrices are stored row by row and act on column vectors; a twist is (omega [rad], v [mm]). The column "array" names the
same values in `model.npz` and in `rig.arrays`. Attributes marked "anchored" or "additive" belong to one kind of
[model](../explanation/model.md). An attribute is read like this:

```python
from pxr import Usd

actor = Usd.Stage.Open("out/anim_capture.usdc").GetDefaultPrim()
opening_mm = actor.GetAttribute("jaw:d1").Get(20)  # at frame 20
```

"""

ERRORS = """# Errors and exit codes

Every error of jawusd is a `jawusd.JawusdError`. Its message states where (file, camera, frame), what was found, what is
allowed with its unit, and what to do. The attributes `path`, `camera`, `frame` and `hint` hold the same for programs.
`jawusd --verbose COMMAND` also prints where in the program an error occurred.

"""


def capture_page():
    """Return the page of the keys of a capture.toml."""
    lines, table = [CAPTURE], None
    for entry in capture_keys():
        if entry.table != table:
            table = entry.table
            title = f"`{table}`" if table else "Top of the file, before the first table"
            lines.append(f"## {title}\n\n")
        anchor = re.sub(r"\W+", "-", f"{entry.table} {entry.name}").strip("-")
        unit = f" [{escaped(entry.key.unit)}]" if entry.key.unit else ""
        need = "must be given" if entry.default == "" else f"default: {escaped(entry.default)}"
        lines.append(f"`{entry.name}`{{ #{anchor} }}{unit}\n:   {escaped(entry.key.meaning)}\n\n")
        lines.append(f"    {escaped(entry.kind)}; {need}.\n\n")
        if entry.key.example:
            lines.append(f"    ```toml\n    {entry.name} = {entry.key.example}\n    ```\n\n")
    return "".join(lines)


def usd_page():
    """Return the page of the attributes of JawRigAPI."""
    layer = Sdf.Layer.OpenAsAnonymous(str(SCHEMA))
    prim = layer.GetPrimAtPath("/JawRigAPI")
    named = array_names()
    lines = [USD, escaped(" ".join(prim.GetInfo("documentation").split())), "\n\n"]
    group = None
    for attribute in prim.properties:
        name = attribute.name
        heading = ":".join(name.split(":")[:2]) if name.count(":") > 1 else "jaw"
        heading = "jaw:d1, jaw:d2, jaw:d3" if re.match(r"jaw:d\d", name) else heading
        if heading != group:
            group = heading
            lines.append(f"## `{heading}`\n\n" if group != "jaw" else "## Header and links\n\n")
        lines.append(attribute_entry(attribute, named.get(name)))
    return "".join(lines)


def attribute_entry(attribute, array):
    """Return one attribute: name, type, meaning, range, unit, allowed words, array."""
    relation = isinstance(attribute, Sdf.RelationshipSpec)
    kind = "relationship" if relation else str(attribute.typeName)
    doc = " ".join(attribute.documentation.split())
    tokens = [] if relation else attribute.GetInfo("allowedTokens")
    words = f" Allowed: {', '.join(f'`{word}`' for word in tokens)}." if tokens else ""
    same = f" Array: `{array}`." if array else ""
    anchor = attribute.name.replace(":", "-")
    return f"`{attribute.name}`{{ #{anchor} }} {kind}\n:   {escaped(doc)}.{words}{same}\n\n"


def array_names():
    """Return the name of the array in model.npz by USD attribute."""
    named = {spec.attribute: name for name, spec in every_array().items() if spec.attribute}
    return named | dict.fromkeys(D_RANGE_ATTRIBUTES, "d_range")


def errors_page():
    """Return the page of exceptions and exit codes."""
    kinds = {
        value
        for value in vars(jawusd.base.errors).values()
        if isinstance(value, type) and issubclass(value, jawusd.base.errors.JawusdError)
    }
    ordered = sorted(kinds, key=lambda kind: (kind.exit_code, len(kind.__mro__), kind.__name__))
    names = {kind: f"[`{kind.__name__}`][{kind.__module__}.{kind.__name__}]" for kind in ordered}
    rows = [f"| {kind.exit_code} | {names[kind]} | {kind.__doc__.splitlines()[0]} |\n" for kind in ordered]
    table = "| exit code | error | |\n|---|---|---|\n" + "".join(rows)
    options = "    options:\n      show_root_toc_entry: false\n      show_root_heading: false\n"
    directive = f"::: jawusd.base.errors\n{options}"
    return f"{ERRORS}{escaped(EXIT_CODES)}\n\n{table}\n## In Python\n\n{directive}"
