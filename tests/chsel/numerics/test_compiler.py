"""Where machine code is kept: in processes of their own, as that is settled once in each."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numba
import pytest
from filelock import FileLock
from numba import TypingError

from chsel.numerics import kernel_cache, kernel_sources
from chsel.numerics.compiler import compiled, inner
from chsel.numerics.kernel_sources import kernel_sources as compiler_sources

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


def test_a_named_folder_in_one_that_others_can_write_to_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    named = tmp_path / "open" / "named"
    named.mkdir(parents=True)
    monkeypatch.setenv("CHSEL_CACHE_DIR", str(named))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    named.parent.chmod(0o777)
    assert kernel_cache.cache_directory.__wrapped__().is_relative_to(tmp_path / "xdg")
    assert [record.getMessage() for record in caplog.records] == [
        f"CHSEL_CACHE_DIR is {named}, whose parent {named.parent} others can write to, and "
        "compiled kernels are executed; accepted: a folder whose parents only you and root can "
        "write to. The default folder is used"
    ]
    named.parent.chmod(0o1777)  # sticky, as /tmp
    assert kernel_cache.cache_directory.__wrapped__().is_relative_to(named)


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


PLANTED = {
    "far.py": "from chsel.numerics.compiler import leaf\n@leaf\ndef far(x):\n    return x + 1.0\n",
    "near.py": """
from chsel.numerics.compiler import inner
from planted.far import far
@inner
def near(x):
    return 2.0 * far(x)
""",
    "called.py": """
from chsel.numerics.compiler import compiled, inner
from planted.near import near
def value_of(model):
    raise NotImplementedError
@compiled
def total(model, x):
    return value_of(model) + near(x)
""",
    "model.py": """
from typing import NamedTuple
from chsel.numerics.compiler import implements
from planted.called import value_of
class Model(NamedTuple):
    scale: float
@implements(value_of, Model)
def _value_of(model):
    return 100.0 * model.scale
""",
    "unrelated.py": "from chsel.numerics.compiler import leaf\n@leaf\ndef f(x):\n    return x\n",
    "__init__.py": "",
}
CHANGES = {  # what is written in place of what, in which file; and the total then
    "nothing": ("unrelated.py", "", "", 304.0),
    "a file that the kernel does not use": ("unrelated.py", "return x", "return -x", 304.0),
    "a callee": ("near.py", "2.0", "3.0", 306.0),
    "a leaf three files away": ("far.py", "1.0", "2.0", 306.0),
    "what implements the model": ("model.py", "100.0", "200.0", 604.0),
    "a field": ("model.py", "scale", "size", 304.0),
    "the kernel": ("called.py", "+ near", "- near", 296.0),
}
CALLED_AFTER_CHANGES = """
import json, os, sys
from pathlib import Path
import numpy as np
import chsel.numerics.compiler
files, changes = json.loads(sys.argv[1]), json.loads(sys.argv[2])
for name, (file, old, new, _) in changes.items():
    if os.fork() == 0:  # a process that has loaded the compiler alone
        for path, text in files.items():
            Path("planted", path).write_text(text.replace(old, new) if path == file else text)
        sys.path.insert(0, ".")
        sys.dont_write_bytecode = True
        from planted import model, called, unrelated
        total = called.total(model.Model(3.0), 1.0)
        compiled = sum(called.total.stats.cache_misses.values())
        if name == "the kernel":
            Path("planted", "called.py").write_text("while it runs")
            called.total(model.Model(3.0), 1)
        print(json.dumps([name, total, compiled, len(list(Path("kept").rglob("*.nbc")))]))
        sys.stdout.flush()
        os._exit(0)
    os.wait()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_kernel_is_compiled_again_if_what_it_runs_has_changed_and_only_then(
    tmp_path: Path,
) -> None:
    (tmp_path / "planted").mkdir()
    environment = {**os.environ, "CHSEL_CACHE_DIR": str(tmp_path / "kept")}
    environment["PYTHONPATH"] = str(ROOT)
    command = [sys.executable, "-c", CALLED_AFTER_CHANGES, json.dumps(PLANTED)]
    command.append(json.dumps(CHANGES))
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(name, total) for name, total, _, _ in rows] == [
        (name, change[-1]) for name, change in CHANGES.items()
    ]
    unchanged = "a file that the kernel does not use"
    assert [name for name, _, compiled, _ in rows if not compiled] == [unchanged]
    kept = [number for *_, number in rows]
    assert kept == [1, 1, 2, 3, 4, 5, 7]


def test_imports_are_found_as_python_finds_them() -> None:
    """Reading them with a pattern takes a twentieth of the time."""
    for path in compiler_sources():
        file, tree = kernel_sources._read(path), ast.parse(path.read_text())
        expected = {
            name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
        } | {
            alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.Import)
            for alias in node.names
        }
        assert expected <= file.imported
    text = b"from . import a\nfrom ..b import (\n    c,\n)\nimport d.e as f, g\n"
    relative = kernel_sources.SourceFile("x.y.z", Path("z.py"), Path(), text)
    assert relative.imported >= {"x.y", "x.y.a", "x.b", "x.b.c", "d.e", "g"}


