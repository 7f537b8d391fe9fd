"""For the site's reference: what fields of dataclasses are, from comments beside or above them."""

import re

from griffe import Attribute, Docstring, Extension


class FieldComments(Extension):
    """Takes the comment of a field for its docstring."""

    def on_attribute_instance(self, *, attr: Attribute, **_: object) -> None:
        if attr.docstring is not None or attr.parent is None or not attr.parent.is_class:
            return
        before = attr.lines_collection[attr.filepath][: attr.lineno - 1]
        line = attr.source
        found = re.search(r"  # (.*)", line)
        parts = [found[1]] if found else []
        while not found and before and before[-1].lstrip().startswith("# "):
            parts.insert(0, before.pop().lstrip("# "))
        if parts:
            attr.docstring = Docstring(" ".join(parts), parent=attr)
