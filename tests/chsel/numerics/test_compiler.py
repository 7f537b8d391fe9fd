"""Kernels are kept on disk; none that was compiled from other code, or by others, ever runs."""

import os
import shutil
import subprocess
import sys

import pytest

from chsel.errors import SettingError
from chsel.numerics import compiler
from tests.chsel.samples import REPOSITORY as ROOT

PLANTED = {
    "constant.py": "STEP = 1.0\n",
    "far.py": """
from chsel.constant import STEP
from chsel.numerics.compiler import leaf
@leaf
def far(x):
    return x + STEP
""",
    "near.py": """
from chsel.far import far
from chsel.numerics.compiler import compiled
@compiled
def near(x):
    return 2.0 * far(x)
""",
    "line.py": """
from chsel.numerics.compiler import compiled
def height(model, x):
    raise NotImplementedError
@compiled
def twice(model, x):
    return height(model, x) + height(model, x) + model.offset
""",
    "models.py": """
from typing import NamedTuple
from chsel.line import height
from chsel.numerics.compiler import implements
class Slope(NamedTuple):
    factor: float
    offset: float
@implements(height, Slope)
def _height(model, x):
    return model.factor * x
""",
    "third.py": """
from chsel.line import height
from chsel.models import Slope
from chsel.numerics.compiler import implements
@implements(height, Slope)
def _other(model, x):
    return 0.0
""",
}
CHANGE = """
import sys
from pathlib import Path
import chsel.numerics.compiler
file, old, new = sys.argv[1:]
file = Path(chsel.__file__).with_name(file)
file.write_text(file.read_text().replace(old, new))
"""
NEAR = """
from chsel.near import near
print(near(1.0), sum(near.stats.cache_misses.values()))
"""
LINE = """
from chsel.line import twice
from chsel.models import Slope
print(twice(Slope(3.0, 1.0), 1.0), sum(twice.stats.cache_misses.values()))
"""


def start(code, *words, root=ROOT, **changes):
    environment = {**os.environ, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1", **changes}
    command = [sys.executable, "-c", code, *words]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=root, env=environment, stdout=pipe, stderr=pipe, text=True)


def result_of(process):
    """What the process printed, and what on stderr."""
    out, errors = process.communicate()
    assert process.returncode == 0, errors
    return out, errors


@pytest.fixture
def printed(tmp_path):
    """What code prints that runs in a copy of the package with the planted files."""
    shutil.copytree(ROOT / "chsel", tmp_path / "chsel", ignore=shutil.ignore_patterns("__py*"))
    for name, text in PLANTED.items():
        (tmp_path / "chsel" / name).write_text(text)

    def numbers(code, *words):
        process = start(code, *words, root=tmp_path, CHSEL_CACHE_DIR=str(tmp_path / "kept"))
        return [float(word) for word in result_of(process)[0].split()]

    return numbers


def test_a_kernel_is_compiled_again_if_anything_that_it_contains_has_changed(printed, tmp_path):
    assert printed(NEAR) == [4.0, 1.0]
    assert printed(NEAR) == [4.0, 0.0]
    assert printed(CHANGE + NEAR, "far.py", "x +", "x -") == [0.0, 1.0]  # while it runs: not kept
    assert printed(NEAR) == [0.0, 1.0]
    constant = tmp_path / "chsel" / "constant.py"
    constant.write_text("STEP = 2.0\n")
    assert printed(NEAR) == [-2.0, 1.0]
    constant.write_text("STEP = 1.0\n")
    assert printed(NEAR) == [0.0, 0.0]
    for name in ("session/session.py", "line.py", "cost/cost_kernels.py"):  # near imports none
        file = tmp_path / "chsel" / name
        file.write_text(file.read_text() + "EDITED = True\n")
    assert printed(NEAR) == [0.0, 0.0]


def test_a_kernel_is_compiled_again_if_a_file_of_its_arguments_has_changed(printed, tmp_path):
    assert printed(LINE) == [7.0, 1.0]
    assert printed(LINE) == [7.0, 0.0]
    models = tmp_path / "chsel" / "models.py"
    text = models.read_text()
    models.write_text(text.replace("factor * x", "factor * x + 1.0"))
    assert printed(LINE) == [9.0, 1.0]
    models.write_text(text.replace("factor:", "swap:").replace("offset:", "factor:"))
    models.write_text(models.read_text().replace("swap:", "offset:"))
    assert printed(LINE) == [5.0, 1.0]  # factor 1, offset 3


def test_what_implements_a_name_in_a_third_file_is_refused(printed):
    with pytest.raises(
        AssertionError, match=r"third._other is in another file than height and Slo"
    ):
        printed("import chsel.third")


def test_a_folder_that_others_can_write_to_is_refused(tmp_path, monkeypatch):
    named = tmp_path / "open" / "named"
    named.mkdir(parents=True, mode=0o700)
    directory = compiler.cache_directory.__wrapped__
    monkeypatch.setenv("CHSEL_CACHE_DIR", str(named))
    named.parent.chmod(0o777)
    with pytest.raises(SettingError) as error:
        directory()
    assert str(error.value) == (
        f"CHSEL_CACHE_DIR is {named}, but others can write to {named.parent}, and compiled kernels "
        "are executed; accepted: a folder that only you, and root, can write to (chmod go-w)"
    )
