"""Take the comment behind a field of a dataclass as its documentation, as the code of jawusd writes it."""

import griffe


class TrailingComments(griffe.Extension):
    """Give attributes without a docstring the comment that ends their line."""

    def on_attribute_instance(self, *, attr, **kwargs):
        """Read the line of the attribute."""
        if attr.docstring is not None or not attr.lineno or not isinstance(attr.parent, griffe.Class):
            return
        line = attr.lines_collection[attr.filepath][attr.lineno - 1]
        _, sign, comment = line.partition("  # ")
        if sign and not comment.startswith(("noqa", "type:")):
            text = comment[:1].upper() + comment[1:].rstrip(".") + "."
            attr.docstring = griffe.Docstring(text, lineno=attr.lineno, parent=attr)
