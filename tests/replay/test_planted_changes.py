"""A change in a kernel, planted into a copy of the code, turns a stored replay red at its stage."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
REPOSITORY = Path(__file__).resolve().parents[2]
RECORDING = REPOSITORY / "tests" / "replays" / "spam_can_gradient_descent.mcap"
KERNEL = "chsel/cost/cost_kernels.py"
LINE = "value = scale * excess"
PLANTED = "value = 1.0000000000001 * scale * excess"


def verified(folder: Path, **changes: str) -> subprocess.CompletedProcess[str]:
    """`replay verify` with the packages in a folder."""
    return subprocess.run(
        [sys.executable, "-m", "replay", "verify", str(RECORDING)],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(folder), **changes},
        capture_output=True,
        text=True,
    )


def test_a_change_in_a_kernel_is_compiled_and_found(tmp_path: Path) -> None:
    for package in ("chsel", "replay"):
        unwanted = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / package, tmp_path / package, ignore=unwanted)
    same = verified(tmp_path)
    assert same.returncode == 0, same.stderr
    assert "4 of 4 steps equal" in same.stdout
    text = (tmp_path / KERNEL).read_text()
    assert text.count(LINE) == 1
    (tmp_path / KERNEL).write_text(text.replace(LINE, PLANTED))
    done = verified(tmp_path, CHSEL_CACHE_DIR=str(tmp_path / "kept"))
    assert "compiling the kernels" in done.stderr
    assert done.returncode == 1
    stages = re.findall(r"first difference: (.*) \(", done.stdout)
    steps = re.findall(r"step -?\d+, \w+: differs", done.stdout)
    assert len(steps) == len(stages) > 0
    assert set(stages) == {"descent, iteration 0"}, done.stdout
