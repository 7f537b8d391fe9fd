"""The Rerun recording of a robot's session, read back with Rerun's own reader."""

import dataclasses

import numpy as np
import pytest
import trimesh

from chsel.events import (
    Believed,
    HypothesesFound,
    Measured,
    Probe,
    ProblemPosed,
    RigDescribed,
    SensorImage,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
    Timed,
    Traced,
)
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import compose, inverse, random_rotations
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from replay.colors import CostScale
from replay.rerun import viewer as rerun_viewer
from replay.rerun.rerun_recorder import RerunRecorder
from replay.rerun.scene import LEVELS, cost_levels
from replay.rerun.text import verdict_markdown
from tests.tools.rrd_rows import at_probe, read, shown_at

WORKSPACE = Workspace((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
MESH = trimesh.creation.box(extents=(0.1, 0.2, 0.3))
SDF = SdfGrid.from_mesh(MESH, 0.05)
INITIAL = KnownPoints(free=np.array([[0.4, 0.4, 0.4]]))
TRUTH = compose(np.eye(3), np.array([0.1, 0.0, 0.0]))
ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # its last column
HAND = trimesh.creation.box((0.1, 0.08, 0.06))
CAMERA = compose(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.2, 0.9]))
INTRINSICS = np.array([8.0, 9.0, 2.5, 1.5])


def started(world_from_object=TRUTH):
    return SessionStarted(
        runner="probe",
        object="box",
        session="simulated",
        method="chsel",
        seed=3,
        config={"preset": {"name": "paper"}},
        mesh=MESH,
        sdf=SDF,
        workspace=WORKSPACE,
        free_resolution=0.025,
        initial_points=INITIAL,
        world_from_object=world_from_object,
    )


def probe(step):
    rng = np.random.default_rng(step)
    contacts = rng.uniform(-0.1, 0.1, (1 + step, 3))
    ways = [[-0.4, 0.0, 0.0], [-0.2, 0.9, 0.0], [-0.1, 0.0, 0.01 * step], [-0.3, 0.0, 0.0]]
    points = KnownPoints(
        free=rng.uniform(-0.4, 0.4, (10 + step, 3)),
        occupied=rng.uniform(-0.4, 0.4, (2, 3)),
        known=np.concatenate([contacts, rng.uniform(-0.4, 0.4, (3, 3))]),
        known_sdf=np.concatenate([np.zeros(len(contacts)), np.full(3, 0.02)]),
    )
    path = compose(np.tile(ALONG_X, (4, 1, 1)), np.array(ways))
    normals = np.outer(np.arange(1 + step) > 0, [1.0, 0.0, 0.0])  # that of the first is unknown
    return Probe(
        step,
        "contact",
        new_points=points,
        gripper_path=path,
        contacts=contacts,
        contact_normals=normals,
    )


def snapshot(iteration, shape=(4, 3)):
    cells = np.arange(iteration + 2)
    axes = len(shape)
    return ArchiveSnapshot(
        iteration,
        0,
        measure_names=("x [m]", "y [m]", "z [m]")[:axes],
        shape=shape,
        lower=np.full(axes, -0.3),
        upper=np.full(axes, 0.3),
        cells=cells,
        solutions=np.zeros((len(cells), 9)),
        objectives=-1.0 - np.arange(len(cells), dtype=np.float64),
        measures=np.zeros((len(cells), axes)),
    )


def hypotheses(archive):
    rng = np.random.default_rng(6)
    count = 6
    poses = compose(random_rotations(rng, count), rng.uniform(-0.2, 0.2, (count, 3)))
    cost = 1.5 * np.arange(1, count + 1, dtype=np.float64) ** 2
    return Hypotheses(
        poses,
        cost,
        duplicate=np.arange(count) % 4 == 2,
        cell=np.arange(count),
        elites=poses,
        archive=archive,
    )


def registration(step, *, shape=(4, 3)):
    problem = RegistrationProblem(
        sdf=SDF,
        points=INITIAL,
        initial_set=np.eye(4)[None],
        workspace=WORKSPACE,
        free_resolution=0.025,
        key=StreamKey(3, step),
    )
    yield ProblemPosed(step, problem)
    yield Traced(
        step,
        "gradient_descent",
        iteration=0,
        digest="0",
        lowest_cost=2.0,
        median_cost=3.0,
        highest_cost=900.0,
    )
    yield Traced(
        step,
        "gradient_descent",
        iteration=50,
        digest="0",
        lowest_cost=1.0,
        median_cost=2.0,
        highest_cost=90.0 + step,
    )
    for iteration in (0, 5):
        yield SnapshotTaken(step, snapshot(iteration, shape))
        yield Traced(
            step,
            "quality_diversity",
            iteration=iteration,
            digest="0",
            lowest_cost=0.5,
            median_cost=1.0,
            highest_cost=2.0,
        )
    yield HypothesesFound(step, hypotheses(snapshot(5, shape)))
    errors = {"best_position_error": 0.01 * (step + 1), "best_rotation_error": 0.5 * (step + 1)}
    yield Measured(step, {**errors, "coverage_mm2": 4.0, "set_spread": 0.003})
    yield Timed(step, {"gradient_descent": 0.25})


