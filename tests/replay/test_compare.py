"""`compare`: several methods on the recorded problems, under one cost."""

from __future__ import annotations

import csv
import dataclasses
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from rerun.chunk import RrdReader

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.errors import EngineError, RecordingError, SettingError
from chsel.methods import build_method
from chsel.plausible.plausible_set import plausible_set, save_plausible
from chsel.plausible.plausible_settings import plausible_settings
from chsel.plausible.pose_metrics import plausible_diversity
from chsel.plausible.surface_distance import DistanceSettings, SurfaceDistance, surface_points
from chsel.problem.online_registration import OnlineRegistration
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from replay.__main__ import main
from replay.comparing.choices import METHOD, chosen, is_recorded, recorded_method
from replay.comparing.comparison import common_cost, compared, recorded_label
from replay.events import Probe, ProblemPosed, SessionEnded, SessionStarted
from replay.mcap.reader import read_recording
from replay.mcap.writer import McapRecorder
from replay.registration import register_recorded, symmetry_for_errors

REPLAYS = Path(__file__).resolve().parents[1] / "replays"

SETTINGS = {
    "cost": {"free_scale": 30.0},
    "descent": {"restarts": 2, "iterations": 6},
    "emitter": {"iterations": 12, "sigma0": 1.0, "rate": 0.05},
    "archive": {"measure": "position_2", "bins": 10},
    "output": {
        "choice": "lowest",
        "ratio": 5.0,
        "tolerance_per_point": 2e-3,
        "free_tolerance": 0.2,
        "margin": None,
    },
    "starts": None,
    "online": {"hypotheses": 6},
}
OFFSET = (0.02, 0.0, 0.15)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """A recording of three registrations of a box by small settings."""
    path = tmp_path_factory.mktemp("compare") / "recording.mcap"
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    pose = np.eye(4)
    pose[:3, 3] = OFFSET
    random = np.random.default_rng(3)
    method = build_method("chsel", SETTINGS)
    start = SessionStarted(
        runner="probe",
        object="box",
        session="points",
        method="chsel",
        seed=5,
        config={
            "method": {"name": "chsel", **dataclasses.asdict(method.settings)},
            "preset": {"name": "default"},
        },
        mesh=mesh,
        sdf=SdfGrid.from_mesh(mesh, 0.01, padding=0.03),
        workspace=Workspace((-0.2, -0.2, 0.0), (0.2, 0.2, 0.3)),
        free_resolution=0.01,
        initial_points=KnownPoints(),
        world_from_object=pose,
    )
    recorder = McapRecorder(path)
    recorder.record(start)
    online = OnlineRegistration(
        start.sdf, start.workspace, start.free_resolution, method.online, seed=start.seed
    )

    def probes():
        for step in range(3):
            contacts = np.asarray(trimesh.sample.sample_surface(mesh, 4, seed=step)[0]) + OFFSET
            free = random.uniform((-0.1, -0.1, 0.05), (0.1, 0.1, 0.11), (30, 3))
            new = KnownPoints(free=free, known=contacts, known_sdf=np.zeros(4))
            recorder.record(Probe(step, "contact", new))
            yield step, new

    def register(problem):
        posed, truth = ProblemPosed(problem.key.step, problem), start.world_from_object
        symmetry = symmetry_for_errors(start)
        return register_recorded(posed, method, recorder, truth, symmetry).hypotheses

    assert len([*online.steps(probes(), register)]) == 3
    recorder.record(SessionEnded(2, "finished"))
    recorder.close()
    return path


def rows_of(text: str) -> dict[str, list[str]]:
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
    assert "chsel has the recorded settings: its 3 results are those recorded, to the bit" in out
    assert "each step, costs of all by chsel's, as recorded" in out
    rows = rows_of(out)
    steps, *recorded, no_time = rows["recorded: chsel"]
    *again, time = rows["chsel"][1:]
    assert steps == "3"
    assert (again, no_time) == (recorded, "-")
    assert float(time) > 0.0
    assert rows["gradient_descent"][1:-1] != recorded
    costs = [read_recording(path).hypotheses(step).cost for step in range(3)]
    assert recorded[0] == f"{np.median([cost[0] for cost in costs]):.3g}"
    assert recorded[1] == f"{np.median([np.median(cost) for cost in costs]):.3g}"


