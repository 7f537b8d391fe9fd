"""docs/writing_a_method.md: what stands there is what a user does, and it replays."""

import numpy as np
import pytest

from chsel import CompiledCost
from replay.__main__ import program as replay
from replay.mcap.reader import read_recording
from tests.docs.page import commands, shell, write_files
from tests.runners.in_process import run

pytestmark = pytest.mark.slow
PAGE = "writing_a_method.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder in which everything on the page was done."""
    folder = tmp_path_factory.mktemp("method")
    write_files(PAGE, folder)
    for command in commands(PAGE):
        done = shell(command, folder)
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    return folder


def recording(folder, rounds):
    for file in folder.glob("logs/probe/*/recording.mcap"):
        if read_recording(file).start.config["method"]["rounds"] == rounds:
            return file
    raise AssertionError(f"no recording of {rounds} rounds")


def test_a_session_is_recorded_with_the_method_and_its_settings(folder):
    read = read_recording(recording(folder, 50))
    assert read.start.method == "hill_climb"
    assert read.start.config["method"]["rotation"] == 0.3
    first, *_, last = read.steps
    problem, found = read.problem(last), read.hypotheses(last)
    assert last > first
    assert len(found.cost) == len(problem.initial_set) == 30
    assert found.cost[0] < read.hypotheses(first).cost[-1]


def test_no_start_ends_at_a_higher_cost(folder):
    read = read_recording(recording(folder, 50))
    for step in read.steps:
        problem, found = read.problem(step), read.hypotheses(step)
        before = np.sort(CompiledCost.of(problem).evaluate(problem.initial_set))
        assert (found.cost <= before).all()
        assert found.cost.sum() < before.sum()


def test_a_named_set_of_settings_is_a_file(folder):
    config = read_recording(recording(folder, 10)).start.config["method"]
    assert (config["name"], config["rotation"], config["translation"]) == ("hill_climb", 0.6, 0.03)


def test_verify_finds_a_method_that_was_changed(folder):
    path = recording(folder, 10)
    installed = folder / "site" / "hill_climb.py"
    source = installed.read_text()
    try:
        installed.write_text(source.replace("cost < costs", "cost <= costs + 1e-3"))
        done = shell(f"python -m replay verify {path}", folder)
    finally:
        installed.write_text(source)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "first difference: climb, iteration 10" in done.stdout


def test_without_the_package_the_recording_can_still_be_read(folder, tmp_path):
    path, exported = str(recording(folder, 10)), str(tmp_path / "out.json")
    assert run(replay, "info", path).returncode == 0
    export = ("export", path, "--what", "hypotheses", "--format", "json", "-o", exported)
    assert run(replay, *export).returncode == 0
    done = run(replay, "verify", path)
    assert done.returncode == 2
    assert "method is 'hill_climb'; accepted: chsel," in done.stderr


@pytest.mark.parametrize(
    ("line", "code", "message"),
    [
        ("mine = mine:Mine", "import nothing_of_this_name", "ModuleNotFoundError: No module"),
        ("mine = mine:Mine", "Mine = dict", "has settings None; accepted: a frozen dataclass"),
        ("icp = mine:Mine", "", "method icp is of package mine, too; accepted: one of"),
    ],
)
def test_what_is_no_method_is_one_line(tmp_path, line, code, message):
    """Of a package as pip installs it: a module, and a folder that says what it offers."""
    about = tmp_path / "site" / "mine-1.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1\n")
    (about / "entry_points.txt").write_text(f"[chsel.methods]\n{line}\n")
    (tmp_path / "site" / "mine.py").write_text(code)
    name = line.split()[0]
    done = shell(f"python -m runners.probe method={name} session=kinematic", tmp_path)
    assert done.returncode == 2, done.stdout
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    if name == "mine":  # other methods go on as ever
        other = shell("python -m runners.probe method=svgd --cfg job", tmp_path)
        assert (other.returncode, other.stderr) == (0, "")
