"""Which package and folder may import which, by the tables of docs/architecture.md."""

import ast
import re
from collections import Counter

import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from tests.chsel.samples import REPOSITORY

PAGE = (REPOSITORY / "docs" / "architecture.md").read_text()


def table(header):
    """The names in the rows of a table of the page, by the first of each row."""
    rows = PAGE.partition(f"| {header} |\n|---|---|\n")[2].partition("\n\n")[0].splitlines()
    names = [re.findall(r"`(\w+)`", row) for row in rows]
    return {name: set(others) for name, *others in names}


FORBIDDEN = table("package | never imports")
MAY_IMPORT = {package: table(f"folder of `{package}` | may import") for package in FORBIDDEN}
LOWEST = table("package | files below all its folders")
BUILT_OF = table("method | is built of")
EVERY_METHOD = {"method"}  # the protocol that they implement
ALL_METHODS = {""}  # chsel/methods/__init__.py, the table of all methods


def module_name(file, root):
    parts = file.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(file, root):
    """All that a file imports, in functions and for type checking, too: modules, or their names."""
    package = [*file.relative_to(root).parts[:-1]]
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            yield from (f"{source}.{alias.name}" for alias in node.names)


def import_graph(root, package="chsel"):
    """The modules of a package in `root`, and those of them that each imports."""
    modules = {module_name(file, root): file for file in sorted((root / package).rglob("*.py"))}
    graph = {}
    for module, file in modules.items():
        names = (name for name in imported(file, root) if name.split(".")[0] == package)
        ends = (name if name in modules else name.rpartition(".")[0] for name in names)
        graph[module] = {end for end in ends if end in modules and end != module}
    return graph


def forbidden_imports(graph):
    """Imports from a folder that the importing one may not know."""
    return [
        f"{module} imports {end}"
        for module, ends in graph.items()
        for end in sorted(ends)
        if not _may_import(module.split("."), end.split("."))
    ]


def _may_import(module, end):
    """Whether a module may import another one of its package; both are paths of names."""
    package, *place = module
    folders, lowest = MAY_IMPORT[package], LOWEST[package]
    if len(end) == 2 and end[1] in lowest:
        return True
    if not place or place[0] not in folders:  # a file of the package itself
        return not place or place[0] not in lowest
    folder = place[0]
    of_folder = "".join(end[1:2])
    if of_folder not in folders:
        return of_folder in folders[folder]  # a file of the package itself that its row names
    if of_folder != folder:
        return of_folder in folders[folder]
    if (package, folder) != ("chsel", "methods"):
        return True
    name, other = "".join(place[1:2]), "".join(end[2:3])
    known = name in ALL_METHODS or other in EVERY_METHOD
    return known or other == name or other in BUILT_OF.get(name, ())


def circles(graph):
    """Modules that import each other, directly or by way of others."""
    names = list(graph)
    arrows = [(names.index(name), names.index(end)) for name in names for end in graph[name]]
    starts, ends = zip(*arrows, strict=True)
    matrix = csr_array(([1] * len(arrows), (starts, ends)), shape=(len(names), len(names)))
    _, labels = connected_components(matrix, connection="strong")
    return [
        [name for name, other in zip(names, labels, strict=True) if other == label]
        for label, count in Counter(labels.tolist()).items()
        if count > 1
    ]


@pytest.mark.parametrize("package", FORBIDDEN)
def test_no_file_imports_one_above_it_and_none_in_a_circle(package):
    files = sorted((REPOSITORY / package).rglob("*.py"))
    tops = {file: {name.split(".")[0] for name in imported(file, REPOSITORY)} for file in files}
    records = REPOSITORY / "chsel" / "session" / "session.py"  # finds the recorder of a path
    tops.get(records, set()).discard("replay")
    assert not {file: names for file, names in tops.items() if names & FORBIDDEN[package]}
    folders = {file.relative_to(REPOSITORY / package).parts[:-1][:1] for file in files} - {()}
    assert {folder for (folder,) in folders} <= set(MAY_IMPORT[package])
    there = {path.stem for path in (REPOSITORY / package).iterdir()}
    assert there >= set(MAY_IMPORT[package]) | LOWEST[package]
    graph = import_graph(REPOSITORY, package)
    assert len(graph) > 30
    assert forbidden_imports(graph) == circles(graph) == []
