"""`compare`: several methods on the recorded problems, under one cost."""

import csv
import dataclasses
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.errors import EngineError, RecordingError, SettingError
from chsel.events import Probe
from chsel.methods import build_method
from chsel.plausible.plausible_set import plausible_set, save_plausible
from chsel.plausible.plausible_settings import plausible_settings
from chsel.plausible.pose_metrics import closest_pose, plausible_diversity
from chsel.plausible.surface_distance import DistanceSettings, SurfaceDistance, surface_points
from chsel.problem.sdf_grid import object_grid
from chsel.problem.streams import StreamKey
from replay.__main__ import main
from replay.comparing.choices import METHOD, chosen, is_recorded, recorded_method
from replay.comparing.comparison import PlausibleSets, common_cost, compared, recorded_label
from replay.mcap.reader import read_recording
from tests.tools.small_recordings import METHODS, registered_session, write_recording

REPLAYS = Path(__file__).resolve().parents[1] / "replays"
OFFSET = (0.02, 0.0, 0.15)
COST = {"penetration_tolerance": -0.005, "known_scale": 4.0}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """A recording of two registrations of a box, whose true pose is said to be elsewhere."""
    path = tmp_path_factory.mktemp("compare") / "recording.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(METHODS["chsel"], "cost", COST)
        start, *events = registered_session("chsel")
    pose = np.eye(4)
    pose[:3, 3] = OFFSET
    write_recording(path, [dataclasses.replace(start, world_from_object=pose), *events])
    return path


def rows_of(text):
    """The cells of the table of medians, by label."""
    cells = [
        re.split(r"\s{2,}", line.strip()) for line in text.split("medians over")[1].split("\n")
    ]
    return {row[0]: row[1:] for row in cells if len(row) >= 8}


def test_the_recorded_method_finds_the_recorded_bits_and_the_others_their_own(
    path, capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "120")
    assert main(["compare", str(path), "--methods", "chsel", "gradient_descent"]) == 0
    out = capsys.readouterr().out
    assert "chsel has the recorded settings: its 2 results are those recorded, to the bit" in out
    assert "each step, costs of all by chsel's, as recorded" in out
    rows = rows_of(out)
    steps, *recorded, no_time = rows["recorded: chsel"]
    *again, time = rows["chsel"][1:]
    assert (steps, again, no_time) == ("2", recorded, "-")
    assert float(time) > 0.0
    assert rows["gradient_descent"][1:-1] != recorded
    costs = [read_recording(path).hypotheses(step).cost for step in range(2)]
    assert recorded[0] == f"{np.median([cost[0] for cost in costs]):.3g}"
    assert recorded[1] == f"{np.median([np.median(cost) for cost in costs]):.3g}"


def test_all_sets_are_judged_by_the_recorded_cost(path):
    recording = read_recording(path)
    cost = common_cost(recording)
    assert cost.settings == dataclasses.replace(CostSettings(), **COST)
    methods = chosen(recording, METHOD, words=["chsel", "chsel@paper"])
    outcomes = list(compared(recording, methods, steps=recording.steps, cost=cost))
    labels = [recorded_label(recording), "chsel", "chsel@paper"]
    assert [(o.step, o.label) for o in outcomes] == [(k, name) for k in (0, 1) for name in labels]
    truth, sdf = recording.start.world_from_object, recording.start.sdf
    for outcome in outcomes:
        problem = recording.problem(outcome.step)
        poses = outcome.hypotheses.object_from_world
        costs = CompiledCost.of(problem, cost.settings).evaluate(poses)
        best = np.argmin(costs)
        assert outcome.numbers["best_cost"] == costs[best]
        assert outcome.numbers["median_cost"] == np.median(costs)
        assert outcome.numbers["hypotheses"] == len(poses)
        inverse = np.linalg.inv(poses)
        errors = np.linalg.norm(inverse[:, :3, 3] - OFFSET, axis=1)
        assert outcome.numbers["best_position_error"] == pytest.approx(errors[best], abs=1e-12)
        near = closest_pose(poses, truth, sdf=sdf)
        assert outcome.numbers["closest_position_error"] == pytest.approx(errors[near], abs=1e-12)
        signs = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])  # of a box
        traces = signs @ np.diagonal(inverse[best, :3, :3])
        angle = np.arccos(np.clip((traces.max() - 1) / 2, -1, 1))
        assert outcome.numbers["best_rotation_error"] == pytest.approx(angle, abs=1e-6)
    own = [o for o in outcomes if o.label == labels[2]]
    assert any(o.numbers["best_cost"] != o.hypotheses.cost[0] for o in own)
    assert {o.as_recorded for o in outcomes if o.label == "chsel"} == {True}
    assert {o.as_recorded for o in outcomes if o.label != "chsel"} == {None}


