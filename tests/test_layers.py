"""Which package may import which, and inside a package which folder may import which."""

import ast
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

REPOSITORY = Path(__file__).resolve().parents[1]
PAGE = REPOSITORY / "docs" / "architecture.md"

FORBIDDEN = {
    "chsel": {"runners", "replay", "conf", "hydra", "omegaconf", "mcap", "rerun", "pybullet"},
    "replay": {"runners", "conf", "hydra", "omegaconf", "pybullet"},
    "runners": set(),
}
MAY_IMPORT = {
    "chsel": {
        "numerics": set(),
        "problem": {"numerics"},
        "cost": {"numerics", "problem"},
        "qd": {"numerics", "problem", "cost"},
        "methods": {"numerics", "problem", "cost", "qd"},
        "plausible": {"numerics", "problem", "cost"},
        "sensing": {"numerics", "problem"},
        "next_probe": {"numerics", "problem"},
        "policies": {"numerics", "problem", "next_probe"},
    },
    "replay": {
        "mcap": set(),
        "registration": {"mcap"},
        "comparing": {"mcap", "registration"},
        "rerun": {"mcap", "comparing"},
        "verbs": {"mcap", "registration", "comparing", "rerun"},
    },
    "runners": {
        "objects": set(),
        "sensors": set(),
        "sessions": {"objects", "sensors"},
        "simulated_robot": {"sensors", "sessions"},
        "run": {"objects", "sensors", "sessions"},
        "command": {"objects", "sensors", "sessions", "run"},
        "evaluation": {"objects", "sensors", "sessions", "simulated_robot", "command", "run"},
        "published_package": {"sessions", "command", "evaluation"},
        "reporting": {"objects", "sessions", "evaluation"},
        "benchmarks": {
            "objects",
            "sessions",
            "run",
            "command",
            "evaluation",
            "published_package",
            "reporting",
        },
    },
}
"""Folders of a package (`registration` is a file), and those of it that each may import."""
LOWEST = {
    "chsel": {"errors"},
    "replay": {
        *("events", "recorder", "environment"),
        *("arguments", "colors", "console", "files", "startup"),
    },
    "runners": set(),
}
"""Files of a package itself, below all its folders; its other files are above them."""
BUILT_OF = {
    "chsel": {"gradient_descent", "anchor_sampling"},
    "anchored": {"anchor_sampling"},
    "anchor_sampling": {"anchor_kernels"},
}
"""Files and folders of chsel/methods, and those beside them that they are built of."""
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


def unplaced(root, package="chsel"):
    """Folders of a package that MAY_IMPORT leaves out."""
    folders = {path.parent.relative_to(root / package) for path in root.glob(f"{package}/**/*.py")}
    return {folder.parts[0] for folder in folders if folder.parts} - set(MAY_IMPORT[package])


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
    folder, of_folder = place[0], "".join(end[1:2])
    if of_folder not in folders:
        return False
    if of_folder != folder:
        return of_folder in folders[folder]
    inside_methods = (package, folder) == ("chsel", "methods")
    return not inside_methods or _method_may_import("".join(place[1:2]), "".join(end[2:3]))


def _method_may_import(name, other):
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


def repeated(root, package="chsel"):
    """File names and class names that stand in a package twice."""
    files = [file for file in (root / package).rglob("*.py") if file.name != "__init__.py"]
    nodes = (node for file in files for node in ast.walk(ast.parse(file.read_text())))
    classes = [node.name for node in nodes if isinstance(node, ast.ClassDef)]
    counts = Counter([file.name for file in files]) + Counter(classes)
    return {name for name, count in counts.items() if count > 1}


@pytest.mark.parametrize("package", FORBIDDEN)
def test_a_package_imports_only_what_it_may(package):
    files = sorted((REPOSITORY / package).rglob("*.py"))
    assert len(files) > 5
    tops = {file: {name.split(".")[0] for name in imported(file, REPOSITORY)} for file in files}
    assert not {file: names for file, names in tops.items() if names & FORBIDDEN[package]}