def test_all_sets_are_judged_by_the_recorded_cost(path):
    recording = read_recording(path)
    cost = common_cost(recording)
    assert cost.settings == dataclasses.replace(CostSettings(), free_scale=30.0)
    methods = chosen(recording, METHOD, ["chsel", "chsel@reference"])
    outcomes = list(compared(recording, methods, recording.steps, cost))
    assert [o.step for o in outcomes] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert [o.label for o in outcomes[:3]] == [
        recorded_label(recording),
        "chsel",
        "chsel@reference",
    ]
    samples = surface_points(recording.start.mesh, 200, StreamKey(0, 0))
    exactly = DistanceSettings(method="exact")
    distance = SurfaceDistance(recording.start.sdf, recording.start.mesh, samples, exactly)
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
        truth = recording.start.world_from_object[None]
        apart = distance.between(poses, truth)[:, 0]
        near = np.argmin(apart + distance.between(np.linalg.inv(truth), inverse)[0])
        assert outcome.numbers["closest_position_error"] == pytest.approx(errors[near], abs=1e-12)
        signs = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])  # of a box
        traces = signs @ np.diagonal(inverse[best, :3, :3])
        angle = np.arccos(np.clip((traces.max() - 1) / 2, -1, 1))
        assert outcome.numbers["best_rotation_error"] == pytest.approx(angle, abs=1e-6)
    own = [o for o in outcomes if o.label == "chsel@reference"]
    assert any(o.numbers["best_cost"] != o.hypotheses.cost[0] for o in own)
    assert {o.as_recorded for o in outcomes if o.label == "chsel"} == {True}
    assert {o.as_recorded for o in outcomes if o.label != "chsel"} == {None}


def test_another_result_than_recorded_is_told(path, capsys, monkeypatch):
    recording = read_recording(path)
    registered = type(build_method("chsel")).register

    def later(self, problem, observer=None):
        found = registered(self, problem, observer)
        if problem.key.step != 1:
            return found
        return dataclasses.replace(found, cost=np.nextafter(found.cost, 1e9))

    monkeypatch.setattr(type(build_method("chsel")), "register", later)
    assert main(["compare", str(path), "--methods", "chsel"]) == 1
    assert "1 of 3 results are not those recorded, at step 1 (verify" in capsys.readouterr().out
    methods = chosen(recording, METHOD, ["chsel"])
    found = compared(recording, methods, recording.steps, common_cost(recording))
    assert [o.as_recorded for o in found if o.label == "chsel"] == [True, False, True]


