"""Where machine code is kept: in processes of their own, as that is settled once in each."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from chsel.numerics import compiler

ROOT = Path(__file__).resolve().parents[3]
COMPUTE = """
import numpy as np
from chsel.numerics.elementary import sines_cosines
print(np.stack(sines_cosines(np.linspace(-9.0, 9.0, 50))).tobytes().hex())
"""


def start(
    code: str, tmp_path: Path, umask: int = -1, **changes: str | None
) -> subprocess.Popen[str]:
    """A process with a home folder of its own; None takes a variable out of the environment."""
    home = tmp_path / "home"
    environment: dict[str, str | None] = {**os.environ, "HOME": str(home), "TMPDIR": str(tmp_path)}
    for name in ("CHSEL_CACHE_DIR", "XDG_CACHE_HOME", "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"):
        environment[name] = None
    environment |= {"OMP_NUM_THREADS": "1"} | changes
    return subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env={name: value for name, value in environment.items() if value is not None},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        umask=umask,
    )


def result_of(process: subprocess.Popen[str]) -> tuple[str, str]:
    """What the process printed, and what it said on stderr."""
    out, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert len(out.strip()) == 2 * 2 * 50 * 8
    return out, said


def kernels_in(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.nbc"))


def test_kernels_are_kept_in_the_named_folder_apart_for_every_cpu(tmp_path: Path) -> None:
    named = tmp_path / "kept" / "here"
    names = {"CHSEL_CACHE_DIR": str(named)}
    first, said = result_of(start(COMPUTE, tmp_path, **names))
    assert str(named) in said
    assert said.count("compiling the kernels") == said.count("CPU, once:") == 1
    made = kernels_in(named)
    assert len(made) > 0
    assert len({path.relative_to(named).parts[0] for path in made}) == 1
    again, said = result_of(start(COMPUTE, tmp_path, **names))
    assert (again, said) == (first, "")
    assert kernels_in(named) == made
    plain = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    other, said = result_of(start(COMPUTE, tmp_path, **names, **plain))
    assert other == first  # to the bit, by code for another CPU
    assert "compiling the kernels" in said
    assert len({path.relative_to(named).parts[0] for path in kernels_in(named)}) == 2
    assert not (tmp_path / "home").exists()
    more = "from chsel.numerics.elementary import logs, arctangents; ones = np.ones(2)"
    code = f"{COMPUTE}\n{more}; logs(ones); arctangents(ones, ones)"
    _, said = result_of(
        start(code, tmp_path, **names)
    )  # "once" is not said of those that come later
    assert said == f"compiling the kernels that are still missing (kept in {named})\n"


def test_two_processes_that_start_on_an_empty_folder_share_private_folders(tmp_path: Path) -> None:
    """Whatever the umask; those that an earlier version left open to a group, too."""
    xdg, temporary = tmp_path / "xdg", tmp_path / "temporary"
    temporary.mkdir()
    names = {"XDG_CACHE_HOME": str(xdg), "TMPDIR": str(temporary)}
    processes = [start(COMPUTE, tmp_path, umask=0o002, **names) for _ in range(2)]
    (one, _), (other, _) = (result_of(process) for process in processes)
    assert one == other
    place = xdg / "chsel" / "kernels"
    kept = kernels_in(place)
    assert kept
    folders = [xdg, xdg / "chsel", place, *place.iterdir()]
    assert {folder.stat().st_mode & 0o777 for folder in folders} == {0o700}
    place.chmod(0o775)
    assert result_of(start(COMPUTE, tmp_path, umask=0o002, **names)) == (one, "")
    assert place.stat().st_mode & 0o022 == 0
    assert kernels_in(place) == kept
    assert not list(temporary.glob("chsel*"))


@pytest.mark.parametrize(
    ("mode", "reason"),
    [
        (None, "which cannot be written; accepted: a folder for compiled kernels"),
        (
            0o777,
            "which others can write to, and compiled kernels are executed; accepted: a folder that "
            "only you can write to (chmod go-w)",
        ),
    ],
    ids=["a file", "open to all"],
)
def test_a_named_folder_that_cannot_be_used_is_named_and_passed_over(
    tmp_path: Path, mode: int | None, reason: str
) -> None:
    named = tmp_path / "named"
    if mode is None:
        named.write_text("no folder")
    else:
        named.mkdir()
        named.chmod(mode)
    names = {"CHSEL_CACHE_DIR": str(named), "XDG_CACHE_HOME": str(tmp_path / "xdg")}
    _, said = result_of(start(COMPUTE, tmp_path, **names))
    first = f"CHSEL_CACHE_DIR is {named}, {reason}. The default folder is used"
    assert said.splitlines()[0] == first
    assert kernels_in(tmp_path / "xdg")
    assert named.read_text() == "no folder" if mode is None else not kernels_in(named)


NAMELESS = """
import pwd
def nobody(user):
    raise KeyError(user)
