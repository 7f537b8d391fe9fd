"""The tables of a report that compare all methods with one of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from runners import report
from runners.reporting.evaluation_folder import open_evaluation
from tests.runners.in_process import run
from tests.runners.made_up_evaluations import row, write_evaluation
from tests.runners.test_report import page_of

SUMMARY = "PD and its ratios over all registrations, by default"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two draws of the package and of an anchored method, at two steps of a trial."""
    numbers = {"exact_members": 0.5, "distinct": 30, "seconds": 0.1}
    found = [
        ("package", 4, {"diversity": 100.0, "best_cost": 7.0, "distinct": 12, "seconds": 2.0}),
        ("package+1", 4, {"diversity": 400.0, "best_cost": 7.0, "distinct": 10, "seconds": 4.0}),
        ("package", 5, {"diversity": 100.0, "best_cost": 7.0, "distinct": 8, "seconds": 3.0}),
        ("package+1", 5, {"diversity": 100.0, "best_cost": 7.0, "distinct": 30, "seconds": 3.0}),
        ("own", 4, {"diversity": 20.0, "best_cost": 0.001, **numbers}),
        ("own+1", 4, {"diversity": 400.0, "best_cost": 0.0031, **numbers, "exact_members": 0.8}),
        ("own", 5, {"diversity": 0.0, "best_cost": 0.003, **numbers}),
    ]
    rows = [row("can", 0, method, step, **values) for method, step, values in found]
    rows.append(row("can", 0, "own+1", 5) | {"status": "failed: of a lack of memory"})
    about = {"name": "anchored", "preset": "default", "settings": {}}
    methods = {"own": about, "own+1": {**about, "draw": 1}}
    outside = {"package": "sets", "package+1": "sets/draw_1"}
    planned = {"configurations": ["can"], "seeds": [0], "methods": methods, "outside": outside}
    return write_evaluation(tmp_path / "evaluation", rows, **planned)


def test_ratios_are_of_the_same_trial_and_step_by_the_mean_of_the_baselines_draws(
    folder: Path,
) -> None:
    done = run(report.main, str(folder), "baseline=package")
    assert (done.returncode, done.stderr) == (0, "")
    tables = page_of(folder / "report").tables
    header, own, package = tables[SUMMARY]
    by = dict(zip(header, own, strict=True))
    assert by["method"] == "own"
    assert by["n"] == "3 1 left out"
    assert by["PD in mm², median [quartiles]"] == "20 [10, 210]"
    assert by["geometric mean"] == "20"  # of 20, 400 and 1, as which 0 counts
    assert by["ratio to package"] == "0.126"  # of 20 / 200, 400 / 200 and 1 / 100
    assert by["worse"] == "33.3 %"
    assert by["members"] == "60.0 %"
    assert by["distinct [least]"] == "30 [30]"
    assert by["misses"] == "33.3 %"
    assert (by["s, median"], by["s, mean"]) == ("0.1", "0.1")
    by = dict(zip(header, package, strict=True))
    assert by["n"] == "4"
    assert by["geometric mean"] == "141"
    assert (by["ratio to package"], by["worse"], by["misses"]) == ("1", "-", "-")
    assert (by["members"], by["distinct [least]"]) == ("-", "15 [8]")
    assert (by["s, median"], by["s, mean"]) == ("3", "3")
    steps = tables["Ratios of PD by step, geometric means"]
    assert steps == [["step", "own", "package"], ["4", "0.447", "1"], ["5", "0.01", "1"]]
    assert tables["Ratios of PD by object, geometric means"][1] == ["can", "0.126", "1"]


def test_they_are_on_the_terminal_and_in_the_command_that_makes_them_again(folder: Path) -> None:
    done = run(report.main, str(folder), "baseline=package", columns=40)
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("own"))
    expected = "own 3 (1 left out) 20 [10, 210] 20 0.126 33.3 % 60.0 % 30 [30] 33.3 % 0.1 0.1"
    assert line.split() == expected.split()
    assert "PD in mm², median [quartiles]" in done.stdout
    text = (folder / "report" / "report.md").read_text()
    assert f"runners.report {folder} baseline=package" in text
    assert SUMMARY in text
    run(report.main, str(folder))
    assert SUMMARY not in (folder / "report" / "report.md").read_text()


def test_draws_are_told_apart_by_their_column_alone(folder: Path) -> None:
    evaluation = open_evaluation(folder)
    assert evaluation.methods == ["own", "package"]
    places = evaluation.rows[["method", "step", "draw"]].to_numpy().tolist()
    assert places == [[m, s, d] for m in ("own", "package") for s in (4, 5) for d in (0, 1)]
    alone = write_evaluation(folder / "other", [row("can", 0, "own+1", 4, diversity=1.0)])
    assert open_evaluation(alone).methods == ["own+1"]  # a label of its own


def test_a_baseline_without_pd_is_told(folder: Path) -> None:
    done = run(report.main, str(folder), "baseline=icp")
    assert done.returncode == 2
    assert done.stderr == "error: baseline icp has no PD; accepted: own, package\n"
