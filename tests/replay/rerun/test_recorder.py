"""The Rerun recording, read back with Rerun's own reader."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from chsel.errors import RecordingError
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import compose, inverse, random_rotations
from chsel.problem.registration_problem import (
    ArchiveSnapshot,
    Hypotheses,
    RegistrationProblem,
)
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from replay.colors import CostScale
from replay.events import (
    Event,
    HypothesesFound,
    Logged,
    Measured,
    Probe,
    ProblemPosed,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
    Timed,
    Traced,
)
from replay.rerun import viewer as rerun_viewer
from replay.rerun.rerun_recorder import RerunRecorder
from replay.rerun.scene import LEVELS, cost_levels
from tests.tools.rrd_rows import (
    Row,
    at_probe,
    read,
    until_probe,
)

WORKSPACE = Workspace((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
MESH = trimesh.creation.box(extents=(0.1, 0.2, 0.3))
SDF = SdfGrid.from_mesh(MESH, 0.05)
INITIAL = KnownPoints(free=np.array([[0.4, 0.4, 0.4]]))
TRUTH = compose(np.eye(3), np.array([0.1, 0.0, 0.0]))
MESH_ENTITIES = [
    "/scene/hypotheses/best",
    *(f"/scene/hypotheses/cost_step_{n + 1}" for n in range(LEVELS)),
]


def started(world_from_object: np.ndarray | None = TRUTH) -> SessionStarted:
    return SessionStarted(
        runner="probe",
        object="box",
        session="simulated",
        method="chsel",
        seed=3,
        config={"preset": {"name": "paper"}, "method": {"qd": {"bins": [40, 40]}}},
        mesh=MESH,
        sdf=SDF,
        workspace=WORKSPACE,
        free_resolution=0.025,
        initial_points=INITIAL,
        world_from_object=world_from_object,
    )


def probe(step: int) -> Probe:
    rng = np.random.default_rng(step)
    contacts = rng.uniform(-0.1, 0.1, (1 + step, 3))
    positions = np.linspace([-0.4, 0.0, 0.0], [-0.1, 0.0, 0.01 * step], 5)
    path = compose(np.tile(np.eye(3), (5, 1, 1)), positions)
    return Probe(
        step,
        "contact",
        KnownPoints(
            free=rng.uniform(-0.4, 0.4, (10 + step, 3)),
            occupied=rng.uniform(-0.4, 0.4, (2, 3)),
            known=np.concatenate([contacts, rng.uniform(-0.4, 0.4, (3, 3))]),
            known_sdf=np.concatenate([np.zeros(len(contacts)), np.full(3, 0.02)]),
        ),
        gripper_path=path,
        contacts=contacts,
        contact_normals=np.tile([1.0, 0.0, 0.0], (len(contacts), 1)),
    )


def snapshot(
    iteration: int, shape: tuple[int, ...] = (4, 3), refinement: int = 0
) -> ArchiveSnapshot:
    cells = np.arange(iteration + 2)
    names = ("x [m]", "y [m]", "z [m]")[: len(shape)]
    zeros = np.zeros((len(cells), 9))
    return ArchiveSnapshot(
        iteration,
        refinement,
        names,
        shape,
        np.full(len(shape), -0.3),
        np.full(len(shape), 0.3),
        cells,
        zeros,
        -1.0 - np.arange(len(cells), dtype=np.float64),
        np.zeros((len(cells), len(shape))),
    )


def hypotheses(count: int = 6, archive: ArchiveSnapshot | None = None) -> Hypotheses:
    rng = np.random.default_rng(count)
    poses = compose(random_rotations(rng, count), rng.uniform(-0.2, 0.2, (count, 3)))
    duplicate = np.arange(count) % 4 == 2
    cell = np.full(count, -1) if archive is None else np.arange(count) % len(archive.cells)
    cost = 1.5 * np.arange(1, count + 1, dtype=np.float64) ** 2
    return Hypotheses(poses, cost, duplicate, cell, poses, archive)


def registration(
    step: int, *, shape: tuple[int, ...] | None = (4, 3), count: int = 6
) -> Iterator[Event]:
    problem = RegistrationProblem(
        SDF, INITIAL, np.eye(4)[None], WORKSPACE, 0.025, StreamKey(3, step)
    )
    yield ProblemPosed(step, problem)
    yield Traced(step, "gradient_descent", 0, "0", 2.0, 3.0, 900.0)
    yield Traced(step, "gradient_descent", 50, "0", 1.0, 2.0, 90.0 + step)
    last = None
    for iteration in (0, 5):
        if shape is None:
            break
        last = snapshot(iteration, shape)
        yield SnapshotTaken(step, last)
        yield Traced(step, "quality_diversity", iteration, "0", 0.5, 1.0, 2.0)
    yield HypothesesFound(step, hypotheses(count, last))
    errors = {
        "best_position_error": 0.01 * (step + 1),
        "best_rotation_error": 0.5 * (step + 1),
    }
    yield Measured(step, {**errors, "coverage_mm2": 4.0, "set_spread": 0.003})
    yield Timed(step, {"gradient_descent": 0.25})
    yield Logged(step, "warning", f"line {step}")


def session(count: int = 3) -> list[Event]:
    events: list[Event] = [started()]
    for step in range(count):
        events += [probe(step), *registration(step)]
    return [*events, SessionEnded(count - 1, "finished")]


def write(path: Path, events: Iterable[Event]) -> Path:
    recorder = RerunRecorder(path)
    for event in events:
        recorder.record(event)
    recorder.close()
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write(tmp_path_factory.mktemp("rerun") / "recording.rrd", session())


@pytest.fixture(scope="module")
def rows(recording):
    return read(recording)


def test_contacts_and_points_are_those_of_the_probe(rows):
    for step in range(3):
        points = probe(step).new_points
        expected = {
            "free": points.free,
            "free/new": points.free,
            "occupied": points.occupied,
            "known": points.known[points.sdf != 0.0],
            "contacts": points.contacts,
            "contacts/new": probe(step).contacts,
        }
        for name, positions in expected.items():
            shown = at_probe(rows[f"/scene/{name}"], step)[-1]["Points3D:positions"]
            np.testing.assert_array_equal(
                np.array(shown, dtype=np.float32), positions.astype(np.float32)
            )


def test_normals_are_arrows_at_the_contacts_that_have_one(tmp_path):
    normals = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    event = dataclasses.replace(probe(1), contact_normals=normals)
    arrows = read(write(tmp_path / "a.rrd", [started(), event]))["/scene/contacts/normals"][-1][1]
    np.testing.assert_array_equal(
        np.array(arrows["Arrows3D:origins"], dtype=np.float32),
        event.contacts[1:].astype(np.float32),
    )
    np.testing.assert_allclose(
        arrows["Arrows3D:vectors"], [[0.0, 0.0, 0.035 * np.sqrt(3.0)]], rtol=1e-6
    )


def test_the_object_stands_at_its_true_pose(rows):
    values = {name: value for _, row in rows["/scene/object"] for name, value in row.items()}
    np.testing.assert_allclose(values["Transform3D:translation"], [[0.1, 0.0, 0.0]], rtol=1e-6)
    assert len(values["Mesh3D:triangle_indices"]) == len(MESH.faces)


def shown_hypotheses(rows: dict[str, list[Row]], step: int) -> dict[float, tuple[np.ndarray, str]]:
    """Pose and entity of each hypothesis drawn at a probe, by cost."""
    found: dict[float, tuple[np.ndarray, str]] = {}
    for entity in MESH_ENTITIES:
        row = until_probe(rows[entity], step)[-1]
        translations = row["InstancePoses3D:translations"]
        for cost, where, turn in zip(
            row["cost"], translations, row["InstancePoses3D:mat3x3"], strict=True
        ):
            if not np.isnan(cost):
                columns = np.reshape(turn, (3, 3)).T  # stored column by column
                found[cost] = (compose(columns, np.array(where)), entity)
    return found


def test_every_distinct_hypothesis_is_drawn_once_at_its_pose(rows):
    expected = hypotheses(6, snapshot(5))
    distinct = np.flatnonzero(~expected.duplicate)
    for step in range(3):
        shown = shown_hypotheses(rows, step)
        assert sorted(shown) == expected.cost[distinct].tolist()
        for index in distinct:
            pose, _ = shown[float(expected.cost[index])]
            world_from_object = inverse(expected.object_from_world[index])
            np.testing.assert_allclose(pose, world_from_object, atol=1e-6)


def images(rows: list[Row], step: int, dtype: type, channels: int) -> list[np.ndarray]:
    """The pictures of a probe, each in the format that was given last."""
    found, shape = [], (0, 0)
    for times, row in rows:
        for layout in row.get("Image:format", ()):
            shape = layout["height"], layout["width"]
        for pixels in row.get("Image:buffer", ()):
            if times["probe"] == step:
                array: np.ndarray = np.array(pixels, dtype=np.uint8).view(dtype)
                found.append(array.reshape(*shape, channels))
    return found


def test_the_archive_shows_the_cost_of_each_cell_and_marks_empty_ones(rows):
    first, last = images(rows["/archive/cost"], 1, np.float32, 1)
    costs = first[..., 0]  # cells 0 and 1 of 4 x 3: first column, from below
    expected = np.full((3, 4), np.nan)
    expected[2, 0], expected[1, 0] = 1.0, 2.0
    np.testing.assert_array_equal(costs, expected)
    assert np.isfinite(last).sum() == 7
    colors = images(rows["/archive/colors"], 1, np.uint8, 3)[-1]
    empty = np.isnan(last[..., 0])
    assert len(np.unique(colors[empty], axis=0)) == 1
    assert len(np.unique(colors[~empty], axis=0)) == 7


def test_hypotheses_are_marked_in_their_cells(rows):
    marks = at_probe(rows["/archive/hypotheses"], 0)[-1]
    np.testing.assert_allclose(  # cells 0, 1, 3, 4, 5 of 4 x 3, y down
        marks["Points2D:positions"], [(0.5, 2.5), (0.5, 1.5), (1.5, 2.5), (1.5, 1.5), (1.5, 0.5)]
    )
    assert marks["Points2D:labels"][:2] == ["cost 1.5", "cost 6"]


def test_iterations_run_on_over_stages_and_registrations(rows):
    drawn = [times for times, values in rows["/archive/cost"] if "Image:buffer" in values]
    times = [(times["probe"], times["iteration"]) for times in drawn]
    assert times == [(0, 51), (0, 56), (1, 107), (1, 112), (2, 163), (2, 168)]


def test_costs_of_the_search_are_on_the_timeline_of_iterations_alone(rows):
    series = [
        (times, values["Scalars:scalars"][0])
        for times, values in rows["/search/highest"]
        if "Scalars:scalars" in values
    ]
    assert [set(times) for times, _ in series] == [{"iteration"}] * 12
    assert [value for _, value in series[:5]] == [900.0, 90.0, 2.0, 2.0, 900.0]


@pytest.mark.parametrize(
    ("entity", "expected"),
    [
        ("/cost/lowest", [1.5] * 3),
        ("/cost/median", [18.75] * 3),
        ("/cost/highest", [54.0] * 3),
        ("/distinct/hypotheses", [5.0] * 3),
        ("/error/position/best", [10.0, 20.0, 30.0]),
        ("/error/rotation/best", [0.5 * n * 180.0 / np.pi for n in (1, 2, 3)]),
        ("/measured/coverage_mm2", [4.0] * 3),
        ("/trust/set_spread", [3.0] * 3),
        ("/seconds/gradient_descent", [0.25] * 3),
    ],
)
def test_numbers_of_a_step_stand_at_its_probe(rows, entity, expected):
    series = {
        times["probe"]: values["Scalars:scalars"]
        for times, values in rows[entity]
        if "Scalars:scalars" in values
    }
    assert series == {step: [pytest.approx(value)] for step, value in enumerate(expected)}


def test_of_cells_over_a_third_measure_the_lowest_cost_is_shown(tmp_path):
    events = [started(), probe(0), *registration(0, shape=(4, 3, 2))]
    rows = read(write(tmp_path / "a.rrd", events))
    costs = images(rows["/archive/cost"], 0, np.float32, 1)[-1][..., 0]
    assert costs[2, 0] == 1.0  # cells 0 and 1, of costs 1 and 2
    assert costs[1, 0] == 3.0


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(RecordingError, match=r"cannot be written .*accepted: a new \.rrd file"):
        RerunRecorder(tmp_path)


def test_without_a_viewer_the_live_view_is_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr(rerun_viewer, "is_listening", lambda port: False)
    monkeypatch.setattr(rerun_viewer, "has_screen", lambda: True)
    monkeypatch.setattr(rerun_viewer, "viewer_program", lambda: tmp_path / "no_viewer")
    with pytest.warns(
        UserWarning, match=r"no live view: .*no_viewer cannot be started \(No such file"
    ):
        recorder = RerunRecorder(tmp_path / "a.rrd", live=True)
    recorder.record(started())
    recorder.close()
    assert "/scene/workspace" in read(tmp_path / "a.rrd")


def test_places_on_the_scale_are_logarithmic():
    scale = CostScale.of([100.0, 1.0, 7.0, np.nan])
    np.testing.assert_allclose(scale.fraction([1.0, 10.0, 100.0, 500.0]), [0.0, 0.5, 1.0, 1.0])


def test_steps_of_cost_run_from_the_lowest_to_the_highest():
    assert cost_levels(np.array([1.0, 16.0, 256.0])).tolist() == [0, LEVELS // 2, LEVELS - 1]
    assert cost_levels(np.array([2.0, 2.0])).tolist() == [0, 0]
    assert cost_levels(np.zeros(0)).tolist() == []
