"""docs/architecture.md: its recipes, carried out in a copy of the repository, do what they say."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from chsel import CompiledCost
from chsel.next_probe.forecast import Forecast
from replay.events import Decided
from replay.mcap.reader import Recording, read_recording
from runners.reporting.evaluation_folder import open_evaluation
from tests.chsel.kernel_files import kernel_files
from tests.docs.page import commands_in, named_blocks, section, shell, take_over
from tests.runners.made_up_evaluations import made_up_rows, write_evaluation

PAGE = "architecture.md"
REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGES = ("chsel", "conf", "replay", "runners")
RECIPES = (  # those together that change chsel, as each would compile all kernels anew
    ("Adding a method", "Adding a policy"),
    ("Adding an object",),
    ("Adding a session kind",),
    ("Adding an event",),
)
REPORT_RECIPES = (("Adding a figure",), ("Adding a column",))


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the repository in which all recipes were carried out, one after the other."""
    return carried_out(RECIPES, tmp_path_factory.mktemp("copy"))


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy in which the recipes of reports were carried out on a made-up evaluation."""
    folder = tmp_path_factory.mktemp("reported")
    rows = made_up_rows(["can", "mustard"], [0, 1], 2, ["chsel", "icp"])
    write_evaluation(folder / "logs" / "evaluation" / "smoke", rows)
    return carried_out(REPORT_RECIPES, folder)


def carried_out(recipes: Sequence[Sequence[str]], folder: Path) -> Path:
    """The folder, with a copy of the repository in which recipes were carried out in order."""
    unwanted = shutil.ignore_patterns("__pycache__")
    for package in PACKAGES:
        shutil.copytree(REPOSITORY / package, folder / package, ignore=unwanted)
    shutil.copy(REPOSITORY / "pyproject.toml", folder)
    for titles in recipes:
        texts = [section(PAGE, title) for title in titles]
        assert all(take_over(text, folder) for text in texts)
        for command in commands_in("".join(texts)):
            run(command, folder)
    return folder


def run(command: str, folder: Path) -> str:
    """Run a command on the copy's packages; kernels are compiled for it alone."""
    done = shell(command, folder, PYTHONPATH=str(folder), CHSEL_CACHE_DIR=str(folder / "kernels"))
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    return done.stdout


def path_of(folder: Path, name: str) -> Path:
    (path,) = folder.glob(f"logs/probe/*_{name}_*/recording.mcap")
    return path


def recorded(folder: Path, name: str) -> Recording:
    return read_recording(path_of(folder, name))


def test_a_method_anneals_every_start(copy: Path) -> None:
    recording = recorded(copy, "mustard_annealing")
    assert recording.start.config["method"]["temperature"] == 1.0
    steps = [step for step in recording.steps if recording.has_result(step)]
    assert steps
    for step in steps:
        problem, found = recording.problem(step), recording.hypotheses(step)
        assert len(found.cost) == len(problem.initial_set) == 30
        before = np.sort(CompiledCost.of(problem).evaluate(problem.initial_set))
        assert (found.cost <= before).all()
        assert found.cost.sum() < before.sum()


def test_a_method_has_the_presets_of_its_groups(copy: Path) -> None:
    shown = run("python -m runners.probe method=annealing preset=paper --cfg job --resolve", copy)
    method = yaml.safe_load(shown)["method"]
    assert (method["name"], method["rounds"]) == ("annealing", 200)
    assert method["cost"]["lookup"] == "nearest"


def test_its_kernel_is_checked_as_all_are(copy: Path) -> None:
    assert copy / "chsel" / "methods" / "annealing.py" in kernel_files(copy)
    assert list((copy / "kernels").rglob("annealing.accepted*.nbc"))


def test_a_policy_scores_by_how_far_the_hand_gets(copy: Path) -> None:
    recording = recorded(copy, "clamp_gradient_descent")
    assert recording.start.config["policy"]["name"] == "depth_scatter"
    decisions = [event for event in recording.events() if isinstance(event, Decided)]
    assert [event.step for event in decisions] == [-1, 0, 1, 2]
    for event in decisions:
        problem, score = event.problem, event.decision.score
        first = Forecast(problem, 0.002).first
        way = np.minimum(first.travel, problem.actions.length)
        mean = problem.belief.weights @ way
        scatter = np.sqrt(problem.belief.weights @ (way - mean) ** 2)
        taken = np.isfinite(score)
        assert score[taken] == pytest.approx(scatter[taken], abs=1e-9)
        assert taken.sum() > 50