def depth(step, *, height=4, width=6):
    values = np.arange(height * width, dtype=np.uint16).reshape(height, width) * 50
    return SensorImage(
        step=step,
        sensor="camera",
        kind="depth",
        values=values,
        unit=0.001,
        mask=values > 200,
        intrinsics=INTRINSICS,
        world_from_camera=CAMERA,
    )


def touch(step, pixels):
    values = np.zeros((3, 5), dtype=np.uint16)
    values.flat[:pixels] = 60
    return SensorImage(
        step=step,
        sensor="pad_1",
        kind="deformation",
        values=values,
        unit=0.0001,
        mask=values > 40,
        intrinsics=INTRINSICS,
        world_from_camera=CAMERA,
    )


def session():
    """Three probes, with two images of a camera before each; the pad tells nothing of the last."""
    yield started()
    yield RigDescribed(-1, "cabinet", source="0a1b", hand=HAND)
    for step in range(3):
        yield from (depth(step), dataclasses.replace(depth(step), unit=0.002))
        yield from (touch(step, pixels) for pixels in (1, 7, 4) if step < 2)
        yield probe(step)
        yield from registration(step)
    yield SessionEnded(2, "finished")


def write(path, events):
    recorder = RerunRecorder(path)
    for event in events:
        recorder.record(event)
    recorder.close()
    return path


def shown_poses(rows, root, *, step):
    """The poses (4, 4) at which hypotheses are shown at a probe, by their costs."""
    poses: dict[float, np.ndarray] = {}
    for entity in ("best", *(f"cost_step_{level + 1}" for level in range(LEVELS))):
        row = shown_at(rows[f"{root}/{entity}"], step)
        for cost, where, turn in zip(
            row["cost"],
            row["InstancePoses3D:translations"],
            row["InstancePoses3D:mat3x3"],
            strict=True,
        ):
            if not np.isnan(cost):  # turn: column by column
                poses[cost] = compose(np.reshape(turn, (3, 3)).T, np.array(where))
    return poses


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    return read(write(tmp_path_factory.mktemp("rerun") / "recording.rrd", session()))


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
            np.testing.assert_array_equal(np.float32(shown), np.float32(positions))


def test_normals_are_arrows_at_the_contacts_that_have_one_and_the_object_is_at_its_pose(rows):
    arrows = at_probe(rows["/scene/contacts/normals"], 2)[-1]
    np.testing.assert_allclose(arrows["Arrows3D:origins"], probe(2).contacts[1:], rtol=1e-6)
    length = 0.035 * np.sqrt(3.0)
    np.testing.assert_allclose(arrows["Arrows3D:vectors"], [[length, 0.0, 0.0]] * 2, rtol=1e-6)
    values = {name: value for _, row in rows["/scene/object"] for name, value in row.items()}
    np.testing.assert_allclose(values["Transform3D:translation"], [[0.1, 0.0, 0.0]], rtol=1e-6)
    assert len(values["Mesh3D:triangle_indices"]) == len(MESH.faces)


def test_every_distinct_hypothesis_is_drawn_once_at_its_pose(rows):
    expected = hypotheses(snapshot(5))
    distinct = np.flatnonzero(~expected.duplicate)
    for step in range(3):
        shown = shown_poses(rows, "/scene/hypotheses", step=step)
        assert sorted(shown) == expected.cost[distinct].tolist()
        for index in distinct:
            world_from_object = inverse(expected.object_from_world[index])
            pose = shown[float(expected.cost[index])]
            np.testing.assert_allclose(pose, world_from_object, atol=1e-6)


def images(rows, step, *, dtype, channels):
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
    first, last = images(rows["/archive/cost"], 1, dtype=np.float32, channels=1)
    expected = np.full((3, 4), np.nan)  # cells 0 and 1 of 4 x 3: first column, from below
    expected[2, 0], expected[1, 0] = 1.0, 2.0
    np.testing.assert_array_equal(first[..., 0], expected)
    assert np.isfinite(last).sum() == 7
    colors = images(rows["/archive/colors"], 1, dtype=np.uint8, channels=3)[-1]
    empty = np.isnan(last[..., 0])
    assert len(np.unique(colors[empty], axis=0)) == 1
    assert len(np.unique(colors[~empty], axis=0)) == 7


def test_of_cells_over_a_third_measure_the_lowest_cost_is_shown(tmp_path):
    events = [started(), probe(0), *registration(0, shape=(4, 3, 2))]
    rows = read(write(tmp_path / "a.rrd", events))
    costs = images(rows["/archive/cost"], 0, dtype=np.float32, channels=1)[-1][..., 0]
    assert costs[2, 0] == 1.0  # cells 0 and 1, of costs 1 and 2
    assert costs[1, 0] == 3.0