def test_errors_are_those_to_the_pose_that_a_push_has_left_the_object_in(path, tmp_path):
    """The second probe has moved the box by 3 cm, as recordings say where it is known."""
    events = list(read_recording(path).events())
    moved = np.eye(4)
    moved[:3, 3] = np.add(OFFSET, [0.0, 0.03, 0.0])
    of_second = {"world_from_object": moved}
    changed = [
        dataclasses.replace(e, **of_second) if isinstance(e, Probe) and e.step == 1 else e
        for e in events
    ]
    write_recording(tmp_path / "pushed.mcap", changed)
    recording = read_recording(tmp_path / "pushed.mcap")
    cost = common_cost(recording)
    methods = chosen(recording, METHOD, words=["chsel"])
    for outcome in compared(recording, methods, steps=recording.steps, cost=cost):
        poses = outcome.hypotheses.object_from_world
        costs = CompiledCost.of(recording.problem(outcome.step), cost.settings).evaluate(poses)
        best = np.linalg.inv(poses[np.argmin(costs)])
        there = moved[:3, 3] if outcome.step == 1 else np.array(OFFSET)
        error = np.linalg.norm(best[:3, 3] - there)
        assert outcome.numbers["best_position_error"] == pytest.approx(error, abs=1e-12)


def test_another_result_than_recorded_is_told(path, capsys, monkeypatch):
    registered = type(build_method("chsel")).register

    def later(self, problem, observer=None):
        found = registered(self, problem, observer=observer)
        if problem.key.step != 1:
            return found
        return dataclasses.replace(found, cost=np.nextafter(found.cost, 1e9))

    monkeypatch.setattr(type(build_method("chsel")), "register", later)
    assert main(["compare", str(path), "--methods", "chsel"]) == 1
    assert "1 of 2 results are not those recorded, at step 1 (verify" in capsys.readouterr().out


def test_changes_reach_the_methods_that_have_the_setting(path):
    recording = read_recording(path)
    labels = ["chsel", "chsel@paper", "chsel#two", "gradient_descent"]
    changes = ["emitter.iterations=20", "cost.known_scale=2", "chsel#two:archive.bins=7"]
    found = {c.label: c for c in chosen(recording, METHOD, words=[*labels, *changes])}
    assert [c.changes for c in found.values()] == [
        ("emitter.iterations=20", "cost.known_scale=2"),
        ("emitter.iterations=20", "cost.known_scale=2"),
        ("emitter.iterations=20", "cost.known_scale=2", "archive.bins=7"),
        ("cost.known_scale=2",),
    ]
    settings = {label: c.build().settings for label, c in found.items()}
    assert {s.cost.known_scale for s in settings.values()} == {2.0}
    assert settings["chsel#two"].archive.bins == 7
    assert settings["chsel"].archive.bins == 6  # as recorded
    assert settings["chsel@paper"].archive.bins == 40
    assert settings["chsel@paper"].cost.lookup == "nearest"
    assert settings["gradient_descent"].descent.iterations == 50  # of the default preset
    assert not any(is_recorded(recording, c) for c in found.values())
    (same,) = chosen(recording, METHOD, words=["chsel", "emitter.iterations=12"])
    assert is_recorded(recording, same)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["magic"], "method is 'magic'; accepted: chsel, "),
        (["chsel", "chsel"], "chsel is named twice; accepted: NAME, NAME@PRESET"),
        (["chsel#"], "'chsel#' is not a method"),
        (["chsel", "emitter.iteration=3"], "chsel: method.emitter.iteration does not exist; did"),
        (["chsel", "paper:passes=3"], "names no method here; accepted: chsel"),
        (["chsel", "=3"], "'=3' is not a setting; accepted: KEY=VALUE"),
        (["passes=3"], "no method is named; accepted: chsel, "),
    ],
)
def test_what_is_no_method_or_setting_is_named(path, words, message):
    with pytest.raises(SettingError, match=re.escape(message)):
        chosen(read_recording(path), METHOD, words=words)


def test_everything_is_saved(path, tmp_path, capsys):
    saved = {name: tmp_path / f"out.{name}" for name in ("csv", "png", "rrd")}
    methods = ["--methods", "chsel", "gradient_descent", "descent.iterations=4"]
    outputs = ["--save-csv", "csv", "--save-plot", "png", "--save-rerun", "rrd"]
    outputs = [str(saved.get(word, word)) for word in outputs]
    assert main(["compare", str(path), *methods, "--steps", "1..", *outputs]) == 0
    assert capsys.readouterr().out.count("written: ") == 3
    rows = list(csv.DictReader(saved["csv"].open(newline="")))
    labels = ("recorded: chsel", "chsel", "gradient_descent")
    assert [(row["step"], row["label"]) for row in rows] == [("1", label) for label in labels]
    first = read_recording(path).hypotheses(1)
    assert float(rows[0]["best_cost"]) == first.cost[0]
    assert float(rows[0]["median_cost"]) == np.median(first.cost)
    assert float(rows[0]["best_position_error_m"]) < 0.5
    assert float(rows[0]["best_rotation_error_rad"]) <= math.pi
    assert rows[0]["seconds_s"] == ""
    assert float(rows[1]["seconds_s"]) > 0.0
    assert {row["method"] for row in rows} == {"chsel", "gradient_descent"}
    assert [row["changes"] for row in rows[:2]] == ["", "descent.iterations=4"]
    assert saved["png"].read_bytes().startswith(b"\x89PNG")
    assert len(list(RrdReader(saved["rrd"]).stream())) > 3


