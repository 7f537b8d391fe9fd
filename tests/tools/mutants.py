"""python -m tests.tools.mutants ROOM: how many single mistakes the tests of a room notice.

ROOM: a folder or a file of the product. Cosmic Ray names every place where a number, an operator,
a comparison or a condition can be changed, and the first two arguments of every call can be
swapped. What cannot matter is left out: the order of arguments of max and min, and the flags repr
and eq of dataclasses. A random sample of these mutants is made in a copy of the tree, one at a
time, and the tests of the room are run on each, golden digests and stored replays left out.
Kernels are compiled again, as their code is kept by what is in the files.
"""

import argparse
import ast
import difflib
import itertools
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator
from rich.console import Console

ROOT = Path(__file__).resolve().parents[2]
OPERATORS = [
    "NumberReplacer",
    "AddNot",
    "ReplaceAndWithOr",
    "ReplaceOrWithAnd",
    "ReplaceTrueWithFalse",
    "ReplaceFalseWithTrue",
    "ReplaceUnaryOperator_Delete_USub",
    "ReplaceUnaryOperator_Delete_Not",
    *(
        f"ReplaceBinaryOperator_{pair}"
        for pair in ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_FloorDiv")
    ),
    *(
        f"ReplaceComparisonOperator_{pair}"
        for pair in (
            "Lt_LtE",
            "Lt_Gt",
            "LtE_Lt",
            "Gt_GtE",
            "Gt_Lt",
            "GtE_Gt",
            "Eq_NotEq",
            "NotEq_Eq",
        )
    ),
]
SWAPPED = "swapped arguments"


def mutants_of(file):
    """Every mutant of a file: the file, what is changed, and at which of its places."""
    code = (ROOT / file).read_text()
    nodes = list(ast_nodes(get_ast(code)))
    flags = {
        (flag.value.lineno, flag.value.col_offset)
        for call in calls(code, {"dataclass"})
        for flag in call.keywords
        if flag.arg in ("repr", "eq")
    }
    for operator in OPERATORS:
        change = get_operator(f"core/{operator}")()
        places = [place for node in nodes for place, _ in change.mutation_positions(node)]
        kept = [number for number, place in enumerate(places) if place not in flags]
        yield from ((file, operator, occurrence) for occurrence in kept)
    yield from ((file, SWAPPED, occurrence) for occurrence in range(len(swappable(code))))


def calls(code, names=None, *, but=()):
    """The calls of the functions of those names, or of all but some."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if name not in but and (names is None or name in names):
                yield node


def swappable(code):
    """The first two arguments of every call that has them and where their order may matter."""
    alike = {"max", "min", "maximum", "minimum"}
    pairs = [call.args[:2] for call in calls(code, but=alike) if len(call.args) > 1]
    return [pair for pair in pairs if not any(isinstance(each, ast.Starred) for each in pair)]


def changed(code, operator, *, occurrence):
    """The code of a mutant."""
    if operator != SWAPPED:
        return mutate_code(code, get_operator(f"core/{operator}")(), occurrence) or code
    lines = code.encode().splitlines(keepends=True)
    starts = [0, *itertools.accumulate(map(len, lines))]
    whole = b"".join(lines)
    (a, b), (c, d) = (
        (
            starts[each.lineno - 1] + each.col_offset,
            starts[each.end_lineno - 1] + each.end_col_offset,
        )
        for each in swappable(code)[occurrence]
    )
    return (whole[:a] + whole[c:d] + whole[b:c] + whole[a:b] + whole[d:]).decode()


def tests_of(room):
    """The tests of a room: its folder of `tests`, or the files named after it, or all beside it."""
    folder = ROOT / "tests" / room.with_suffix("")
    named = [folder] if folder.is_dir() else sorted(folder.parent.glob(f"test_{room.stem}*.py"))
    return [str(each.relative_to(ROOT)) for each in named or [folder.parent]]


def copied_to(folder):
    """Copy all files that git knows of, or would take."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def passes(folder, tests, *, seconds=None):
    """Whether all tests pass in a copy; one that takes longer has noticed something."""
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", *tests]
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    environment["CHSEL_CACHE_DIR"] = str(folder / "kernels")
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, timeout=seconds
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def main():
    """Make the mutants, run the tests, and show those that nothing noticed."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.mutants", description=__doc__)
    parser.add_argument("room", type=Path, help="such as chsel/next_probe")
    parser.add_argument("--tests", nargs="+", help="files to run (default: those of the room)")
    parser.add_argument("--count", type=int, default=50, help="mutants of the sample")
    arguments = parser.parse_args()
    tests = arguments.tests or tests_of(arguments.room)
    console = Console()
    files = sorted((ROOT / arguments.room).rglob("*.py")) or [ROOT / arguments.room]
    mutants = [each for file in files for each in mutants_of(file.relative_to(ROOT))]
    chosen = random.Random(0).sample(mutants, min(arguments.count, len(mutants)))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copied_to(folder)
        begun = time.monotonic()
        if not passes(folder, tests):
            console.print(f"error: {' '.join(tests)} fail as they are; accepted: tests that pass")
            return 2
        longest = 3.0 * (time.monotonic() - begun) + 60.0  # kernels are compiled again
        noticed = number = 0
        for file, operator, occurrence in chosen:
            code = (ROOT / file).read_text()
            mutant = changed(code, operator, occurrence=occurrence)
            if mutant == code:  # Cosmic Ray has such
                continue
            number += 1
            (folder / file).write_text(mutant)
            survived = passes(folder, tests, seconds=longest)
            (folder / file).write_text(code)
            noticed += not survived
            if survived:
                lines = difflib.unified_diff(
                    code.splitlines(), mutant.splitlines(), lineterm="", n=1
                )
                console.print(f"[red]not noticed[/]: {file}")
                console.print(*list(lines)[2:], sep="\n", markup=False)
            console.print(f"{noticed} of {number} noticed", style="dim")
    share = 100.0 * noticed / max(number, 1)
    console.print(f"{arguments.room}: {noticed} of {number} of {len(mutants)}, {share:.0f} %")
    return 0


if __name__ == "__main__":
    sys.exit(main())
