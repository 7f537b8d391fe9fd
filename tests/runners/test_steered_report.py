"""Reports on policies: statistics of sessions with known answers, and the page."""

import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest

from runners import report
from runners.reporting.evaluation_folder import open_evaluation
from runners.reporting.statistics import (
    LEAST_ERROR,
    bootstrap_interval,
    geometric_means,
    paired,
    ratios_to_best,
    steered_sessions,
)
from runners.reporting.tables import with_range
from tests.runners.in_process import run
from tests.runners.made_up_evaluations import session, tables_of, write_sessions

BUDGETS = {"information": 4, "grid": 4}


def sessions_of(folder, rows, *, reference=None):
    return steered_sessions(
        open_evaluation(write_sessions(folder, rows, budgets=BUDGETS)), reference
    )


@pytest.fixture
def rows():
    """Three trials of two policies."""
    forecasts = {"hit_forecast": [1.0, 0.85, 0.15, 0.85], "hit": [True, True, False, False]}
    forecasts |= {"grasp_chance": [None, 0.75, 0.72, 1.0], "grasp_works": [None, False, True, True]}
    forecasts |= {"middle_50": [None, 1 / 3, 1.0, 0.0], "middle_90": [None, 2 / 3, 1.0, 1.0]}
    forecasts |= {"modes_90": [None, None, False, True]}
    return [
        *session("can", 20, policy="information", errors=[80.0, 8.0, 4.0, 2.0], **forecasts),
        *session("can", 20, policy="grid", errors=[80.0, 40.0, 20.0, 10.0]),
        *session(
            "can", 21, policy="information", errors=[50.0, 25.0, 9.0]
        ),  # then no action is left
        *session("can", 21, policy="grid", errors=[50.0, 60.0, 30.0, 3.0]),
        *session("drill", 20, policy="information", errors=[60.0, 60.0, 60.0, 60.0]),
        *session("drill", 20, policy="grid", errors=[60.0, 70.0, 65.0, 30.0]),
    ]


def test_a_session_that_ends_early_keeps_its_error(tmp_path, rows):
    found = sessions_of(tmp_path, rows)
    assert found.errors.loc[("information", "can", 21)].tolist() == pytest.approx(
        [0.05, 0.025, 0.009, 0.009]
    )
    assert set(found.solvable) == {("can", 20), ("can", 21)}
    means = geometric_means(found.errors)
    assert means.loc["information", 4] == pytest.approx((2.0 * 9.0 * 60.0) ** (1 / 3) / 1000.0)
    ratios = ratios_to_best(found)
    assert ratios[1] == pytest.approx(1.0)
    assert ratios[3] == pytest.approx((4.0 * 9.0 * 60.0 / (20.0 * 30.0 * 65.0)) ** (1 / 3))


def test_sessions_are_compared_up_to_the_smallest_budget(tmp_path, rows, monkeypatch):
    monkeypatch.setitem(BUDGETS, "grid", 3)
    found = sessions_of(tmp_path, rows)
    assert (found.budget, list(found.errors.columns)) == (3, [1, 2, 3])


def test_errors_below_a_tenth_of_a_millimetre_count_as_that(tmp_path):
    found = sessions_of(
        tmp_path, session("can", 20, policy="information", errors=[80.0, 8.0, 4.0, 0.0])
    )
    assert geometric_means(found.errors).loc["information", 4] == pytest.approx(LEAST_ERROR)


def test_policies_are_compared_in_the_trials_that_all_have_finished(tmp_path, rows):
    more = session("drill", 21, policy="grid", errors=[1.0, 1.0, 1.0, 1.0])
    failed = {**more[0], "policy": "information", "probes": None, "step": None, "error": None}
    failed |= {"status": "failed: out of memory"}
    found = sessions_of(tmp_path, [*rows, *more, failed])
    assert (found.count, found.left_out, found.budget) == (3, 1, 4)
    assert ("drill", 21) not in found.solvable


def test_ratios_are_by_session_with_wins_and_an_interval(tmp_path, rows):
    of = paired(sessions_of(tmp_path, rows), "grid")
    # Of 10 by 2 mm, 3 by 9 mm and 30 by 60 mm.
    assert [of[name] for name in ("sessions", "wins", "losses", "sign_test")] == [3, 1, 2, 1.0]
    assert of["median"] == pytest.approx(0.5)
    assert of["mean"] == pytest.approx((5.0 / 3.0 / 2.0) ** (1 / 3))
    # Of so few configurations the three sessions are drawn: one of them alone in 1 of 27 samples.
    assert (of["lower"], of["upper"]) == pytest.approx((1.0 / 3.0, 5.0))
    back = paired(sessions_of(tmp_path / "back", rows, reference="grid"), "information")
    assert back["mean"] == pytest.approx(1.0 / of["mean"])
    assert (back["wins"], back["losses"]) == (of["losses"], of["wins"])


def test_equal_errors_are_neither_wins_nor_losses(tmp_path):
    rows = [
        row
        for name in BUDGETS
        for row in session("can", 20, policy=name, errors=[80.0, 8.0, 4.0, 2.0])
    ]
    of = paired(sessions_of(tmp_path, rows), "grid")
    assert [of[name] for name in ("wins", "losses", "sign_test")] == [0, 0, 1.0]