def test_an_object_is_probed_where_its_configuration_says(copy: Path) -> None:
    recording = recorded(copy, "bottle_gradient_descent")
    assert np.allclose(recording.start.mesh.extents, (0.07, 0.07, 0.2), atol=1e-3)
    assert recording.start.config["configuration"] == "bottle"
    truth = recording.start.world_from_object
    assert truth is not None
    assert np.allclose(truth[:3, 3], (0.25, 0.0, 0.0), atol=1e-6)
    assert len(recording.probes) == 4
    assert sum(len(probe.contacts) for probe in recording.probes) > 0


def test_a_session_kind_yields_contacts_on_the_object(copy: Path) -> None:
    recording = recorded(copy, "mustard_gradient_descent")
    assert recording.start.session == "touches"
    assert [len(probe.contacts) for probe in recording.probes] == [8, 8]
    contacts = np.concatenate([probe.contacts for probe in recording.probes])
    _, distance, _ = recording.start.mesh.nearest.on_surface(contacts - (0.3, 0.0, 0.0))
    assert distance.max() < 1e-6
    assert recording.hypotheses(1).cost[0] < recording.hypotheses(0).cost[-1]


def test_an_event_is_written_read_listed_and_exported(copy: Path) -> None:
    path = path_of(copy, "spam_can_gradient_descent")
    info = json.loads(run(f"python -m replay info {path} --json", copy))
    assert info["messages"]["/contact_forces"] == 2
    code = (
        "import sys; from replay.mcap.reader import read_recording; "
        "events = list(read_recording(sys.argv[1]).events()); "
        "forces = [event.newtons for event in events if type(event).__name__ == 'ContactForces']; "
        "print([force.shape for force in forces], *(force.max() for force in forces), sep=';')"
    )
    shapes, *greatest = run(f'python -c "{code}" {path}', copy).split(";")
    assert shapes == "[(8,), (8,)]"
    rows = json.loads((copy / "forces.json").read_text())
    exported = [row["value"] for row in rows if row["name"] == "greatest_newtons"]
    assert exported == [float(text) for text in greatest]
    assert len(set(exported)) == 2
    assert path.with_name("recording.rrd").stat().st_size > 1000


def test_recordings_of_before_the_event_stay_readable(copy: Path) -> None:
    stored = REPOSITORY / "tests" / "replays" / "spam_can_gradient_descent.mcap"
    info = run(f"python -m replay info {stored}", copy)
    assert "all checksums and digests are right" in " ".join(info.split())


def test_a_figure_is_in_the_report_with_its_numbers_and_its_title(reported: Path) -> None:
    report = reported / "logs" / "evaluation" / "smoke" / "report"
    rows = open_evaluation(report.parent).rows
    drawn = pd.read_csv(report / "time_over_probes.csv", index_col=["method", "step"])
    for place, numbers in drawn.iterrows():
        own = rows[(rows["method"] == place[0]) & (rows["step"] == place[1])]
        assert numbers["median"] == pytest.approx(own["seconds"].median())
    assert set(drawn.index) == set(rows[["method", "step"]].itertuples(index=False, name=None))
    assert "(time_over_probes.svg)" in (report / "report.md").read_text()


def test_a_column_is_in_its_table(reported: Path) -> None:
    text = (reported / "beside" / "report.md").read_text()
    header, _, chsel, _ = text.split("PD and its ratios")[1].split("\n\n")[1].splitlines()
    assert header.endswith("| s, mean | s, greatest |")
    rows = open_evaluation(reported / "logs" / "evaluation" / "smoke").rows
    greatest = rows.loc[rows["method"] == "chsel", "seconds"].max()
    assert float(chsel.split("|")[-2]) == pytest.approx(greatest, rel=5e-3)


def test_files_and_classes_that_the_page_names_exist() -> None:
    prose = re.sub(r"^```.*?^```$", "", (REPOSITORY / "docs" / PAGE).read_text(), flags=re.M | re.S)
    words = set(re.findall(r"`([\w./-]+)`", prose))
    files = [file for package in PACKAGES for file in (REPOSITORY / package).rglob("*.*")]
    files += (REPOSITORY / "tests").rglob("*.*")
    recipes = "".join(section(PAGE, title) for title in chain(*RECIPES, *REPORT_RECIPES))
    paths = {"/" + name for name, _, _ in named_blocks(recipes)}
    paths |= {"/" + file.relative_to(REPOSITORY).as_posix() for file in files}
    named = {word for word in words if word.endswith((".py", ".yaml", ".json"))}
    assert len(named) > 30
    assert {word for word in named if not any(path.endswith("/" + word) for path in paths)} == set()
    text = "".join(file.read_text() for file in files if file.suffix == ".py")
    classes = {word for word in words if re.fullmatch(r"(?:[A-Z][a-z0-9]+){2,}", word)}
    assert len(classes) > 8
    assert {word for word in classes if not re.search(rf"\b{word}\b", text)} == set()
