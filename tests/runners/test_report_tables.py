"""The tables of a report: what is in their cells."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from runners import report
from runners.reporting.against_baseline import against_baseline
from runners.reporting.evaluation_folder import last_half, open_evaluation
from runners.reporting.section import Subject
from runners.reporting.statistics import spreads
from runners.reporting.tables import median_cells, number
from tests.runners.in_process import run
from tests.runners.made_up_evaluations import made_up_rows, row, write_evaluation
from tests.runners.test_report import Page, page_of

SUMMARY = "PD and its ratios over all registrations, by default"


def test_the_last_half_is_that_of_all_methods_of_a_trial() -> None:
    rows = [row("can", 0, "chsel", step) for step in (3, 4, 5, 6)]
    rows += [row("can", 0, "icp", step) for step in (7, 8)] + [row("can", 1, "icp", 3)]
    kept = last_half(pd.DataFrame(rows))[["seed", "method", "step"]]
    assert list(kept.itertuples(index=False, name=None)) == [
        (0, "chsel", 6),
        (0, "icp", 7),
        (0, "icp", 8),
        (1, "icp", 3),
    ]


def test_quartiles_are_of_the_numbers_that_there_are() -> None:
    numbers = {"a": [4.0, None, 1.0, None, 3.0, 2.0], "b": [2.5, 2.5], "c": [None, None, None]}
    rows = [{"of": of, "number": value} for of, values in numbers.items() for value in values]
    found = spreads(pd.DataFrame(rows), "of", "number")
    assert found.loc["a"].to_dict() == pytest.approx(
        {
            "count": 4,
            "left_out": 2,
            "lower": 1.75,
            "median": 2.5,
            "upper": 3.25,
            "mean": 2.5,
            "deviation": 1.25**0.5,
        }
    )
    cells = median_cells(found, "min")
    assert [cell.text for cell in cells] == ["2.5", "2.5", "-"]
    assert [cell.best for cell in cells] == [True, True, False]
    assert [cell.note for cell in cells] == ["2 left out", "n 2", "3 left out"]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (12.345, "12.3"), (999.7, "1000"), (12345.6, "12346"), (0.000123, "1.23e-04")],
)
def test_numbers_have_three_digits_that_count(value: float, text: str) -> None:
    assert number(value) == text


def test_tables_hold_medians_over_trials_and_the_last_half_of_their_steps(tmp_path: Path) -> None:
    values = {0: (1000.0, 10.0, 20.0), 1: (1000.0, 30.0, 60.0)}  # PD of seeds at steps 4, 5, 6
    rows = [
        row("can", seed, method, step, diversity=factor * value, seconds=0.01 * factor)
        for seed, found in values.items()
        for method, factor in (("chsel", 1.0), ("icp", 2.0))
        for step, value in zip((4, 5, 6), found, strict=True)
    ]
    write_evaluation(tmp_path, rows)
    assert run(report.main, str(tmp_path)).returncode == 0
    tables = page_of(tmp_path / "report").tables
    # 10, 20, 30, 60: the middle step of three is of the last half
    expected = ["can", "4", "25 [17.5, 37.5]", "50 [35, 75]"]
    assert tables["PD in mm² by object"] == [["object", "n", "CHSEL", "ICP"], expected]
    assert tables["PD in mm² by configuration"][1] == expected
    assert tables["PD in mm² of can by step"][2] == ["5", "2", "20 [15, 25]", "40 [30, 50]"]
    assert tables["Time per registration in ms"][1:] == [
        ["CHSEL", "10", "0", "10 [10, 10]", "6", "0"],
        ["ICP", "20", "0", "20 [20, 20]", "6", "0"],
    ]
    html = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert '<td class="best">25<small>' in html
    assert '<td class="best">50<small>' not in html


def test_what_has_no_number_is_left_out_and_said(tmp_path: Path) -> None:
    rows = [
        row("can", 0, "chsel", 4, diversity=8.0, seconds=0.1),
        row("can", 1, "chsel", 4, seconds=0.3) | {"status": "no plausible set: too few points"},
        row("can", 0, "icp", 4, diversity=float("nan"), seconds=None),
        row("can", 1, "icp", None) | {"status": "failed: the worker was killed"},
    ]
    methods = {"chsel": {}, "icp": {}, "svgd": {}}
    write_evaluation(tmp_path, rows, configurations=["can"], seeds=[0, 1, 2], methods=methods)
    assert run(report.main, str(tmp_path)).returncode == 0
    tables = page_of(tmp_path / "report").tables
    assert tables["PD in mm² by object"][1] == [
        "can",
        "1",
        "8 [8, 8] 1 left out",
        "-",
        "- 1 left out",
    ]
    assert tables["Time per registration in ms"][1:] == [
        ["CHSEL", "200", "100", "200 [150, 250]", "2", "0"]
    ]
    assert [line[:7] for line in tables["What is there"][1:]] == [
        ["CHSEL", "2 of 3", "0", "1", "2", "0", "1"],
        ["SVGD", "0 of 3", "0", "3", "0", "0", "0"],
        ["ICP", "1 of 3", "1", "1", "1", "1", "1"],
    ]
    assert tables["What is missing"][1:] == [
        ["can", "1", "chsel", "4", "no plausible set: too few points"],
        ["can", "1", "icp", "all", "failed: the worker was killed"],
        ["can", "0..2", "svgd", "all", "not there"],
        ["can", "2", "chsel, icp", "all", "not there"],
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two trials of a can and two of a box; the last half of each is its step 5 alone."""
    folder = tmp_path_factory.mktemp("evaluation")
    places = [("can", 0), ("can_fallen", 0), ("box", 3), ("box", 4)]
    numbers = {  # diversity, rank, share of members at step 5
        "chsel": (90.0, 0.2, 0.75),
        "icp": (50.0, 0.6, 0.25),
    }
    rows = [
        row(name, seed, method, step, diversity=pd, rank=rank, exact_members=exact, members=members)
        for name, seed in places
        for method, (pd, rank, exact) in numbers.items()
        for step, members in ((4, None), (5, 40))
    ]
    for entry in rows:
        if entry["step"] == 4:
            entry |= {"rank": 1.0, "exact_members": 0.0}
    write_evaluation(folder, rows)
    assert run(report.main, str(folder)).returncode == 0
    return folder


