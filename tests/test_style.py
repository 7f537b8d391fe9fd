"""Is the code plain: sentences as docstrings, a statement for each name, arguments by keyword?"""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = [path for name in ("chsel", "replay", "runners") for path in (ROOT / name).rglob("*.py")]
KERNELS = re.compile(r"compiler import .*\b(compiled|inner|leaf|spliced|implements)\b")
FRAGMENT = re.compile(r"(What|How|Where|Which|Of|The same)\b")
MOST_POSITIONAL = 5


def is_one_value(targets):
    """Whether targets are components of one value: x, y, z; gx, gy, gz; elements of an array."""
    if all(isinstance(target, ast.Subscript) for target in targets):
        return len({ast.unparse(target.value) for target in targets}) == 1
    first, *others = names = [ast.unparse(target).split(".")[-1] for target in targets]
    if all(len(name.lstrip("_")) <= 2 for name in names):
        return True  # letters of a formula
    alike = [sum(a != b for a, b in zip(first, name, strict=False)) == 1 for name in others]
    return all(alike) and {len(name) for name in names} == {len(first)}


def names_in(nodes):
    return {n.id for node in nodes for n in ast.walk(node) if isinstance(n, ast.Name)}


def faults(source, ours=()):
    """Lines of a source with what is wrong there; ours: functions and classes of the packages."""
    found = []
    tree = ast.parse(source)
    nodes = list(ast.walk(tree))
    functions = [n for n in nodes if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    for function in functions:
        if FRAGMENT.match(ast.get_docstring(function) or ""):
            found.append((function.lineno, "the docstring is a fragment"))
        inside = list(ast.walk(function))
        bundles = [
            n for n in inside if isinstance(n, ast.Assign) and isinstance(n.value, ast.Tuple)
        ]
        names = {n.targets[0].id for n in bundles if isinstance(n.targets[0], ast.Name)}
        for node in [n for n in inside if isinstance(n, ast.Call)]:
            if names & {ast.unparse(a.value) for a in node.args if isinstance(a, ast.Starred)}:
                found.append((node.lineno, "a tuple of arguments is splatted"))
    for node in nodes:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
            targets = getattr(node.targets[0], "elts", [])
            chained = names_in(targets) & names_in(node.value.elts)  # the order may matter
            if len(targets) > 2 and not chained and not is_one_value(targets):
                found.append((node.lineno, "one statement assigns several names"))
        if isinstance(node, ast.Call) and not KERNELS.search(source):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if len(node.args) > MOST_POSITIONAL and name in ours:
                found.append((node.lineno, f"more than {MOST_POSITIONAL} positional arguments"))
    return sorted(set(found))


def test_the_packages_are_plain():
    texts = {path: path.read_text(encoding="utf-8") for path in FILES}
    nodes = [node for text in texts.values() for node in ast.walk(ast.parse(text))]
    defined = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    ours = {node.name for node in defined} | {n.name for n in nodes if isinstance(n, ast.ClassDef)}
    ours -= {node.name for node in defined if node.args.vararg}
    found = [
        f"{path.relative_to(ROOT)}:{line}: {fault}"
        for path, text in texts.items()
        for line, fault in faults(text, ours)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ('def f():\n    """What is left."""', [(1, "the docstring is a fragment")]),
        ('def f():\n    """Return what is left."""', []),
        ("size, key, found = 1, f(), []", [(1, "one statement assigns several names")]),
        ("x, y, z = a, b, c", []),
        ("out[0], out[1], out[2] = 1, 2, 3", []),
        ("first, second, third = second, first, 0", []),
        ("def f():\n    a = 1, 2\n    g(0, *a)", [(3, "a tuple of arguments is splatted")]),
        ("def f(*a):\n    g(*a)", []),
        ("f(1, 2, 3, 4, 5, 6)", [(1, "more than 5 positional arguments")]),
        ("max(1, 2, 3, 4, 5, 6)", []),
        ("from chsel.numerics.compiler import leaf\nf(1, 2, 3, 4, 5, 6)", []),
    ],
)
def test_planted_faults_are_found_and_plain_code_is_left_alone(source, expected):
    assert faults(source, {"f"}) == expected
