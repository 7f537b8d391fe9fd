"""Evaluations of sessions with faults: their rows, tables and picture."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from chsel.errors import SettingError
from runners import evaluate
from runners.evaluation.experiment import collect, join_experiment
from runners.evaluation.plan import Task, Trial
from runners.evaluation.trial_configurations import (
    chosen_names,
    configurations_of,
    faulty_name,
)
from runners.evaluation.trial_session import make_session, open_recorded, problems
from runners.reporting.evaluation_folder import open_evaluation
from runners.reporting.figures import styles_of
from runners.reporting.sections import tables_by_faults
from runners.reporting.statistics import shares
from runners.sessions.faults import LEVELS, LEVELS_OF_POINTS, level_name
from tests.runners.in_process import do_task, run
from tests.runners.made_up_evaluations import row, tables_of, write_evaluation
from tests.runners.test_evaluation import TRIAL, plan_in

CONF = Path(evaluate.__file__).parents[1] / "conf"
OF_NORMALS = ("normal_noise", "normal_wrong", "normal_tilt")
FAULTY = Trial(0, "mustard+noise_3mm")
HELD = "Steps with the true pose in the set"


def test_configurations_and_levels_of_faults_have_names():
    found = configurations_of("kinematic")
    assert list(found)[:2] == ["drill", "drill+noise_1mm"]
    faulty = found["box_fallen+mixed"]
    assert (faulty.object, faulty.faults, faulty.clean_name) == (
        "cracker_box",
        "mixed",
        "box_fallen",
    )
    assert chosen_names("faults", ["noise_*", "clean"], existing=LEVELS)[:2] == (
        "clean",
        "noise_1mm",
    )


def test_all_levels_are_those_of_points_and_patterns_name_the_others():
    def chosen(value):
        return chosen_names("faults", value, existing=LEVELS, every=LEVELS_OF_POINTS)

    assert chosen("all") == LEVELS_OF_POINTS
    assert "normals_10deg" not in LEVELS_OF_POINTS
    assert chosen("normals_2*") == ("normals_20deg", "normals_20deg_as_5deg")
    assert chosen(["normals_10deg", "clean"]) == ("clean", "normals_10deg")


def test_the_experiment_of_normals_has_the_same_contacts_with_and_without_them(tmp_path):
    experiment = yaml.safe_load((CONF / "experiment" / "normals.yaml").read_text())
    levels = chosen_names("faults", experiment["faults"], existing=LEVELS)
    assert sorted(levels) == sorted(experiment["faults"])
    plan = plan_in(tmp_path, steps=experiment["steps"], plausible=False)
    plan = replace(plan, session={"kind": "kinematic", **experiment["session"]})
    stated = {}
    known = {}
    truths = set()
    for level in levels:
        trial = Trial(0, faulty_name("mustard", level))
        join_experiment(plan, "normals", configurations=[trial.configuration], seeds=[0])
        make_session(plan, trial)
        session = open_recorded(plan, trial)
        truths.add(session.world_from_object.tobytes())
        *_, last = problems(plan, trial, session=session)
        assert plan.faults(trial) == level
        stated[level] = sorted({round(math.degrees(x), 6) for x in last.points.normal_noise})
        known[level] = last.points.known
    assert len(truths) == 1
    assert stated == {
        level: [5.0] if level.endswith("as_5deg") else [10.0] if "normals" in level else [0.0]
        for level in levels
    }
    for level, contacts in known.items():  # those of the same points, to the bit
        faults = replace(LEVELS[level], normals=None, **dict.fromkeys(OF_NORMALS, 0.0))
        np.testing.assert_array_equal(contacts, known[level_name(faults)])


def test_without_plausible_sets_there_is_no_pd_but_the_distance_from_the_truth(tmp_path):
    plan = plan_in(tmp_path / "out", steps="5", plausible=False)
    join_experiment(plan, "test", configurations=[FAULTY.configuration], seeds=[0])
    for task in (Task(FAULTY), Task(FAULTY, "icp")):
        assert do_task(plan, task) == ""
    (found,) = collect(plan.folder).to_pylist()
    assert (found["status"], found["members"], found["diversity"]) == ("ok", None, None)
    assert found["nearest_hypothesis"] > 0.0
    assert found["truth_held"] is None  # ICP has no set
    assert not TRIAL.folder(plan).exists()
    with pytest.raises(SettingError, match="plausible is True, was False"):
        join_experiment(
            plan_in(tmp_path / "out", steps="5"), "test", configurations=["mustard"], seeds=[0]
        )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["session=kinematic", "faults=loud"], "faults names 'loud'; accepted: all, a pattern"),
        (["session=sensors", "session/rig=cabinet", "faults=mixed"], "faults names 'mixed'"),
        (["session=kinematic", "session.faults.contact_noise=0.001"], "accepted here: faults="),
    ],
)
def test_faults_that_cannot_be_evaluated_are_one_line(tmp_path, arguments, message):
    done = run(evaluate.main, f"out={tmp_path}", *arguments)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert message in done.stderr


def test_the_interval_of_a_share_is_wilsons():
    flags = {"most": [True] * 9 + [False, None], "none": [False] * 5, "all": [True] * 5}
    rows = [{"of": of, "held": held} for of, some in flags.items() for held in some]
    found = shares(pd.DataFrame(rows), "of", column="held")
    assert found.loc["most", ["lower", "upper"]].tolist() == pytest.approx(
        [0.5958, 0.9821], abs=1e-4
    )
    assert found.loc["most", ["count", "total", "share"]].tolist() == [9, 10, 0.9]
    assert found.loc["none", "lower"] == 0.0
    assert found.loc["all", "upper"] == 1.0


@pytest.fixture
def made_up(tmp_path):
    """Two levels; "own" tells whether it holds the truth, in all 4 steps and in 1 of 4."""
    rows = []
    for level, count in (("clean", 4), ("mixed", 1)):
        name = "can" if level == "clean" else "can+mixed"
        for step in range(4):
            numbers = {"diversity": 10.0 + step, "faults": level, "position_error": 0.002}
            own = {**numbers, "truth_held": step < count, "nearest_hypothesis": 0.001 * step}
            rows += [
                row(name, 0, method="own", step=step, **own),
                row(name, 0, method="icp", step=step, **numbers),
            ]
    return write_evaluation(tmp_path / "evaluation", rows)


def test_tables_have_a_line_a_level_and_one_of_all(made_up):
    tables = tables_of(made_up)
    assert tables[HELD] == [
        ["faults", "own"],
        ["clean", "100 % [51, 100] (n 4)"],
        ["mixed", "25 % [5, 70] (n 4)"],
        ["all levels", "62 % [31, 86] (n 8)"],
    ]
    nearest = tables["From the true pose to the nearest hypothesis, mm"]
    assert nearest[1][:2] == ["clean", "4"]
    assert nearest[1][2].startswith("-")
    assert nearest[1][3] == "1.5 [0.75, 2.25]"
    assert tables["PD in mm²"][3][:2] == ["all levels", "8"]


def test_evaluations_without_faults_have_no_such_section(tmp_path):
    folder = write_evaluation(tmp_path, [row("can", 0, method="icp", step=4, diversity=1.0)])
    evaluation = open_evaluation(folder)
    assert tables_by_faults(evaluation.rows, styles_of(evaluation.methods)) == []
