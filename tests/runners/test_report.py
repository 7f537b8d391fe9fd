"""The report on methods: tables computed by hand, what the figures draw, and the files."""

import json
from typing import Any

import pandas as pd
import pytest

from runners import report
from runners.reporting.evaluation_folder import last_half, open_evaluation
from runners.reporting.figures import styles_of
from runners.reporting.sections import _TEXTS, pd_over_probes, sections_of
from runners.reporting.statistics import spreads
from runners.reporting.tables import median_cells
from tests.runners.in_process import run
from tests.runners.made_up_evaluations import row, tables_of, write_evaluation

SUMMARY = "PD and its ratios over all registrations"


def test_the_last_half_is_that_of_all_methods_of_a_trial():
    rows = [row("can", 0, method="chsel", step=step) for step in (3, 4, 5, 6)]
    rows += [row("can", 0, method="icp", step=step) for step in (7, 8)] + [
        row("can", 1, method="icp", step=3)
    ]
    kept = last_half(pd.DataFrame(rows))[["seed", "method", "step"]]
    assert list(kept.itertuples(index=False, name=None)) == [
        (0, "chsel", 6),
        (0, "icp", 7),
        (0, "icp", 8),
        (1, "icp", 3),
    ]


def test_quartiles_are_of_the_numbers_that_there_are():
    numbers = {"a": [4.0, None, 1.0, None, 3.0, 2.0], "b": [2.5, 2.5], "c": [None, None, None]}
    rows = [{"of": of, "number": value} for of, values in numbers.items() for value in values]
    found = spreads(pd.DataFrame(rows), "of", column="number")
    by_hand = {"count": 4, "left_out": 2, "lower": 1.75, "median": 2.5, "upper": 3.25}
    by_hand |= {"mean": 2.5, "deviation": 1.25**0.5}
    assert found.loc["a"].to_dict() == pytest.approx(by_hand)
    assert median_cells(found, "min") == [
        "**2.5 [1.75, 3.25] (2 left out)**",
        "**2.5 [2.5, 2.5] (n 2)**",
        "- (3 left out)",
    ]


def test_without_faults_nothing_is_said_about_them(tmp_path):
    rows = [row("can", 0, method="icp", step=4, diversity=8.0, truth_held=True, faults="clean")]
    sections = sections_of(open_evaluation(write_evaluation(tmp_path, rows, methods={"icp": {}})))
    assert not [section.title for section in sections if "aults" in section.title]
    (held,) = [section for section in sections if section.title == "Whether sets hold the truth"]
    (table,) = held.tables
    assert table.rows == (("clean", "100 % [21, 100] (n 1)"),)


@pytest.mark.parametrize("title", ["Time per registration", "Calibration and membership"])
def test_a_section_without_its_text_is_an_error(tmp_path, monkeypatch, title):
    folder = write_evaluation(tmp_path, [row("can", 0, method="icp", step=4, diversity=8.0)])
    monkeypatch.delitem(_TEXTS, title)
    with pytest.raises(KeyError, match=title):
        sections_of(open_evaluation(folder))


def test_tables_hold_medians_over_trials_and_the_last_half_of_their_steps(tmp_path):
    values = {0: (1000.0, 10.0, 20.0), 1: (1000.0, 30.0, 60.0)}  # PD of seeds at steps 4, 5, 6
    rows = [
        row("can", seed, method=method, step=step, diversity=factor * value, seconds=0.01 * factor)
        for seed, found in values.items()
        for method, factor in (("chsel", 1.0), ("icp", 2.0))
        for step, value in zip((4, 5, 6), found, strict=True)
    ]
    rows[0]["seconds"] = 0.07
    tables = tables_of(write_evaluation(tmp_path, rows))
    # 10, 20, 30, 60: the middle step of three is of the last half
    expected = ["can", "4", "25 [17.5, 37.5]", "50 [35, 75]"]
    assert tables["PD in mm² by object"] == [["object", "n", "CHSEL", "ICP"], expected]
    assert tables["PD in mm² by configuration"][1] == expected
    assert tables["PD in mm² of can by step"][2] == ["5", "2", "20 [15, 25]", "40 [30, 50]"]
    assert tables["Time per registration in ms"][1:] == [
        ["CHSEL", "20", "22.4", "10 [10, 10]", "6"],  # of 70 and five times 10
        ["ICP", "20", "0", "20 [20, 20]", "6"],
    ]