FACTOR = 2.0


def halves(value: float) -> float:
    return 0.5 * value


def doubles(value: float) -> float:
    return FACTOR * value


def wrong(value: float) -> Any:
    return value.nothing  # type: ignore[attr-defined]


def test_a_kernel_that_another_process_compiles_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_cache, "cache_directory", lambda: tmp_path)
    compiled(halves)(1.0)
    (code,) = tmp_path.iterdir()
    away = code.rename(tmp_path / "away")
    lock = FileLock(code.with_suffix(".lock"), thread_local=False)
    lock.acquire()

    def finish() -> None:
        away.rename(code)
        lock.release()

    threading.Timer(0.3, finish).start()
    kernel: Any = compiled(halves)
    assert kernel(3.0) == 1.5
    assert kernel.stats.cache_hits
    with pytest.raises(TypingError):
        compiled(wrong)(1.0)
    assert [path.suffix for path in tmp_path.iterdir()] == [".nbc"]  # and no claim


def test_code_is_kept_for_the_constants_and_options_that_it_was_compiled_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_cache, "cache_directory", lambda: tmp_path)
    assert compiled(doubles)(3.0) == 6.0
    with monkeypatch.context() as patch:
        patch.setattr(sys.modules[__name__], "FACTOR", 5.0)
        assert compiled(doubles)(3.0) == 15.0
    for number, (name, value) in enumerate([("BOUNDSCHECK", 1), ("OPT", 0)]):
        with monkeypatch.context() as patch:
            patch.setattr(numba.core.config, name, value)
            assert compiled(doubles)(3.0) == 6.0
        assert len(kernels_in(tmp_path)) == 3 + number


def test_the_code_of_another_kernel_is_not_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_cache, "cache_directory", lambda: tmp_path)
    compiled(halves)(1.0)
    (other,) = kernels_in(tmp_path)
    compiled(doubles)(1.0)
    (own,) = set(kernels_in(tmp_path)) - {other}
    own.write_bytes(other.read_bytes())
    assert compiled(doubles)(3.0) == 6.0


def test_code_that_nobody_uses_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def file(path: Path, days: float) -> Path:
        path.parent.mkdir(exist_ok=True)
        path.touch()
        os.utime(path, (time.time() - 86400.0 * days,) * 2)
        return path

    old, new = file(tmp_path / ("0" * 16) / "a.nbi", 61), file(tmp_path / ("1" * 16) / "a.nbc", 59)
    theirs = file(tmp_path / "notes" / "a.nbc", 900)
    more = [file(tmp_path / f"{n:016x}" / "a.nbc", n) for n in range(2, 2 + 15)]
    folder = tmp_path / ("f" * 16)
    versions = [file(folder / f"a.f-11111111-{n}.nbc", n) for n in range(9)]
    others = [file(folder / f"a.f-22222222-{n}.nbc", 30) for n in range(3)]
    kernel_cache._prune(versions[0])
    assert not old.exists()
    assert not new.exists()  # the sixteenth of those that are left, beside that in use
    assert all(path.exists() for path in (*more, theirs, *versions[:8], *others))
    assert not versions[8].exists()


def test_damaged_code_is_compiled_again(tmp_path: Path) -> None:
    names = {"CHSEL_CACHE_DIR": str(tmp_path / "kept")}
    first, _ = result_of(start(COMPUTE, tmp_path, **names))
    kept = kernels_in(tmp_path)
    for path in kept:
        whole = bytearray(path.read_bytes())
        whole[len(whole) // 2] ^= 1
        path.write_bytes(whole)
    again, said = result_of(start(COMPUTE, tmp_path, **names))
    assert again == first
    assert "compiling the kernels" in said
    assert kernels_in(tmp_path) == kept


def names_from_elsewhere(source: Path) -> set[str]:
    """Names that kernels of a file take from files without kernels, as "kernel: name"."""
    tree, kernel_files = ast.parse(source.read_text()), set(compiler_sources())
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
    assert {name for source in compiler_sources() for name in names_from_elsewhere(source)} == set()
    planted = tmp_path / "planted.py"
    planted.write_text(
        "from chsel.problem.sdf_grid import COARSEST\n@leaf\ndef f(x):\n    return x + COARSEST\n"
    )
    assert names_from_elsewhere(planted) == {"f: COARSEST"}


def test_what_kernels_alone_call_is_made_machine_code_with_them_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_cache, "cache_directory", lambda: tmp_path)  # nothing is loaded
    caller = compiled(_caller)
    assert caller(2.0) == 9.0
    (result,), (part,) = caller.overloads.values(), _part.overloads.values()  # type: ignore[attr-defined]
    assert result.library._compiled_object
    assert getattr(part.library, "_compiled_object", None) is None
    assert part.entry_point is not None


@inner
def _part(x: float) -> float:
    return x * x


def _caller(x: float) -> float:
    return 2.0 * _part(x) + 1.0
