"""What make would do, without doing it, and which versions it asks pip for."""

import shutil
import subprocess
import sys
import venv

import pytest

from tests.chsel.samples import REPOSITORY

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
OPTIONS = "--index-url=URL --no-deps"
INSTALL = f".venv/bin/python -m pip install --quiet {OPTIONS} --constraint .venv/constraints.txt"


def made(folder, *words):
    for name in ("Makefile", "constraints.txt", "pyproject.toml"):
        shutil.copy(REPOSITORY / name, folder)
    command = ["make", f"PYTHON={sys.executable}", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.parametrize(("goal", "extras"), [("probe", ["all"]), ("test", ["all", "test"])])
def test_make_passes_options_on_to_pip_and_venv(goal, extras, tmp_path):
    words = (f"PIP_ARGS={OPTIONS}", "VENV_ARGS=--system-site-packages")
    lines = made(tmp_path, "-n", goal, *words)
    steps = [line for line in lines if "pip install" in line]
    assert steps == [f'{INSTALL} --editable ".[{extra}]"' for extra in extras]
    assert any(" -m venv --system-site-packages .venv" in line for line in lines)


@pytest.mark.parametrize("version", [None, "2.9.1+cpu"])
def test_a_torch_that_is_there_stays(version, tmp_path):
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