def test_what_has_no_number_is_left_out_and_counted(tmp_path):
    rows = [
        row("can", 0, method="chsel", step=4, diversity=8.0, seconds=0.1),
        row("can", 1, method="chsel", step=4, seconds=0.3)
        | {"status": "no plausible set: too few points"},
        row("can", 0, method="icp", step=4, diversity=float("nan"), seconds=None),
        row("can", 1, method="icp", step=None) | {"status": "failed: the worker was killed"},
    ]
    methods = {"chsel": {}, "icp": {}, "svgd": {}}
    write_evaluation(tmp_path, rows, configurations=["can"], seeds=[0, 1, 2], methods=methods)
    tables = tables_of(tmp_path)
    left_out = ["can", "1", "8 (1 left out)", "-", "- (1 left out)"]
    assert tables["PD in mm² by object"][1] == left_out
    assert tables["Time per registration in ms"][1:] == [
        ["CHSEL", "200", "100", "200 [150, 250]", "2"]
    ]
    assert tables["What is there"][0][4:] == ["failed", "no plausible set", "ok"]
    assert tables["What is there"][1:] == [
        ["CHSEL", "2 of 3", "0", "1", "0", "1", "1"],
        ["SVGD", "0 of 3", "0", "3", "0", "0", "0"],
        ["ICP", "1 of 3", "1", "1", "1", "0", "1"],
    ]
    assert tables["What failed"][1:] == [
        ["can", "chsel", "no plausible set: too few points", "1"],
        ["can", "icp", "failed: the worker was killed", "1"],
    ]


def test_true_poses_that_were_sought_have_a_table_of_their_own(tmp_path):
    names = ["cabinet_drill", "cabinet_mustard"]
    write_evaluation(tmp_path, [], configurations=names, seeds=[0, 1, 2])
    for index, (name, seed) in enumerate([(names[0], 0), (names[0], 1), (names[1], 0)]):
        truth: dict[str, Any] = {"cost": 0.001, "guess_cost": 0.1, "mean_distance": 0.001}
        truth["violations"] = index
        truth["from_guess"] = {"position": 0.002 * index, "rotation": 0.034906585 * index}
        if name == names[0]:
            truth["from_known"] = {"position": 0.003 + 0.002 * index, "rotation": 0.01745329}
        folder = tmp_path / "trials" / name / f"seed_{seed}"
        folder.mkdir(parents=True)
        (folder / "session.json").write_text(json.dumps({"truth": truth}))
    table = tables_of(tmp_path)["True poses found"]
    assert table[1] == [names[0], "2", "1 [1]", "0.5 [1]", "1 [2]", "1 [2]", "4 [5]", "1 [1]"]
    assert table[2][3:] == ["2 [2]", "4 [4]", "4 [4]", "- [-]", "- [-]"]
    assert table[3][:2] == ["all", "3"]


@pytest.fixture
def compared(tmp_path):
    """Two draws of the package and of an anchored method, at two steps of a trial."""
    numbers = {"exact_members": 0.5, "precision": 0.9, "recall": 0.25}
    numbers |= {"distinct": 30, "seconds": 0.1}
    found = [
        ("package", 4, {"diversity": 100.0, "distinct": 12, "seconds": 2.0}),
        ("package+1", 4, {"diversity": 400.0, "distinct": 10, "seconds": 4.0}),
        ("package", 5, {"diversity": 100.0, "distinct": 8, "seconds": 3.0}),
        ("package+1", 5, {"diversity": 100.0, "distinct": 30, "seconds": 3.0}),
        ("own", 4, {"diversity": 20.0, **numbers}),
        ("own+1", 4, {"diversity": 400.0, **numbers, "exact_members": 0.8, "recall": 0.55}),
        ("own", 5, {"diversity": 0.0, **numbers}),
    ]
    rows = [row("can", 0, method=method, step=step, **values) for method, step, values in found]
    rows.append(row("can", 0, method="own+1", step=5) | {"status": "failed: of a lack of memory"})
    planned = {"configurations": ["can"], "seeds": [0], "methods": {"own": {}, "own+1": {}}}
    planned["outside"] = {"package": "sets", "package+1": "sets/draw_1"}
    return write_evaluation(tmp_path / "evaluation", rows, **planned)


def test_ratios_are_of_the_same_trial_and_step_by_the_mean_of_the_baselines_draws(compared):
    tables = tables_of(compared, "package")
    header, own, package = tables[SUMMARY]
    assert dict(zip(header, own, strict=True)) == {
        "method": "own",
        "n": "3 (1 left out)",
        "PD in mm², median [quartiles]": "20 [10, 210]",
        "geometric mean": "20",  # of 20, 400 and 1, as which 0 counts
        "ratio to package [95 %]": "0.126",  # of 20 / 200, 400 / 200 and 1 / 100
        "worse": "33.3 %",
        "members": "60.0 %",
        "precision": "90.0 %",
        "recall": "35.0 %",
        "distinct [least]": "30 [30]",
        "s, median": "0.1",
        "s, mean": "0.1",
    }
    by_hand = ["package", "4", "100 [100, 175]", "141", "1", "-", "-", "-", "-", "15 [8]"]
    by_hand += ["3", "3"]
    assert package == by_hand
    steps = tables["Ratios of PD by step, geometric means"]
    assert steps == [["step", "own", "package"], ["4", "0.447", "1"], ["5", "0.01", "1"]]
    assert tables["Ratios of PD by object, geometric means"][1] == ["can", "0.126", "1"]