pwd.getpwuid = nobody
"""


@pytest.mark.skipif(sys.platform == "win32", reason="a file cannot stand in for the folder there")
@pytest.mark.parametrize("code", [COMPUTE, NAMELESS + COMPUTE], ids=["named user", "nameless"])
def test_without_a_home_that_can_be_written_kernels_go_to_a_temporary_folder(
    tmp_path: Path, code: str
) -> None:
    """A file in place of the home folder: as root, permissions would not hold anybody back."""
    (tmp_path / "home").write_text("no folder")
    names = dict.fromkeys(("LOGNAME", "USER", "LNAME", "USERNAME"))
    _, said = result_of(start(code, tmp_path, **names))
    assert len(kernels_in(tmp_path)) > 0
    assert str(tmp_path) in said


def twice(value: float) -> float:
    return 2.0 * value


def test_kernels_are_saved_while_no_other_process_saves(monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[str] = []

    class Lock:
        def __init__(self, path: Path) -> None:
            assert path.parent == compiler.cache_directory()

        def __enter__(self) -> None:
            events.append("locked")

        def __exit__(self, *_: object) -> None:
            events.append("free")

    monkeypatch.setattr(compiler, "FileLock", Lock)
    save = compiler._one_at_a_time(lambda *arguments: events.extend(arguments))
    save("signature", "code")
    assert events == ["locked", "signature", "code", "free"]
    kernel: Any = compiler.compiled(twice)
    assert kernel._cache.save_overload.__qualname__.startswith("_one_at_a_time")


def names_from_elsewhere(source: Path) -> set[str]:
    """Names that kernels of a file take from files without kernels, as "kernel: name"."""
    tree, kernel_files = ast.parse(source.read_text()), set(compiler.kernel_sources())
    elsewhere = {
        alias.asname or alias.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("chsel.")
        for alias in node.names
        if ROOT / f"{str(node.module).replace('.', '/')}.py" not in kernel_files
    }
    decorators = {"compiled", "inner", "leaf", "spliced"}
    found = set()
    for kernel in tree.body:
        if not isinstance(kernel, ast.FunctionDef):
            continue
        if decorators.isdisjoint(ast.unparse(each) for each in kernel.decorator_list):
            continue
        names = {node.id for line in kernel.body for node in ast.walk(line) if _is_read(node)}
        parameters = {argument.arg for argument in kernel.args.args}
        found |= {f"{kernel.name}: {name}" for name in names & elsewhere - parameters}
    return found


def _is_read(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)


def test_kernels_take_constants_from_kernel_files_alone(tmp_path: Path) -> None:
    """Machine code holds them, and other files are not in its fingerprint."""
    assert {
        name for source in compiler.kernel_sources() for name in names_from_elsewhere(source)
    } == set()
    planted = tmp_path / "planted.py"
    planted.write_text(
        "from chsel.problem.sdf_grid import COARSEST\n@leaf\ndef f(x):\n    return x + COARSEST\n"
    )
    assert names_from_elsewhere(planted) == {"f: COARSEST"}