@pytest.fixture(scope="module")
def page(folder: Path) -> Page:
    return page_of(folder / "report")


def test_trials_objects_registrations_and_plausible_sets_are_counted(
    folder: Path, page: Page
) -> None:
    text = (folder / "report" / "report.md").read_text(encoding="utf-8")
    assert "2 methods on 4 trials of 2 objects: 16 registrations." in text
    assert page.tables["Objects"] == [
        ["object", "configurations", "trials", "steps", "steps with a plausible set"],
        ["box", "box", "2", "4", "2"],
        ["can", "can, can_fallen", "2", "4", "2"],
    ]


def test_ranks_and_shares_of_members_are_those_of_the_last_half(folder: Path, page: Page) -> None:
    assert page.tables["Rank of the true pose among the hypotheses"][1:] == [
        ["box", "2", "0.2 [0.2, 0.2]", "0.6 [0.6, 0.6]"],
        ["can", "2", "0.2 [0.2, 0.2]", "0.6 [0.6, 0.6]"],
    ]
    assert page.tables["Share of hypotheses in the plausible set"][1:] == [
        ["box", "2", "0.75 [0.75, 0.75]", "0.25 [0.25, 0.25]"],
        ["can", "2", "0.75 [0.75, 0.75]", "0.25 [0.25, 0.25]"],
    ]
    text = (folder / "report" / "report.md").read_text(encoding="utf-8")
    ranks = text.split("Rank of the true pose")[1].split("Share of hypotheses")[0]
    shares = text.split("Share of hypotheses")[1]
    assert "**0." not in ranks  # no rank is better than another
    assert "| box | 2 | **0.75** [0.75, 0.75] | 0.25 [0.25, 0.25] |" in shares  # most is best


def test_a_pd_equal_to_the_baselines_is_not_worse(tmp_path: Path) -> None:
    values = {"package": 8.0, "icp": 8.0, "svgd": 8.1, "cvo": 7.9}
    rows = [row("can", 0, method, 4, diversity=value) for method, value in values.items()]
    evaluation = open_evaluation(write_evaluation(tmp_path, rows))
    section = against_baseline(Subject(evaluation, baseline="package"))
    assert section is not None
    summary = section.tables[0]
    worse = summary.header.index("worse")
    shares = {line[0].text: line[worse].text for line in summary.rows}
    assert shares == {"SVGD": "100.0 %", "ICP": "0.0 %", "CVO": "0.0 %", "package": "-"}


