"""Take comments as the documentation of fields and constants, as the code of jawusd writes them."""

import griffe


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
            attr.docstring = griffe.Docstring(text, lineno=attr.lineno, parent=attr)
