"""Who imports whom."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
FORBIDDEN = {
    "chsel": {"runners", "replay", "conf", "hydra", "omegaconf", "mcap", "rerun", "pybullet"},
    "replay": {"runners", "conf", "hydra", "omegaconf", "pybullet"},
    "runners": set(),
}


def imported(file: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("room", FORBIDDEN)
def test_a_room_imports_only_what_it_may(room: str) -> None:
    files = sorted((REPOSITORY / room).rglob("*.py"))
    assert len(files) > 5
    found = {str(file): imported(file) & FORBIDDEN[room] for file in files}
    assert not {file: names for file, names in found.items() if names}


def test_the_physics_engine_is_imported_in_one_place() -> None:
    files = (REPOSITORY / "runners").rglob("*.py")
    users = {file.name for file in files if imported(file) & {"pybullet", "pybullet_data"}}
    assert users == {"physics_engine.py"}


def test_nothing_imports_the_physics_engine_before_it_is_needed() -> None:
    code = "import sys, runners.probe, runners.sessions; print('pybullet' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