def test_changes_reach_the_methods_that_have_the_setting(path):
    recording = read_recording(path)
    labels = ["chsel", "chsel@paper", "chsel#two", "gradient_descent"]
    changes = ["emitter.iterations=20", "cost.known_scale=2", "chsel#two:archive.bins=7"]
    found = {c.label: c for c in chosen(recording, METHOD, [*labels, *changes])}
    assert [c.changes for c in found.values()] == [
        ("emitter.iterations=20", "cost.known_scale=2"),
        ("emitter.iterations=20", "cost.known_scale=2"),
        ("emitter.iterations=20", "cost.known_scale=2", "archive.bins=7"),
        ("cost.known_scale=2",),
    ]
    settings = {label: c.build().settings for label, c in found.items()}
    assert {s.cost.known_scale for s in settings.values()} == {2.0}
    assert settings["chsel#two"].archive.bins == 7
    assert settings["chsel"].archive.bins == 10  # as recorded
    assert settings["chsel@paper"].archive.bins == 40
    assert settings["chsel@paper"].cost.lookup == "nearest"
    assert settings["gradient_descent"].descent.iterations == 50  # of the recording's preset
    assert not any(is_recorded(recording, c) for c in found.values())
    (same,) = chosen(recording, METHOD, ["chsel", "emitter.iterations=12"])
    assert is_recorded(recording, same)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["magic"], "method is 'magic'; accepted: chsel, "),
        (["chsel@best"], "preset is 'best'; accepted: default, paper, reference"),
        (["chsel", "chsel"], "chsel is named twice; accepted: NAME, NAME@PRESET"),
        (["chsel#"], "'chsel#' is not a method"),
        (
            ["chsel", "emitter.iteration=3"],
            "chsel: method.emitter.iteration does not exist; did",
        ),
        (["gradient_descent", "emitter.iterations=3"], "gradient_descent: method.emitter does not"),
        (["chsel", "paper:passes=3"], "names no method here; accepted: chsel"),
        (["chsel", "icp", "icp:passes=3"], "icp: method.passes does not exist"),
        (["chsel", "passes=many"], "chsel: method.passes is 'many'; accepted: an integer"),
        (["chsel", "=3"], "'=3' is not a setting; accepted: KEY=VALUE"),
        (["passes=3"], "no method is named; accepted: chsel, "),
    ],
)
def test_what_is_no_method_or_setting_is_named(path, words, message):
    with pytest.raises(SettingError, match=re.escape(message)):
        chosen(read_recording(path), METHOD, words)


