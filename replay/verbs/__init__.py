"""What can be done with a recording: a module a verb, each with add_arguments and run."""

from __future__ import annotations

import ast
from pathlib import Path

ALIASES = {"bless": "accept"}
"""Former names of verbs, which keep working."""


def _summary(module: Path) -> str:
    """The first line of a module, which is read, not imported: that would take seconds."""
    documented = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8")))
    return (documented or "").partition("\n")[0]


VERBS = {
    module.stem: _summary(module)
    for module in sorted(Path(__file__).parent.glob("*.py"))
    if module.stem != "__init__"
}
"""All verbs, with what each does."""
