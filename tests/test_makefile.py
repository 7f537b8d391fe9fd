"""What make would do, without doing it, and which versions it asks pip for."""

import shutil
import subprocess
import sys
import venv

import pytest

from tests.chsel.samples import REPOSITORY

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def made(folder, *words):
    for name in ("Makefile", "constraints.txt", "pyproject.toml"):
        shutil.copy(REPOSITORY / name, folder)
    command = ["make", f"PYTHON={sys.executable}", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


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