def test_a_method_that_fails_leaves_the_others_alone(path, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    registered = type(build_method("gradient_descent")).register

    def failing(self, problem, observer=None):
        if problem.key.step == 0:
            raise EngineError("no luck at step 0")
        return registered(self, problem, observer=observer)

    monkeypatch.setattr(type(build_method("gradient_descent")), "register", failing)
    out = tmp_path / "out.csv"
    arguments = ["--methods", "gradient_descent", "chsel", "--save-csv", str(out)]
    assert main(["compare", str(path), *arguments]) == 1
    said = capsys.readouterr().out
    assert "step 0, gradient_descent: no luck at step 0" in said
    assert (rows_of(said)["gradient_descent"][0], rows_of(said)["chsel"][0]) == ("1", "2")
    rows = {(row["step"], row["label"]): row for row in csv.DictReader(out.open(newline=""))}
    assert rows["0", "gradient_descent"]["failure"] == "no luck at step 0"
    assert rows["0", "gradient_descent"]["best_cost"] == ""
    assert rows["1", "gradient_descent"]["failure"] == ""
    assert rows["0", "chsel"]["bits_as_recorded"] == "yes"


def test_a_recording_that_tells_no_method_is_judged_by_the_default_preset(events, write):
    recording = read_recording(write(events))
    cost = common_cost(recording)
    assert (cost.settings, cost.name) == (CostSettings(), "preset default")
    with pytest.raises(RecordingError, match="does not have the settings of a method"):
        recorded_method(recording)
    methods = chosen(recording, METHOD, words=["gradient_descent", "descent.iterations=2"])
    found = list(compared(recording, methods, steps=(2,), cost=cost))
    assert [o.failure for o in found] == ["", ""]
    assert found[1].numbers["hypotheses"] == 5.0


def test_beside_plausible_sets_it_tells_how_far_hypotheses_are_from_them(tmp_path, capsys):
    path = Path(shutil.copy(REPLAYS / "cracker_box_chsel.mcap", tmp_path))
    recording = read_recording(path)
    start = recording.start
    problem = recording.problem(9)
    found = recording.hypotheses(9)
    members = plausible_set(
        problem, start.world_from_object, settings=plausible_settings("default", 0.001)
    )
    few = {name: getattr(members, name)[:30] for name in ("world_from_object", "cost", "local")}
    members = dataclasses.replace(members, **few)
    (tmp_path / "plausible").mkdir()
    save_plausible(tmp_path / "plausible", members)
    arguments = ["compare", str(path), "--steps", "8,9", "--methods", "icp"]
    assert main([*arguments, "--save-csv", str(tmp_path / "out.csv")]) == 0
    assert "each step, plausible sets by definition default" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "out.csv").open()))
    (recorded,) = (row for row in rows if row["step"] == "9" and row["label"] != "icp")
    points = surface_points(start.mesh, 500, key=StreamKey(start.seed, 0))
    exact = SurfaceDistance(
        start.sdf, start.mesh, points=points, settings=DistanceSettings(method="exact")
    )
    expected = plausible_diversity(
        exact.between(found.object_from_world, members.world_from_object)
    )
    assert float(recorded["diversity_mm2"]) == pytest.approx(expected.diversity, rel=1e-6)
    assert float(recorded["coverage_mm2"]) == pytest.approx(expected.coverage, rel=1e-6)
    assert {row["diversity_mm2"] for row in rows if row["step"] == "8"} == {""}
    assert {(row["step"], row["definition"]) for row in rows} == {("8", ""), ("9", "default")}
    of_another = dataclasses.replace(problem, sdf=object_grid(start.mesh, 0.03))
    assert PlausibleSets(recording).numbers(problem, found)
    assert PlausibleSets(recording).numbers(of_another, found) == {}
    assert main([*arguments, "--definition", "paper"]) == 0
    assert "PD" not in capsys.readouterr().out
    assert main([*arguments, "--plausible", str(tmp_path / "nowhere")]) == 2
    assert "nowhere is not a folder" in capsys.readouterr().err
