"""Take comments as the documentation of fields and constants, as the code of jawusd writes them."""

import griffe

NOTHING = "\N{NO-BREAK SPACE}"  # a field whose name and type say all


class TrailingComments(griffe.Extension):
    """Give attributes without a docstring the comment that ends their line, or the lines `#: ...` above it."""

    def on_attribute_instance(self, *, attr, **kwargs):
        """Read the lines of the attribute."""
        if attr.docstring is not None or not attr.lineno or isinstance(attr.parent, griffe.Function):
            return
        lines, above = attr.lines_collection[attr.filepath], attr.lineno - 1
        while above and lines[above - 1].strip().startswith("#: "):
            above -= 1
        words = [line.strip()[3:] for line in lines[above : attr.lineno - 1]]
        if not words and isinstance(attr.parent, griffe.Class):
            words = [lines[attr.lineno - 1].partition("  # ")[2]]
        text = " ".join(words).strip()
        if text and not text.startswith(("noqa", "type:")):
            text = text[:1].upper() + text[1:].rstrip(".") + "."
        elif listed_by_fields(attr):
            text = NOTHING
        else:
            return
        attr.docstring = griffe.Docstring(text, lineno=attr.lineno, parent=attr)


def listed_by_fields(attr):
    """Tell whether an attribute is a field of a class whose docstring does not list its fields: all are shown then."""
    parent = attr.parent
    if not isinstance(parent, griffe.Class) or attr.annotation is None or parent.docstring is None:
        return False
    return "Attributes:" not in parent.docstring.value
