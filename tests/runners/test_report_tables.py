"""Tables of a report beside those of PD: objects, calibration, ties with a baseline, the lead."""

from __future__ import annotations

from pathlib import Path

import pytest

from runners import report
from runners.reporting.against_baseline import against_baseline
from runners.reporting.evaluation_folder import open_evaluation
from runners.reporting.section import Subject
from tests.runners.in_process import run
from tests.runners.made_up_evaluations import row, write_evaluation
from tests.runners.test_report import Page, page_of


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


def test_objects_have_their_trials_steps_and_plausible_sets_counted(page: Page) -> None:
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


def test_the_lead_counts_methods_trials_objects_and_registrations(folder: Path) -> None:
    text = (folder / "report" / "report.md").read_text(encoding="utf-8")
    assert "2 methods on 4 trials of 2 objects: 16 registrations." in text


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
