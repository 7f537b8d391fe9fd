"""What make would do, without doing it, and which versions it asks pip for."""

from __future__ import annotations

import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
MAKE = shutil.which("make")
pytestmark = pytest.mark.skipif(MAKE is None, reason="make is not installed")


def made(folder: Path, *words: str) -> str:
    for name in ("Makefile", "constraints.txt", "pyproject.toml"):
        shutil.copy(REPOSITORY / name, folder)
    command = ["make", f"PYTHON={sys.executable}", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


OPTIONS = "--index-url=URL --no-deps"
INSTALL = f".venv/bin/python -m pip install --quiet {OPTIONS} --constraint .venv/constraints.txt"
FIRST = ("filelock", "numba", "numpy", "pyyaml", "scipy")  # to compile with, while others come
STEPS = [
    f"{INSTALL} {' '.join(FIRST)}",
    ".venv/bin/python -m chsel.background_rehearsal >/dev/null 2>&1 &",
    f"{INSTALL} --editable .",
    f'{INSTALL} --editable ".[test]"',
]


@pytest.mark.parametrize("goal", ["probe", "test"])
def test_make_passes_options_on_to_pip_and_venv(goal: str, tmp_path: Path) -> None:
    words = (f"PIP_ARGS={OPTIONS}", "VENV_ARGS=--system-site-packages")
    lines = made(tmp_path, "-n", goal, *words).splitlines()
    steps = [line for line in lines if "pip install" in line or "background" in line]
    assert steps == STEPS[: {"probe": 3, "test": 4}[goal]]
    assert any(" -m venv --system-site-packages .venv" in line for line in lines)


def test_kernels_are_compiled_with_the_packages_that_are_installed_first() -> None:
    """In a process that finds no other package, with kernels that are there if others need them."""
    names = [name.replace("pyyaml", "yaml") for name in FIRST]
    code = f"""
import sys
class Others:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in {{*sys.stdlib_module_names, "chsel", "llvmlite", *{names}}}:
            raise ModuleNotFoundError(name=name)
sys.meta_path.insert(0, Others())
from chsel import rehearsal
def register_twice(method, register=rehearsal._register_twice):
    register(method)
    print(*sorted(name for name in {names} if name in sys.modules))
rehearsal._register_twice = register_twice
from chsel.background_rehearsal import main
sys.argv = ["chsel.background_rehearsal"]
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout.split()) == (0, sorted(names)), done.stderr


@pytest.mark.parametrize("version", [None, "2.9.1+cpu"])
def test_a_torch_that_is_there_stays(version: str | None, tmp_path: Path) -> None:
    venv.create(tmp_path / ".venv", with_pip=False)
    if version is not None:
        (packages,) = (tmp_path / ".venv").glob("lib/python*/site-packages")
        metadata = packages / f"torch-{version}.dist-info" / "METADATA"
        metadata.parent.mkdir()
        metadata.write_text(f"Metadata-Version: 2.1\nName: torch\nVersion: {version}\n")
    made(tmp_path, ".venv/constraints.txt")
    asked = (tmp_path / ".venv" / "constraints.txt").read_text().splitlines()
    pinned = (REPOSITORY / "constraints.txt").read_text().splitlines()
    torch = [line for line in pinned if line.startswith("torch==")]
    assert len(torch) == 1
    assert asked == [line for line in pinned if version is None or line not in torch]