def test_a_pd_equal_to_the_baselines_is_not_worse(tmp_path):
    values = {"package": 8.0, "icp": 8.0, "svgd": 8.1, "cvo": 7.9}
    rows = [
        row("can", 0, method=method, step=4, diversity=value) for method, value in values.items()
    ]
    header, *lines = tables_of(write_evaluation(tmp_path, rows), "package")[SUMMARY]
    shares = {line[0]: line[header.index("worse")] for line in lines}
    assert shares == {"SVGD": "100.0 %", "ICP": "0.0 %", "CVO": "0.0 %", "package": "-"}


def test_pd_over_probes_is_the_median_and_quartiles_of_each_object_and_step(tmp_path):
    numbers = {"can": {4: (16.0, 1.0, 4.0), 5: (25.0, 9.0)}, "box": {5: (100.0, 400.0)}}
    rows = [
        row(name, seed, method=method, step=step, diversity=factor * value)
        for name, steps in numbers.items()
        for step, values in steps.items()
        for seed, value in enumerate(values)
        for method, factor in (("chsel", 1.0), ("icp", 3.0))
        if (method, step) != ("icp", 4)  # a gap
    ]
    styles = styles_of(["chsel", "icp"])
    evaluation = open_evaluation(write_evaluation(tmp_path, rows))
    picture = pd_over_probes("pd", evaluation.rows, styles=styles)
    assert [axes.get_title() for axes in picture.figure.axes] == ["box", "can"]
    drawn = picture.data[picture.data["object"] == "can"].drop(columns="object")
    assert drawn.to_numpy().tolist() == [
        ["chsel", 4, 3, 2.5, 4.0, 10.0],
        ["chsel", 5, 2, 13.0, 17.0, 21.0],
        ["icp", 5, 2, 39.0, 51.0, 63.0],
    ]


def test_each_panel_over_iterations_draws_its_own_number_and_costs_of_one_kind(tmp_path):
    methods = {"chsel": 1.0, "chsel_cma_me": 2.0, "medial_constraint_cma_me": 1000.0}
    about = {"configuration": "drill", "step": 4}
    moments = [
        {**about, "seed": seed, "method": method, "iteration": iteration}
        | {"diversity": 10.0 * value, "mean_cost": cost * value}
        for method, cost in methods.items()
        for seed, start in enumerate((1.0, 3.0, 8.0))
        for iteration, value in ((0, 2.0 * start), (25, start))
    ]
    folder = write_evaluation(tmp_path, [], iterations=moments, methods=methods)
    section = sections_of(open_evaluation(folder))[1]
    data = section.picture.data.set_index(["number", "method", "iteration"]).sort_index()
    values = ["lower", "median", "upper"]
    for method in methods:
        assert data.loc[("diversity", method, 0), values].tolist() == [40.0, 60.0, 110.0]
        assert data.loc[("diversity", method, 25), values].tolist() == [20.0, 30.0, 55.0]
    assert data.loc[("mean_cost", "chsel_cma_me", 0), values].tolist() == [8.0, 12.0, 22.0]
    # Costs of the Medial Constraint are in m², those of the others are relaxed costs.
    assert set(data.loc["mean_cost"].index.unique("method")) == {"chsel", "chsel_cma_me"}
    assert section.tables[1].header == ("iteration", "n", "CHSEL", "CHSEL (CMA-ME)")


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_a_report_has_its_pictures_its_data_and_the_same_bytes_each_time(compared, kind):
    contents = []
    for out in ("first", "again"):
        arguments = (f"out={compared / out}", f"format={kind}", "baseline=package")
        done = run(report.main, str(compared), *arguments)
        assert (done.returncode, done.stderr) == (0, "")
        contents.append({path.name: path.read_bytes() for path in (compared / out).iterdir()})
    assert contents[0] == contents[1]
    names = {f"{name}.{end}" for name in ("pd_over_probes", "pd_boxes") for end in (kind, "csv")}
    assert contents[0].keys() == names | {"report.md", "report.html"}
    page = contents[0]["report.html"].decode()
    assert page.count('<img src="data:image/') == (0 if kind == "pdf" else 2)
    text = contents[0]["report.md"].decode()
    assert f"](pd_boxes.{kind})" in text
    assert f"runners.report {compared} baseline=package" in text
    assert SUMMARY in text
    assert SUMMARY in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "dir is missing"),
        (["{}/nowhere"], "accepted: a folder that runners.evaluate has written"),
        (["{}", "baseline=icp"], "baseline icp has no PD; accepted: chsel"),
        (["{}", "format=gif"], "format is 'gif'; accepted: png, svg, pdf"),
        (["{}", "out={}/experiment.json/x"], "accepted: an out=DIR that can be written"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, arguments, message):
    write_evaluation(tmp_path, [row("can", 0, method="chsel", step=4, diversity=1.0)])
    done = run(report.main, *(argument.format(tmp_path) for argument in arguments))
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert message in done.stderr