def test_true_poses_that_were_sought_have_a_table_of_their_own(tmp_path: Path) -> None:
    names = ["cabinet_drill", "cabinet_mustard"]
    rows = made_up_rows(names, [0, 1], 2, ["chsel"])
    write_evaluation(tmp_path, rows, configurations=names, seeds=[0, 1, 2])
    for index, (name, seed) in enumerate([(names[0], 0), (names[0], 1), (names[1], 0)]):
        truth: dict[str, Any] = {"cost": 0.001, "guess_cost": 0.1, "mean_distance": 0.001}
        truth["violations"] = index
        truth["from_guess"] = {"position": 0.002 * index, "rotation": 0.034906585 * index}
        if name == names[0]:
            truth["from_simulated"] = {"position": 0.003 + 0.002 * index, "rotation": 0.01745329}
        folder = tmp_path / "trials" / name / f"seed_{seed}"
        folder.mkdir(parents=True)
        (folder / "session.json").write_text(json.dumps({"truth": truth}))
    done = run(report.main, str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")
    table = page_of(tmp_path / "report").tables["True poses found"]
    assert [line[:2] for line in table[1:]] == [[names[0], "2"], [names[1], "1"], ["all", "3"]]
    assert table[1][2:] == ["1 [1]", "0.5 [1]", "1 [2]", "1 [2]", "4 [5]", "1 [1]"]
    assert table[2][3:] == ["2 [2]", "4 [4]", "4 [4]", "-", "-"]
    assert "True poses found" in (tmp_path / "report" / "report.md").read_text()


@pytest.fixture
def compared(tmp_path: Path) -> Path:
    """Two draws of the package and of an anchored method, at two steps of a trial."""
    numbers = {"exact_members": 0.5, "distinct": 30, "seconds": 0.1}
    found = [
        ("package", 4, {"diversity": 100.0, "distinct": 12, "seconds": 2.0}),
        ("package+1", 4, {"diversity": 400.0, "distinct": 10, "seconds": 4.0}),
        ("package", 5, {"diversity": 100.0, "distinct": 8, "seconds": 3.0}),
        ("package+1", 5, {"diversity": 100.0, "distinct": 30, "seconds": 3.0}),
        ("own", 4, {"diversity": 20.0, **numbers}),
        ("own+1", 4, {"diversity": 400.0, **numbers, "exact_members": 0.8}),
        ("own", 5, {"diversity": 0.0, **numbers}),
    ]
    rows = [row("can", 0, method, step, **values) for method, step, values in found]
    rows.append(row("can", 0, "own+1", 5) | {"status": "failed: of a lack of memory"})
    about = {"name": "anchored", "preset": "default", "settings": {}}
    methods = {"own": about, "own+1": {**about, "draw": 1}}
    outside = {"package": "sets", "package+1": "sets/draw_1"}
    planned = {"configurations": ["can"], "seeds": [0], "methods": methods, "outside": outside}
    return write_evaluation(tmp_path / "evaluation", rows, **planned)


def test_ratios_are_of_the_same_trial_and_step_by_the_mean_of_the_baselines_draws(
    compared: Path,
) -> None:
    done = run(report.main, str(compared), "baseline=package")
    assert (done.returncode, done.stderr) == (0, "")
    tables = page_of(compared / "report").tables
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
    assert (by["s, median"], by["s, mean"]) == ("0.1", "0.1")
    by = dict(zip(header, package, strict=True))
    assert by["n"] == "4"
    assert by["geometric mean"] == "141"
    assert (by["ratio to package"], by["worse"]) == ("1", "-")
    assert (by["members"], by["distinct [least]"]) == ("-", "15 [8]")
    assert (by["s, median"], by["s, mean"]) == ("3", "3")
    steps = tables["Ratios of PD by step, geometric means"]
    assert steps == [["step", "own", "package"], ["4", "0.447", "1"], ["5", "0.01", "1"]]
    assert tables["Ratios of PD by object, geometric means"][1] == ["can", "0.126", "1"]


def test_they_are_on_the_terminal_and_in_the_command_that_makes_them_again(compared: Path) -> None:
    done = run(report.main, str(compared), "baseline=package", columns=40)
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("own"))
    expected = "own 3 (1 left out) 20 [10, 210] 20 0.126 33.3 % 60.0 % 30 [30] 0.1 0.1"
    assert line.split() == expected.split()
    assert "PD in mm², median [quartiles]" in done.stdout
    text = (compared / "report" / "report.md").read_text()
    assert f"runners.report {compared} baseline=package" in text
    assert SUMMARY in text
    run(report.main, str(compared))
    assert SUMMARY not in (compared / "report" / "report.md").read_text()


def test_draws_are_told_apart_by_their_column_alone(compared: Path) -> None:
    evaluation = open_evaluation(compared)
    assert evaluation.methods == ["own", "package"]
    places = evaluation.rows[["method", "step", "draw"]].to_numpy().tolist()
    assert places == [[m, s, d] for m in ("own", "package") for s in (4, 5) for d in (0, 1)]
    alone = write_evaluation(compared / "other", [row("can", 0, "own+1", 4, diversity=1.0)])
    assert open_evaluation(alone).methods == ["own+1"]  # a label of its own


def test_a_baseline_without_pd_is_told(compared: Path) -> None:
    done = run(report.main, str(compared), "baseline=icp")
    assert done.returncode == 2
    assert done.stderr == "error: baseline icp has no PD; accepted: own, package\n"
