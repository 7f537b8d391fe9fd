"""Pages on programs of one's own: what stands there is what a user does, and it works."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import pytest

import chsel
from chsel import CompiledCost
from chsel.events import Decided
from chsel.next_probe.forecast import Forecast
from chsel.policies import build_policy
from replay.__main__ import program as replay
from replay.mcap.reader import read_recording
from tests.chsel.samples import REPOSITORY
from tests.runners.in_process import run

pytestmark = pytest.mark.slow
BLOCK = re.compile(r"^```(?P<language>\w+)\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
RECORDINGS = "logs/probe/*/recording.mcap"
NAMED = re.compile(r"`(?P<name>[\w./-]+\.\w+)`:\n\n\Z")


def shell(command, folder, **variables):
    """Run a command of a page in a folder; pip installs into its folder `site`, and offline."""
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(folder / "site"),
        "PIP_TARGET": str(folder / "site"),
        "PIP_NO_DEPS": "1",
        "PIP_NO_BUILD_ISOLATION": "0",  # pip reads it as: no isolation
        "PIP_NO_INDEX": "1",
        "COLUMNS": "120",
        "OMP_NUM_THREADS": "1",
        **variables,
    }
    command = ["bash", "-c", command]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


def followed(page, folder):
    """The folder, with all blocks of a page written that a line such as "`name.py`:" stands before,
    and the lines of its sh blocks run.
    """
    text = (REPOSITORY / "docs" / page).read_text()
    commands = ""
    for block in BLOCK.finditer(text):
        if named := NAMED.search(text[: block.start()]):
            path = folder / named["name"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block["text"])
        commands += block["text"] if block["language"] == "sh" else ""
    for command in commands.replace("\\\n", " ").splitlines():
        done = shell(command, folder)
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    return folder


def test_a_program_that_knows_nothing_of_this_package_is_ranked(tmp_path):
    followed("outside_methods.md", tmp_path)
    (program,) = tmp_path.glob("*.py")
    assert "chsel" not in program.read_text()
    rows = parquet.read_table(tmp_path / "ranking/results.parquet").to_pylist()
    by_method = {(row["method"], row["step"]): row for row in rows}
    assert set(by_method) == {(name, step) for name in ("centred", "icp") for step in (4, 5)}
    for step in (4, 5):
        outside, icp = by_method["centred", step], by_method["icp", step]
        assert outside["status"] == icp["status"] == "ok"
        assert (outside["preset"], outside["hypotheses"]) == ("outside", 30)
        assert (outside["seconds"], outside["best_cost"]) == (None, None)
        assert 0.0 < outside["diversity"] != icp["diversity"]
        # All of its positions are the mean contact: less than the object's size from the truth.
        assert 0.0 < outside["position_error"] < 0.5


@pytest.fixture(scope="module")
def method(tmp_path_factory):
    """A folder in which everything on the page was done, and its recordings by their rounds."""
    folder = followed("writing_a_method.md", tmp_path_factory.mktemp("method"))
    read = map(read_recording, folder.glob(RECORDINGS))
    return folder, {one.start.config["method"]["rounds"]: one for one in read}


def test_a_session_is_recorded_with_the_method_and_its_settings(method):
    read = method[1][50]
    assert read.start.method == "hill_climb"
    assert read.start.config["method"]["rotation"] == 0.3
    assert len(read.steps) > 1
    for step in read.steps:
        problem, found = read.problem(step), read.hypotheses(step)
        before = np.sort(CompiledCost.of(problem).evaluate(problem.initial_set))
        assert len(found.cost) == len(before) == 30
        assert (found.cost <= before).all()
        assert found.cost.sum() < before.sum()
    config = method[1][10].start.config["method"]  # by a file of a named set of settings
    assert (config["name"], config["rotation"], config["translation"]) == ("hill_climb", 0.6, 0.03)


def test_verify_finds_a_method_that_was_changed(method):
    folder, read = method
    installed = folder / "site" / "hill_climb.py"
    source = installed.read_text()
    try:
        installed.write_text(source.replace("cost < costs", "cost <= costs + 1e-3"))
        done = shell(f"python -m replay verify {read[10].path}", folder)
    finally:
        installed.write_text(source)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "first difference: climb, iteration 10" in done.stdout


def test_without_the_package_the_recording_can_still_be_read(method, tmp_path):
    path = str(method[1][10].path)
    exported = str(tmp_path / "out.json")
    assert run(replay, "info", path).returncode == 0
    assert (
        run(
            replay, "export", path, "--what", "hypotheses", "--format", "json", "-o", exported
        ).returncode
        == 0
    )
    done = run(replay, "verify", path)
    assert done.returncode == 2
    assert "method is 'hill_climb'; accepted: chsel," in done.stderr


def test_what_is_no_method_is_one_line(tmp_path):
    """Of a package as pip installs it: a module, and a folder that says what it offers."""
    about = tmp_path / "site" / "mine-1.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[chsel.methods]\nmine = mine:Mine\n")
    (tmp_path / "site" / "mine.py").write_text("import nothing_of_this_name")
    done = shell("python -m runners.probe method=mine session=kinematic", tmp_path)
    assert done.returncode == 2, done.stdout
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert "ModuleNotFoundError: No module" in done.stderr
    other = shell("python -m runners.probe method=svgd --cfg job", tmp_path)  # as ever
    assert (other.returncode, other.stderr) == (0, "")


def test_a_policy_decides_as_its_page_says_and_not_without_the_package(tmp_path):
    """The first probe is by entropy, and those after it by information."""
    folder = followed("writing_a_policy.md", tmp_path)
    (path,) = folder.glob(RECORDINGS)
    read = read_recording(path)
    group = read.start.config["policy"]
    assert (group["name"], group["first"]) == ("entropy_first", 1)
    decisions = [event for event in read.events() if isinstance(event, Decided)]
    assert [event.step for event in decisions] == [-1, 0, 1, 2]
    names = ("voxel_entropy", "information", "information")
    for name, event in zip(names, decisions, strict=False):
        expected = build_policy(name).rate(event.problem, Forecast(event.problem, 0.002))
        taken = np.isfinite(event.decision.score)
        assert taken.sum() > 50
        assert np.array_equal(event.decision.score[taken], expected[taken])
    done = shell(f"python -m replay verify {path}", folder, PYTHONPATH="")
    assert done.returncode == 2, done.stdout
    assert "policy is 'entropy_first'; accepted: grid," in done.stderr


def test_the_site_is_built_without_a_warning_and_has_every_public_name():
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    pytest.importorskip("zensical", reason="the extra docs is not installed")
    given = [f"BIN={Path(sys.executable).parent}", "INSTALL=true", "VENV=build"]
    made = ["make", *given, "-o", "build/constraints.txt", "docs"]
    done = subprocess.run(made, cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "No issues found" in done.stdout + done.stderr
    site = REPOSITORY / "build" / "site"
    page = (site / "docs" / "api.html").read_text()
    documented_together = {"__version__", "build_method", "build_policy"}
    for name in set(chsel.__all__) - documented_together:
        assert f'id="chsel.{name}"' in page, name
    titles = [item["title"] for item in json.loads((site / "search.json").read_text())["items"]]
    assert any("grasp_chance" in title for title in titles)