def test_modes_are_ellipsoids_of_two_deviations_and_their_weights_are_in_the_result(tmp_path):
    covariance = np.zeros((2, 6, 6))
    covariance[0, :3, :3] = np.diag([0.04, 0.01, 0.09]) ** 2
    weights = np.array([0.75, 0.25])
    centres = np.array([[0.1, 0.0, 0.2], [0.0, 0.3, 0.1]])
    poses = np.stack([np.eye(4)] * 2)
    believed = Believed(
        0,
        np.array([5, 2]),
        weights=weights,
        object_from_world=poses,
        centres=centres,
        covariances=covariance,
        spread=0.1,
    )
    drawn = read(write(tmp_path / "a.rrd", [started(), probe(0), *registration(0), believed]))
    modes = shown_at(drawn["/scene/modes"], 0)
    np.testing.assert_allclose(modes["Ellipsoids3D:centers"], centres, atol=1e-7)
    half_sizes = [[0.02, 0.08, 0.18], [5e-4] * 3]
    np.testing.assert_allclose(modes["Ellipsoids3D:half_sizes"], half_sizes, rtol=1e-6)
    (text,) = shown_at(drawn["/result"], 0)["TextDocument:text"]
    assert "mode 5: 75 %, mode 2: 25 %" in text


def test_numbers_of_a_step_stand_at_its_probe(rows):
    for entity, expected in {
        "/cost/lowest": [1.5] * 3,
        "/cost/median": [18.75] * 3,
        "/cost/highest": [54.0] * 3,
        "/distinct/hypotheses": [5.0] * 3,
        "/error/position/best": [10.0, 20.0, 30.0],
        "/error/rotation/best": [0.5 * n * 180.0 / np.pi for n in (1, 2, 3)],
        "/measured/coverage_mm2": [4.0] * 3,
        "/trust/set_spread": [3.0] * 3,
        "/seconds/gradient_descent": [0.25] * 3,
    }.items():
        series = {
            times["probe"]: values["Scalars:scalars"]
            for times, values in rows[entity]
            if "Scalars:scalars" in values
        }
        assert series == {step: [pytest.approx(value)] for step, value in enumerate(expected)}


def test_the_hand_is_drawn_where_the_probe_is_deepest(rows):
    for step in range(3):
        shown = shown_at(rows["/scene/hand"], step)
        np.testing.assert_allclose(
            shown["InstancePoses3D:translations"], [[-0.1, 0.0, 0.01 * step]], rtol=1e-6
        )
    assert not np.any(at_probe(rows["/scene/hand"], 0)[0]["InstancePoses3D:mat3x3"])
    mesh = next(values for _, values in rows["/scene/hand"] if "Mesh3D:vertex_positions" in values)
    np.testing.assert_allclose(np.max(mesh["Mesh3D:vertex_positions"], axis=0), [0.05, 0.04, 0.03])


def test_a_camera_stands_at_its_pose_and_sees_what_it_measured(rows):
    camera = at_probe(rows["/scene/cameras/camera"], 1)[-1]
    np.testing.assert_allclose(camera["Transform3D:translation"], [[0.1, 0.2, 0.9]], rtol=1e-6)
    np.testing.assert_allclose(
        np.reshape(camera["Pinhole:image_from_camera"], (3, 3)).T,
        [[8.0, 0.0, 2.5], [0.0, 9.0, 1.5], [0.0, 0.0, 1.0]],
    )
    seen = at_probe(rows["/scene/cameras/camera/depth"], 1)[-1]
    (buffer,) = seen["DepthImage:buffer"]
    assert bytes(buffer) == depth(1).values.tobytes()
    assert seen["DepthImage:meter"] == [500.0]  # of the last image, of 2 mm a unit


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


def test_the_scale_of_costs_is_logarithmic_from_the_lowest_to_the_highest():
    scale = CostScale.of([100.0, 1.0, 7.0, np.nan])
    np.testing.assert_allclose(scale.fraction([1.0, 10.0, 100.0, 500.0]), [0.0, 0.5, 1.0, 1.0])
    assert cost_levels(np.array([1.0, 16.0, 256.0])).tolist() == [0, LEVELS // 2, LEVELS - 1]
    assert cost_levels(np.array([2.0, 2.0])).tolist() == [0, 0]
    assert cost_levels(np.zeros(0)).tolist() == []


def test_the_verdict_has_its_limit_and_bound_where_they_are_recorded():
    values = {"estimated_noise": 5e-4, "outlier_share": 0.08 / 13.0, "misfit": 0.3, "modes": 1.0}
    values |= {"set_spread": 0.0014, "verdict": 0.0}
    numbers = "noise 0.5 mm, misfit 0.3 noise levels"
    earlier = f"# determined\n\n1 mode, spread 1.4 mm, {numbers}\n"
    assert verdict_markdown(values, known=9) == earlier
    values |= {"spread_limit": 0.0049, "centre_within": 0.00281, "turn_within": 0.06}
    now = f"# determined\n\n1 mode, spread 1.4 of 4.9 mm, {numbers}, centre within 2.9 mm, 4°\n"
    assert verdict_markdown(values, known=9) == now
