"""Definitions of the plausible set in tables: their names, and that one table never mixes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from chsel.errors import RecordingError, SettingError
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_settings import DEFINITIONS, definition_name, plausible_settings
from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import settings_mapping
from chsel.problem.streams import StreamKey
from runners import report
from runners.evaluation.metrics import definition_label, definition_text
from runners.evaluation.table import ITERATIONS, RESULTS, write_part, write_table
from runners.reporting.evaluation_folder import ReportError, open_evaluation
from tests.chsel.plausible.scenes import WORKSPACE, ball
from tests.runners.in_process import run
from tests.runners.made_up_evaluations import row, write_evaluation


def definition(name: str, **changes: Any) -> dict[str, Any]:
    """A choice of the command, with its settings changed."""
    values = {**settings_mapping(plausible_settings(name, 1.0)), "epsilon": None}
    return {"name": name, **values, **changes}


def test_every_definition_has_its_own_name_and_changed_ones_have_others() -> None:
    assert [definition_label(definition(name)) for name in DEFINITIONS] == list(DEFINITIONS)
    assert [definition_name(plausible_settings(name, 0.02)) for name in DEFINITIONS] == list(
        DEFINITIONS
    )
    changed = [
        definition("default", fill_to=40),
        definition("default", fill_to=41),
        definition("default", epsilon=0.002),
        definition("wide_sums", epsilon=0.002),
    ]
    labels = [definition_label(one) for one in changed]
    assert [label[:-8] for label in labels] == ["default~"] * 3 + ["wide_sums~"]
    assert len(set(labels)) == 4
    disguised = {**definition("paper"), "name": "wide_means"}
    assert definition_label(disguised) == "paper"


def test_the_text_of_a_definition_says_sums_or_means() -> None:
    assert definition_text(definition("paper")) == (
        "paper, cost by sums over points (the paper's), free points at most 0 mm inside of "
        "members, epsilon that of each object"
    )
    text = definition_text(definition("wide_means_10mm", epsilon=0.0005))
    assert "cost by means over points, free points at most 10 mm inside" in text
    assert text.endswith("epsilon 0.5 mm")


@pytest.mark.parametrize(("name", "expected"), [("wide_sums", 0.02), ("wide_means", 0.005)])
def test_wide_definitions_add_up_contacts_or_take_their_mean(name: str, expected: float) -> None:
    """A ball that is 5 mm off four contacts on its sides."""
    contacts = 0.1 * np.array(
        [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
    )
    points = KnownPoints(known=1.05 * contacts)
    problem = RegistrationProblem(
        ball(0.1, 0.005), points, np.eye(4)[None], WORKSPACE, 0.03, StreamKey(0, 0)
    )
    settings = plausible_settings(name, 0.001)
    cost = EvaluationCost(problem, settings.cost).evaluate(np.eye(4)[None])[0]
    assert cost == pytest.approx(expected, rel=0.02)
    assert settings.fill_to == 300
    assert settings.cost.tolerance == 0.0


def test_a_report_refuses_a_table_of_two_definitions(tmp_path: Path) -> None:
    rows = [
        row("can", seed, "icp", 4, diversity=1.0) | {"definition": name}
        for seed, name in enumerate(("wide_sums", "wide_means", "wide_sums"))
    ]
    done = run(report.main, str(write_evaluation(tmp_path, rows)))
    assert done.returncode == 2
    assert done.stderr == (
        f"error: {tmp_path} has numbers by 2 definitions of plausible sets, wide_means, wide_sums; "
        "accepted: one, each in an out=DIR of its own\n"
    )
    moment = {"configuration": "can", "seed": 0, "method": "icp", "definition": "wide_means"}
    with pytest.raises(ReportError, match="wide_means, wide_sums"):
        open_evaluation(write_evaluation(tmp_path / "moments", rows[:1], [moment]))


def test_a_report_says_by_which_definition_its_numbers_are(tmp_path: Path) -> None:
    rows = [
        row("can", 0, method, 4, diversity=1.0, exact_members=0.5) | {"definition": "wide_sums"}
        for method in ("chsel", "icp")
    ]
    folder = write_evaluation(tmp_path, rows, definition=definition("wide_sums"))
    done = run(report.main, str(folder), "baseline=icp")
    assert (done.returncode, done.stderr) == (0, "")
    assert "PD and its ratios over all registrations, by wide_sums" in done.stdout
    text = (folder / "report" / "report.md").read_text().replace("\\", "")
    lead = text.split("##")[0]
    assert "by the definition wide_sums, cost by sums over points (the paper's)" in lead
    assert (
        "Of hypotheses that fulfil the definition of the plausible set themselves, wide_sums"
        in (text)
    )


def test_rows_from_before_there_was_a_column_have_the_definition_of_their_folder(
    tmp_path: Path,
) -> None:
    rows = [row("can", 0, "icp", 4, diversity=1.0)]
    folder = write_evaluation(tmp_path, rows, definition=definition("paper"))
    assert open_evaluation(folder).definition == "paper"
    rows += [row("can", 1, "icp", 4) | {"definition": "default"}]
    with pytest.raises(ReportError, match="default, paper"):
        open_evaluation(write_evaluation(tmp_path, rows, definition=definition("paper")))


@pytest.mark.parametrize("schema", [RESULTS, ITERATIONS], ids=["results", "iterations"])
def test_parts_by_another_definition_go_into_no_table(tmp_path: Path, schema: pa.Schema) -> None:
    found = dict.fromkeys(schema.names) | {"method": "icp", "step": 4}
    one, other = tmp_path / "one.parquet", tmp_path / "other.parquet"
    write_part(one, [found | {"definition": "paper"}], schema)
    write_part(other, [found | {"definition": "default"}], schema)
    with pytest.raises(RecordingError, match=r"other\.parquet has numbers by the def.* default"):
        write_table(tmp_path, "results", [one, other], schema, "paper")
    table = write_table(tmp_path, "results", [one], schema, "paper")
    assert table["definition"].to_pylist() == ["paper"]


def test_a_definition_that_cannot_be_is_named() -> None:
    with pytest.raises(SettingError, match=r"definition\.cost: combine is 'medians'"):
        definition_label({"name": "mine", "cost": {"combine": "medians"}})