def test_the_interval_of_a_mean_is_that_of_independent_configurations():
    values = np.random.default_rng(0).normal(2.0, 1.0, 200)
    index = pd.MultiIndex.from_product([range(200), [0, 1, 2]], names=["configuration", "seed"])
    lower, upper = bootstrap_interval(pd.Series(np.repeat(values, 3), index))
    half = 1.96 * values.std() / 200**0.5  # three alike seeds are no more than one
    assert lower == pytest.approx(values.mean() - half, abs=0.02)
    assert upper == pytest.approx(values.mean() + half, abs=0.02)


def test_a_single_session_has_no_interval_but_its_number():
    index = pd.MultiIndex.from_tuples([("can", 20)], names=["configuration", "seed"])
    interval = bootstrap_interval(pd.Series([0.5], index))
    assert np.isnan(interval).all()
    assert with_range(0.5, interval[0], upper=interval[1]) == "0.5"


def test_tables_have_the_numbers_of_the_sessions(tmp_path, rows):
    for row in rows:
        row |= {"seconds": 0.05, "decision_seconds": None if row["policy"] == "grid" else 0.02}
    tables = tables_of(write_sessions(tmp_path, rows, budgets=BUDGETS))
    needed = tables["Probes until the error of the set is below a limit"]
    assert [line[:4] for line in needed[1:]] == [
        ["information", "3 [2, >4]", "3 [2, >4]", ">4 [3, >4]"],
        ["grid", "4 [4, >4]", ">4 [4, >4]", ">4 [4, >4]"],
    ]
    assert [line[4:] for line in needed[1:]] == [
        ["67 % [21, 94]", "100 % [34, 100]", "2 [2, 3]"],
        ["33 % [6, 79]", "50 % [9, 91]", "4 [4, >4]"],
    ]
    errors = tables["Error of the set after so many probes, mm"]
    assert errors[1:] == [
        ["information", "62.1", "22.9", "10.3"],  # cube roots of 80 50 60, 8 25 60 and 2 9 60
        ["grid", "62.1", "55.2", "9.65"],  # the same of 40 60 70 and 10 3 30
    ]
    hits = tables["Chance of a hit, forecast and happened, %"]
    assert hits[1:] == [
        ["information", "4", "71.2", "50.0", "+21.2"],
        ["all, before the first contact", "2", "92.5", "100.0", "-7.5"],
        ["all, after it", "2", "50.0", "0.0", "+50.0"],
        ["all", "4", "71.2", "50.0", "+21.2"],
    ]
    bins = tables["Hits by their forecast, all policies"]
    assert bins[1:] == [
        ["10 to 20 %", "1", "15 %", "0 % [0, 79]"],
        ["80 to 90 %", "2", "85 %", "50 % [9, 91]"],
        ["90 to 100 %", "1", "100 %", "100 % [21, 100]"],
    ]
    beliefs = tables["Beliefs by the number of contacts"]
    held = ["44.4 %", "88.9 %", "2", "50 % [9, 91]", "82.3 %", "67 % [21, 94]"]
    assert beliefs[1:] == [["1 to 4", "3", *held]]
    spreads = tables["Beliefs by quarter of their spread"]
    quarters = [line[:2] for line in spreads[1:]]  # of 2, 4 and 8 mm
    assert quarters == [["2.0 to 3.0", "1"], ["3.0 to 4.0", "1"], ["6.0 to 8.0", "1"]]
    assert tables["Grasps by the chance that they work"][1:] == [
        ["70 to 80 %", "2", "74 %", "50 % [9, 91]"],
        ["90 to 100 %", "1", "100 %", "100 % [21, 100]"],
    ]
    stops = tables["Stopping by the spread of the belief"]
    assert stops[4] == [
        *("information", "10 mm", "3", "2", "2.5", "15 mm", "100 % [34, 100]", "9.0 mm")
    ]
    times = tables["Milliseconds a probe, medians and 95th percentiles"]
    assert times[1:] == [
        ["information", "20", "20", "50", "50", "70", "70"],
        ["grid", "-", "-", "50", "50", "50", "50"],
    ]


def test_a_table_of_before_beliefs_were_measured_is_read(tmp_path, rows):
    folder = write_sessions(tmp_path, rows, budgets=BUDGETS)
    columns = ["middle_50", "middle_90", "modes_90", "grasp_chance", "grasp_works"]
    table = pyarrow.parquet.read_table(folder / "probes.parquet").drop_columns(columns)
    pyarrow.parquet.write_table(table, folder / "probes.parquet")
    tables = tables_of(folder)
    assert tables["Error of the set after so many probes, mm"][1][0] == "information"
    assert "Beliefs by the number of contacts" not in tables


def test_a_report_is_written_and_a_baseline_without_sessions_is_an_error(tmp_path, rows):
    write_sessions(tmp_path, rows, budgets=BUDGETS)
    done = run(report.main, str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")
    assert "Error beside information after 4 probes" in done.stdout
    names = {path.name for path in (tmp_path / "report").iterdir()}
    assert {"error_over_probes.csv", "error_over_probes.png", "report.html"} <= names
    done = run(report.main, str(tmp_path), "baseline=icp")
    assert (done.returncode, done.stderr.strip()) == (
        2,
        "error: baseline icp has no session; accepted: information, grid",
    )