def test_the_page_for_maintainers_has_these_rules():
    for header, rules in {
        "package | never imports": FORBIDDEN,
        **{f"folder of `{package}` | may import": MAY_IMPORT[package] for package in MAY_IMPORT},
        "package | files below all its folders": LOWEST,
        "method | is built of": BUILT_OF,
    }.items():
        _, _, rest = PAGE.read_text().partition(f"| {header} |\n|---|---|\n")
        rows = [re.findall(r"`(\w+)`", row) for row in rest.partition("\n\n")[0].splitlines()]
        assert {name: set(others) for name, *others in rows} == rules


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_every_folder_has_its_layer(package):
    assert unplaced(REPOSITORY, package) == set()
    there = {path.stem for path in (REPOSITORY / package).iterdir()}
    assert there >= set(MAY_IMPORT[package]) | LOWEST[package]


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_no_folder_imports_one_above_it(package):
    graph = import_graph(REPOSITORY, package)
    assert len(graph) > 30
    assert forbidden_imports(graph) == []


@pytest.mark.parametrize("package", FORBIDDEN)
def test_no_circle_of_imports(package):
    assert circles(import_graph(REPOSITORY, package)) == []


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_no_name_of_a_file_or_class_means_two_things(package):
    assert repeated(REPOSITORY, package) == set()


PLANTED = {
    "numerics/a.py": "from chsel.problem.b import Points",
    "problem/b.py": "def f():\n    import chsel.cost.c",
    "cost/c.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ..qd import d",
    "plausible/e.py": "from chsel.methods import icp",
    "sensing/f.py": "from chsel.cost.c import Cost",
    "qd/d.py": "from chsel.api import register",
    "errors.py": "from chsel.numerics import a",
    "methods/icp/icp.py": "from chsel.methods.svgd import Svgd",
    "methods/svgd.py": "from chsel.methods import build_method",
}


@pytest.mark.parametrize("name", PLANTED)
def test_an_arrow_back_up_is_seen(name, tmp_path):
    plant(tmp_path, {**dict.fromkeys([*PLANTED, "api.py"], ""), name: PLANTED[name]})
    found = forbidden_imports(import_graph(tmp_path))
    assert [line.split()[0] for line in found] == [module_name(Path("chsel") / name, Path())]
    assert unplaced(tmp_path) == repeated(tmp_path) == set()


def test_imports_of_lower_folders_are_no_arrow_back_up(tmp_path):
    files = {
        "errors.py": "",
        "numerics/a.py": "from chsel.errors import ChselError",
        "problem/b.py": "import numpy\nfrom chsel.numerics import a",
        "methods/method.py": "from chsel.problem.b import Points",
        "methods/chsel.py": "from chsel.methods.anchor_sampling import AnchoredStarts",
        "methods/anchor_sampling.py": "from chsel.methods.method import Method",
        "methods/__init__.py": "from chsel.methods.chsel import Chsel",
        "api.py": "from chsel.methods import build_method",
    }
    plant(tmp_path, files)
    graph = import_graph(tmp_path)
    assert graph["chsel.methods.chsel"] == {"chsel.methods.anchor_sampling"}
    assert forbidden_imports(graph) == circles(graph) == []


def test_a_circle_inside_a_folder_is_seen(tmp_path):
    files = {
        "cost/a.py": "from chsel.cost.b import B",
        "cost/b.py": "def f():\n    from chsel.cost.c import C",
        "cost/c.py": "from chsel.cost import a, d",
        "cost/d.py": "",
    }
    plant(tmp_path, files)
    assert circles(import_graph(tmp_path)) == [["chsel.cost.a", "chsel.cost.b", "chsel.cost.c"]]


def test_a_new_folder_and_a_second_meaning_are_seen(tmp_path):
    files = {
        "cost/kernels.py": "class Cost:\n    pass",
        "qd/kernels.py": "def f():\n    class Cost:\n        pass",
        "touch/pad.py": "",
    }
    plant(tmp_path, files)
    assert unplaced(tmp_path) == {"touch"}
    assert repeated(tmp_path) == {"kernels.py", "Cost"}


def plant(root, files):
    """Write files of a package chsel, with an __init__.py where there is none."""
    for name, text in files.items():
        file = root / "chsel" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    for folder in {file.parent for file in (root / "chsel").rglob("*.py")} | {root / "chsel"}:
        (folder / "__init__.py").touch()


def test_the_physics_engine_is_imported_in_one_place():
    files = (REPOSITORY / "runners").rglob("*.py")
    engine = ("pybullet", "pybullet_data")
    users = {
        file.name
        for file in files
        if any(name.startswith(engine) for name in imported(file, REPOSITORY))
    }
    assert users == {"physics_engine.py"}


def test_nothing_imports_the_physics_engine_before_it_is_needed():
    code = "import sys, runners.probe, runners.sessions; print('pybullet' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
