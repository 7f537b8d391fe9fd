"""What is exported is what was recorded, to the bit, and other programs can read it."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

import chsel
from chsel.errors import SettingError
from chsel.events import (
    Believed,
    HypothesesFound,
    Measured,
    Probe,
    ProblemPosed,
    SensorImage,
    SnapshotTaken,
)
from chsel.problem.points import KnownPoints
from chsel.problem.poses import axis_angle, inverse
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import object_grid
from chsel.problem.streams import StreamKey
from replay.__main__ import main
from replay.mcap.reader import read_recording
from replay.verbs.export import EXPORTS, exported_archive, exported_modes
from runners.sessions.points import PointsSettings, PointsSource
from tests.chsel.samples import REPOSITORY, box_with_knob, hypotheses_at
from tests.replay.conftest import same_bits
from tests.tools.small_recordings import registered_session


@pytest.fixture
def recording(events, write):
    """Three probes, two registrations, an archive of two snapshots in each."""
    return read_recording(write(events))


def exported(recording, what, file_format, *more):
    """The file that the command writes."""
    path = recording.path.with_name(f"out.{file_format}")
    path.unlink(missing_ok=True)
    assert main(["export", str(recording.path), "--what", what, "-o", str(path), *more]) == 0
    return path


def table(recording, what, *more):
    with exported(recording, what, "csv", *more).open(newline="") as file:
        return list(csv.DictReader(file))


def arrays(recording, what, *more):
    with np.load(exported(recording, what, "npz", *more), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def standard_json(recording, what):
    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads(exported(recording, what, "json").read_text(), parse_constant=refuse)


@pytest.mark.parametrize("file_format", ["npz", "csv"])
def test_a_points_session_on_exported_points_has_the_recorded_problems(recording, file_format):
    path = exported(recording, "points", file_format)
    workspace = tuple(zip(*recording.start.workspace.bounds.tolist(), strict=True))
    large: Any = SimpleNamespace(diameter=5.0)
    session = PointsSource(PointsSettings(str(path), workspace), large)
    assert session.workspace == recording.start.workspace
    points = KnownPoints()
    steps = []
    for probe, original in zip(session.probes(), recording.probes, strict=True):
        points = points.merged(probe.new_points)
        steps.append(probe.step)
        if probe.step in recording.steps:
            assert points.digest == recording.problem(probe.step).points.digest
            assert same_bits(probe.new_points.known, original.new_points.known)
    assert steps == [0, 1, 2]
    if file_format == "npz":
        truth = recording.start.world_from_object
        np.testing.assert_allclose(session.world_from_object, truth, rtol=0, atol=1e-15)


@pytest.mark.parametrize("file_format", ["npz", "csv"])
def test_exported_normals_are_read_where_they_are_asked_for(tmp_path, capsys, file_format):
    box = trimesh.creation.box((0.1, 0.06, 0.2))
    contacts, faces = trimesh.sample.sample_surface(box, 9, seed=0)
    normals = np.asarray(box.face_normals)[faces] @ axis_angle(np.array([0.6, 0.0, 0.8]), 0.7)
    normals[7] = 0.0
    with chsel.Session(box, record=tmp_path / "touches.mcap") as session:
        session.add(contacts=contacts[:3], normals=normals[:3], normal_noise=[0.1, 0.2, 0.3])
        session.add(contacts=contacts[3:6], free=[[0.3, 0.3, 0.3]], occupied=[[0, 0, 0]])
        session.add(contacts=contacts[6:], normals=1.004 * normals[6:])
        diameter = session.started.sdf.diameter
        workspace = tuple(zip(*session.started.workspace.bounds.tolist(), strict=True))
    recording = read_recording(tmp_path / "touches.mcap")
    path = exported(recording, "points", file_format)
    assert "session.normals=file" in capsys.readouterr().out
    model: Any = SimpleNamespace(diameter=diameter)
    source = PointsSource(PointsSettings(str(path), workspace, normals="file"), model)
    assert source.warnings == []
    for probe, original in zip(source.probes(), recording.probes, strict=True):
        assert probe.new_points.digest == original.new_points.digest
        assert same_bits(probe.new_points.normals, original.new_points.normals)
        assert same_bits(probe.contact_normals, original.contact_normals)
    assert probe.new_points.normal_noise.tolist() == [0.25, 0.0, 0.25]
    source = PointsSource(PointsSettings(str(path), workspace), model)
    assert [warning.code for warning in source.warnings] == ["normals_unused"]
    for probe, original in zip(source.probes(), recording.probes, strict=True):
        assert same_bits(probe.new_points.known, original.new_points.known)
        assert not probe.new_points.has_normals
    assert list(arrays(recording, "points", "--steps", "1")) == [
        *("known_sdf", "free", "free_step", "occupied", "occupied_step", "known", "known_step")
    ]


def test_points_of_single_steps_are_those_that_came_with_them(recording):
    new = [probe.new_points for probe in recording.probes]
    found = arrays(recording, "points", "--steps", "1..")
    assert same_bits(found["free"], np.concatenate([new[1].free, new[2].free]))
    assert found["free_step"].tolist() == [1] * 40 + [2] * 40
    assert found["known_sdf"].tolist() == [0.0, 0.01, 0.0, 0.0, 0.01, 0.01]
    assert same_bits(found["world_from_object"], recording.start.world_from_object)


def test_hypotheses_are_the_recorded_ones(recording, events):
    found, rows = arrays(recording, "hypotheses"), table(recording, "hypotheses")
    listed = standard_json(recording, "hypotheses")
    assert found["steps"].tolist() == [1, 2]
    assert same_bits(found["true_world_from_object"], recording.start.world_from_object)
    for event in (e for e in events if isinstance(e, HypothesesFound)):
        hypotheses = event.hypotheses
        for name in ("object_from_world", "cost", "duplicate", "cell"):
            assert same_bits(found[f"step_{event.step}/{name}"], getattr(hypotheses, name))
        for form in (rows, listed):
            of_step = [row for row in form if int(row["step"]) == event.step]
            matrices = [[float(row[f"m{i // 4}{i % 4}"]) for i in range(16)] for row in of_step]
            assert same_bits(np.reshape(matrices, (-1, 4, 4)), hypotheses.object_from_world)
            assert [float(row["cost"]) for row in of_step] == hypotheses.cost.tolist()
            assert [int(row["rank"]) for row in of_step] == [0, 1, 2, 3, 4]
            assert [int(row["duplicate"]) for row in of_step] == [0, 0, 1, 0, 1]
            assert [int(row["cell"]) for row in of_step] == [3, -1, 5, 1599, 0]


def test_modes_are_those_of_the_recorded_beliefs(events, write):
    covariance = np.diag([1.0, 4.0, 4.0, 0.0, 0.0, 16.0])[None]
    poses = np.eye(4)[None]
    centres = np.array([[0.1, 0.2, 0.3]])
    told = Believed(
        2,
        np.array([7]),
        weights=np.array([0.75]),
        object_from_world=poses,
        centres=centres,
        covariances=covariance,
        spread=0.01,
    )
    found = next(e for e in events if isinstance(e, HypothesesFound) and e.step == 2)
    place = events.index(found) + 1
    recording = read_recording(write([*events[:place], told, *events[place:]]))
    (row,) = table(recording, "modes")
    names = ("step", "number", "weight", "x", "y", "z", "position_deviation", "rotation_deviation")
    assert [float(row[name]) for name in names] == [2, 7, 0.75, 0.1, 0.2, 0.3, 3.0, 4.0]
    assert same_bits(arrays(recording, "modes")["step_2/covariances"], covariance)


def test_modes_of_a_recording_without_beliefs_are_those_of_its_results():
    """Of a result that is wide there are none."""
    recording = read_recording(REPOSITORY / "tests" / "replays" / "points_default_icp.mcap")
    measured = [event for event in recording.events() if isinstance(event, Measured)]
    modes = {event.step: event.values["modes"] for event in measured}
    assert modes == {2: 0.0, 3: 1.0}
    steps = exported_modes(recording, None).table.groupby("step")
    assert steps.size().to_dict() == {3: 1}
    assert steps["weight"].sum().tolist() == pytest.approx([1.0])
    best = steps.get_group(3).filter(regex=r"m\d\d").to_numpy()[0].reshape(4, 4)
    assert same_bits(best, recording.hypotheses(3).object_from_world[0])
    alone = exported_modes(recording, "3").table
    assert alone.equals(steps.get_group(3))


def test_a_mode_keeps_its_number_where_it_is_second_at_one_step_and_first_at_the_next(write):
    """No contact has shown the knob of a box; turned by pi about its axis it fits as well."""
    body, contacts = box_with_knob([0.1, 0.06, 0.08])
    start = replace(registered_session("gradient_descent")[0], mesh=body, sdf=object_grid(body))
    first = np.eye(4)
    second = np.diag([-1.0, -1.0, 1.0, 1.0])
    points = KnownPoints(known=contacts)
    events = [replace(start, initial_points=KnownPoints())]
    known = [points, KnownPoints()]
    for step, poses in enumerate(([first, second], [second, first])):
        key = StreamKey(start.seed, step)
        problem = RegistrationProblem(
            sdf=start.sdf,
            points=points,
            initial_set=np.stack(poses),
            workspace=start.workspace,
            free_resolution=start.free_resolution,
            key=key,
        )
        found = hypotheses_at(np.stack(poses))
        events += [Probe(step, "points", new_points=known[step]), ProblemPosed(step, problem)]
        events.append(HypothesesFound(step, found))
    modes = exported_modes(read_recording(write(events)), None).table
    assert modes["number"].tolist() == [0, 1, 1, 0]
    assert modes["m00"].tolist() == [1.0, -1.0, -1.0, 1.0]
    assert modes["weight"].tolist() == [0.5] * 4


def test_positions_and_quaternions_turn_the_object_into_the_world(recording):
    rows = table(recording, "hypotheses", "--steps", "2")
    world_from_object = inverse(recording.hypotheses(2).object_from_world)
    for row, pose in zip(rows, world_from_object, strict=True):
        assert [float(row[name]) for name in "xyz"] == pose[:3, 3].tolist()
        x, y, z, w = (float(row[name]) for name in ("qx", "qy", "qz", "qw"))
        vector = np.array([x, y, z])
        for axis in np.eye(3):  # v' = v + 2 q x (q x v + w v)
            turned = axis + 2 * np.cross(vector, np.cross(vector, axis) + w * axis)
            np.testing.assert_allclose(turned, pose[:3, :3] @ axis, atol=1e-14)


def test_archives_are_the_recorded_ones(recording, events, write):
    taken = [e.archive for e in events if isinstance(e, SnapshotTaken)]
    found, rows = arrays(recording, "archive"), table(recording, "archive")
    names = [(step, index) for step in (1, 2) for index in (0, 1)]
    for (step, index), archive in zip(names, taken, strict=True):
        for name in ("cells", "objectives", "measures", "solutions", "lower", "upper"):
            stored = found[f"step_{step}/snapshot_{index}/{name}"]
            assert same_bits(stored, getattr(archive, name))
        assert found[f"step_{step}/snapshot_{index}/shape"].tolist() == [40, 40]
    flat = np.array([[float(row[f"solution_{i}"]) for i in range(9)] for row in rows])
    assert same_bits(flat, np.concatenate([archive.solutions for archive in taken]))
    pairs = np.array([[float(row["measure_0"]), float(row["measure_1"])] for row in rows])
    assert same_bits(pairs, np.concatenate([archive.measures for archive in taken]))
    without = read_recording(write([e for e in events if not isinstance(e, SnapshotTaken)]))
    of_results = exported_archive(without, None).table.set_index("step")
    assert of_results.loc[2, "cell"].tolist() == without.hypotheses(2).archive.cells.tolist()


def test_metrics_are_all_recorded_numbers(recording):
    rows = table(recording, "metrics")
    values = {(int(r["step"]), r["source"], r["name"]): float(r["value"] or "nan") for r in rows}
    assert len(values) == len(rows) == 3 * 4 + 2 * (3 + 1 + 2)
    assert values[0, "contents", "free"] == 80.0
    assert values[2, "contents", "contacts"] == 3.0
    assert (0, "contents", "best_cost") not in values
    assert values[2, "contents", "best_cost"] == recording.hypotheses(2).cost[0]
    assert str(values[1, "measured", "best_cost"]) == "-0.0"
    assert np.isnan(values[1, "measured", "coverage_mm2"])
    undefined = [row for row in standard_json(recording, "metrics") if row["value"] is None]
    assert [row["name"] for row in undefined] == ["coverage_mm2"] * 2
    found = arrays(recording, "metrics", "--steps", "2")
    assert set(found["step"].tolist()) == {2}
    assert "timed" in found["source"].tolist()


def test_images_are_the_recorded_ones(sensor_events, write):
    recording = read_recording(write(sensor_events))
    images = [event for event in sensor_events if isinstance(event, SensorImage)]
    found, rows = arrays(recording, "images"), table(recording, "images")
    for seen, row in zip(images, rows, strict=True):
        folder = f"step_{row['step']}/{row['sensor']}_{row['image']}"
        for name in ("values", "mask", "intrinsics", "world_from_camera"):
            assert same_bits(found[f"{folder}/{name}"], getattr(seen, name))
        assert int(row["counting"]) == seen.mask.sum()
        assert float(row["cx"]) == seen.intrinsics[2]


@pytest.mark.parametrize("what", EXPORTS)
def test_every_recording_can_be_exported_that_has_something(any_events, write, what, capsys):
    path = write(any_events)
    for file_format in ("npz", "csv", "json"):
        out = path.with_name(f"any.{file_format}")
        if main(["export", str(path), "--what", what, "-o", str(out)]) == 2:
            message = r"error: recording .* (has no|does not have) [\w ]+; accepted: one .*\n"
            assert re.fullmatch(message, capsys.readouterr().err)
            assert not out.exists()


def test_the_file_is_named_after_the_recording(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(recording.path), "--what", "metrics", "--format", "csv"]) == 0
    name = f"{recording.path.stem}_metrics.csv"
    assert Path(name).read_text().startswith("step,source,name,value\n0,contents,free,80.0\n")
    assert capsys.readouterr().out.startswith(f"{name}  ")


def test_what_does_not_fit_is_named(recording, capsys):
    words = ["export", str(recording.path), "--what"]
    for more, message in {
        ("points", "--format", "csv", "-o", "a.npz"): "--format is csv and a.npz ends in npz",
        ("points", "--format", "csv", "-o", "a"): "a ends in no suffix; accepted: .npz, .csv",
        ("hypotheses", "--steps", "0"): "there is no step 0; accepted: 1, 2",
    }.items():
        assert main([*words, *more]) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(SettingError, match="there is no step 3"):
        EXPORTS["metrics"](recording, "3")
