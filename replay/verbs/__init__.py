"""The verbs of `python -m replay`: a module each, with add_arguments and run."""

from __future__ import annotations

import ast
from pathlib import Path


def _summary(module: Path) -> str:
    """Return the first line of a module, which is read, not imported: that would take seconds."""
    return (ast.get_docstring(ast.parse(module.read_bytes())) or "").partition("\n")[0]


VERBS = {
    module.stem: _summary(module)
    for module in sorted(Path(__file__).parent.glob("*.py"))
    if module.stem != "__init__"
}
"""Verbs, with what each does."""