def test_everything_is_saved(path, tmp_path, capsys):
    saved = {name: tmp_path / f"out.{name}" for name in ("csv", "png", "rrd")}
    methods = ["--methods", "chsel", "gradient_descent", "descent.iterations=4"]
    outputs = ["--save-csv", "csv", "--save-plot", "png", "--save-rerun", "rrd"]
    outputs = [str(saved.get(word, word)) for word in outputs]
    assert main(["compare", str(path), *methods, "--steps", "1..", *outputs]) == 0
    assert capsys.readouterr().out.count("written: ") == 3
    with saved["csv"].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["step"], row["label"]) for row in rows] == [
        (step, label) for step in "12" for label in ("recorded: chsel", "chsel", "gradient_descent")
    ]
    recording = read_recording(path)
    first = recording.hypotheses(1)
    assert float(rows[0]["best_cost"]) == first.cost[0]
    assert float(rows[0]["median_cost"]) == np.median(first.cost)
    assert float(rows[0]["best_position_error_m"]) < 0.5
    assert float(rows[0]["best_rotation_error_rad"]) <= math.pi
    assert rows[0]["seconds_s"] == ""
    assert 0.0 < float(rows[1]["seconds_s"]) < 60.0
    assert {row["method"] for row in rows} == {"chsel", "gradient_descent"}
    assert [row["changes"] for row in rows[:2]] == ["", "descent.iterations=4"]
    assert saved["png"].read_bytes().startswith(b"\x89PNG")
    assert len(list(RrdReader(saved["rrd"]).stream())) > 3
    again = ["compare", str(path), *methods, "--save-csv", str(saved["csv"])]
    content = saved["csv"].read_bytes()
    assert main(again) == 2
    assert "out.csv exists; accepted: the name of a new file" in capsys.readouterr().err
    assert saved["csv"].read_bytes() == content


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--save-plot", "out.jpg"],
            "out.jpg is not the name of a picture; accepted: *.png, *.svg",
        ),
        (["--save-plot", "nowhere/out.png"], "folder nowhere does not exist"),
        (["--save-plot", "out.png", "--save-csv", "out.png"], "out.png is named twice"),
        (["--threads", "0"], "--threads is 0; accepted: an integer from 1 to 256"),
        (["--steps", "7"], "there is no step 7; accepted: 0, 1, 2"),
        (["--out", "all.mcap"], "--out records one registration; accepted: with one method and"),
    ],
)
def test_what_cannot_work_is_told_before_any_work(
    path, tmp_path, monkeypatch, capsys, words, message
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("replay.comparing.comparison.register_recorded", None)
    assert main(["compare", str(path), "--methods", "chsel", *words]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_method_that_fails_leaves_the_others_alone(path, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    registered = type(build_method("gradient_descent")).register

    def failing(self, problem, observer=None):
        if problem.key.step == 1:
            raise EngineError("no luck at step 1")
        return registered(self, problem, observer)

    monkeypatch.setattr(type(build_method("gradient_descent")), "register", failing)
    out = tmp_path / "out.csv"
    arguments = ["--methods", "gradient_descent", "chsel", "--save-csv", str(out)]
    assert main(["compare", str(path), *arguments]) == 1
    said = capsys.readouterr().out
    assert "step 1, gradient_descent: no luck at step 1" in said
    assert rows_of(said)["gradient_descent"][0] == "2"
    assert rows_of(said)["chsel"][0] == "3"
    with out.open(newline="") as file:
        rows = {(row["step"], row["label"]): row for row in csv.DictReader(file)}
    assert rows["1", "gradient_descent"]["failure"] == "no luck at step 1"
    assert rows["1", "gradient_descent"]["best_cost"] == ""
    assert rows["2", "gradient_descent"]["failure"] == ""
    assert rows["1", "chsel"]["bits_as_recorded"] == "yes"


def test_a_recording_that_tells_no_method_is_judged_by_the_default_preset(make_events, write):
    recording = read_recording(write(make_events()))
    cost = common_cost(recording)
    assert (cost.settings, cost.name) == (CostSettings(), "preset default")
    with pytest.raises(RecordingError, match="does not have the settings of a method"):
        recorded_method(recording)
    methods = chosen(recording, METHOD, ["gradient_descent", "descent.iterations=2"])
    found = list(compared(recording, methods, (2,), cost))
    assert [o.failure for o in found] == ["", ""]
    assert found[1].numbers["hypotheses"] == 5.0


def test_beside_plausible_sets_it_tells_how_far_hypotheses_are_from_them(tmp_path, capsys):
    path = Path(shutil.copy(REPLAYS / "cracker_box_chsel.mcap", tmp_path))
    recording = read_recording(path)
    start, problem, found = recording.start, recording.problem(9), recording.hypotheses(9)
    assert start.world_from_object is not None
    members = plausible_set(problem, start.world_from_object, plausible_settings("default", 0.001))
    (tmp_path / "plausible").mkdir()
    save_plausible(tmp_path / "plausible", members)
    arguments = ["compare", str(path), "--steps", "8,9", "--methods", "icp"]
    assert main([*arguments, "--save-csv", str(tmp_path / "out.csv")]) == 0
    shown = capsys.readouterr().out
    assert "PD" in shown
    assert "each step, plausible sets by definition default" in shown
    rows = list(csv.DictReader((tmp_path / "out.csv").open()))
    (recorded,) = (row for row in rows if row["step"] == "9" and row["label"] != "icp")
    points = surface_points(start.mesh, 500, StreamKey(start.seed, 0))
    exact = SurfaceDistance(start.sdf, start.mesh, points, DistanceSettings(method="exact"))
    expected = plausible_diversity(
        exact.between(found.object_from_world, members.world_from_object)
    )
    assert float(recorded["diversity_mm2"]) == pytest.approx(expected.diversity, rel=1e-6)
    assert float(recorded["coverage_mm2"]) == pytest.approx(expected.coverage, rel=1e-6)
    assert {row["diversity_mm2"] for row in rows if row["step"] == "8"} == {""}
    assert {(row["step"], row["definition"]) for row in rows} == {("8", ""), ("9", "default")}
    assert main([*arguments, "--definition", "paper", "--each"]) == 0
    assert "PD" not in capsys.readouterr().out
    assert main([*arguments, "--plausible", str(tmp_path / "nowhere")]) == 2
    assert "nowhere is not a folder" in capsys.readouterr().err
