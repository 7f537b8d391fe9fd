"""What viewers draw of a recording without our help."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from rerun.chunk import McapReader
from scipy.spatial.transform import Rotation

import replay
from chsel.problem.points import KnownPoints
from chsel.problem.poses import compose, inverse, rotation_matrices
from replay.events import Event, HypothesesFound, Probe, SessionStarted
from replay.mcap.foxglove_messages import FOXGLOVE, POINT_CLASSES, SCENE, VIEWS
from replay.mcap.reader import read_recording
from replay.mcap.schemas import MESSAGES, RECORDS, STEP_TIME
from replay.mcap.viewer_messages import CumulativePoints, poses_in_world, simple_mesh
from replay.mcap.writer import McapRecorder
from replay.verbs.diff import recording_diff

_ADD = McapRecorder._add
LAYOUT = Path(replay.__file__).parent / "foxglove_layout.json"


def messages(path: Path, *topics: str) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages(topics or None)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in found]


def last_found(events: list[Event]) -> Any:
    return [event.hypotheses for event in events if isinstance(event, HypothesesFound)][-1]


def positions(cloud: bytes) -> np.ndarray:
    """What a viewer reads: x, y, z where the fields say that they are."""
    parsed = PointCloud.FromString(cloud)
    assert [field.name for field in parsed.fields[:3]] == ["x", "y", "z"]
    rows = np.frombuffer(parsed.data, np.uint8).reshape(-1, parsed.point_stride)
    return np.ascontiguousarray(rows[:, :12]).view("<f4")


def placed(mesh: Any) -> np.ndarray:
    """The points of a mesh of a scene, moved by its pose."""
    p, q = mesh.pose.position, mesh.pose.orientation
    rotation = rotation_matrices(np.array([[q.x, q.y, q.z, q.w]]))[0]
    points = np.array([(point.x, point.y, point.z) for point in mesh.points])
    return points @ rotation.T + (p.x, p.y, p.z)


def quaternions(world_from_body: np.ndarray) -> np.ndarray:
    """What a viewer gets of poses, at a time of 3 s and 7 ns."""
    message = PosesInFrame.FromString(poses_in_world(world_from_body, 3_000_000_007))
    assert (message.timestamp.seconds, message.timestamp.nanos) == (3, 7)
    turned = (pose.orientation for pose in message.poses)
    return np.array([(q.x, q.y, q.z, q.w) for q in turned])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("angle", [0.0, np.pi / 2, np.pi, 3.0, 1e-9])
def test_a_turn_about_an_axis_has_the_textbook_quaternion(axis: int, angle: float) -> None:
    vector = np.zeros(3)
    vector[axis] = angle
    rotation = Rotation.from_rotvec(vector).as_matrix()
    quaternion = quaternions(compose(rotation[None], np.zeros((1, 3))))[0]
    expected = np.zeros(4)
    expected[axis], expected[3] = np.sin(angle / 2), np.cos(angle / 2)
    quaternion *= np.sign(quaternion @ expected)
    np.testing.assert_allclose(quaternion, expected, atol=1e-15)


def test_quaternions_of_random_rotations_turn_vectors_alike() -> None:
    rotations = Rotation.random(500, random_state=1).as_matrix()
    found = quaternions(compose(rotations, np.ones((500, 3))))
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), rotations, atol=1e-14)


def test_a_scene_holds_the_object_at_each_distinct_hypothesis(events, write):
    data = messages(write(events), "/hypothesis_meshes")[-1][2]
    scene = SceneUpdate.FromString(data)
    assert scene.SerializeToString(deterministic=True) == data  # put together of bytes
    (entity,) = scene.entities
    found = last_found(events)
    poses = inverse(found.object_from_world[~found.duplicate])
    assert len(entity.triangles) == len(poses) == 3
    box = events[0].mesh
    for mesh, pose in zip(entity.triangles, poses, strict=True):
        expected = box.vertices @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(placed(mesh), expected, atol=1e-12)
        assert list(mesh.indices) == box.faces.ravel().tolist()
    opacities = [mesh.color.a for mesh in entity.triangles]
    assert opacities[0] > 0.5 > max(opacities[1:])
    assert (entity.frame_id, entity.lifetime.seconds) == ("world", 0)


def test_the_surfaces_of_hypotheses_are_the_same_as_points(events, write):
    path = write(events)
    (entity,) = SceneUpdate.FromString(messages(path, "/hypothesis_meshes")[-1][2]).entities
    expected = np.concatenate([placed(mesh) for mesh in entity.triangles])
    found = positions(messages(path, "/hypothesis_surfaces")[-1][2])
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_object_is_drawn_where_its_frame_is(events, write):
    path = write(events)
    (entity,) = SceneUpdate.FromString(messages(path, "/object_mesh")[0][2]).entities
    assert entity.frame_id == "object"
    np.testing.assert_allclose(placed(entity.triangles[0]), events[0].mesh.vertices, atol=1e-12)
    cloud = messages(path, "/object_surface")[0][2]
    assert PointCloud.FromString(cloud).frame_id == "object"
    np.testing.assert_allclose(positions(cloud), events[0].mesh.vertices, atol=1e-7)
    unknown = [dataclasses.replace(events[0], world_from_object=None)]
    assert not messages(write(unknown), "/object_mesh", "/object_surface")


def test_poses_that_are_not_finite_are_not_drawn(events, write):
    found = last_found(events)
    poses, cost = found.object_from_world.copy(), found.cost.copy()
    poses[-2], cost[-2:] = np.nan, np.inf
    diverged = dataclasses.replace(found, object_from_world=poses, cost=cost)
    changed = [
        dataclasses.replace(event, hypotheses=diverged)
        if isinstance(event, HypothesesFound) and event.hypotheses is found
        else event
        for event in events
    ]
    path = write(changed)
    (entity,) = SceneUpdate.FromString(messages(path, "/hypothesis_meshes")[-1][2]).entities
    assert len(entity.triangles) == 2
    assert np.isfinite(positions(messages(path, "/hypothesis_surfaces")[-1][2])).all()


def test_the_last_clouds_of_all_topics_hold_all_points_known_at_that_time(make_events, write):
    events = make_events(steps=12, free=5)
    path = write(events)
    known = events[0].initial_points
    clouds = messages(path, *(topic for topic in VIEWS if topic.startswith("/all_points/")))
    for probe in (event for event in events if isinstance(event, Probe)):
        known = known.merged(probe.new_points)
        before = [cloud for cloud in clouds if cloud[1] < (probe.step + 2) * STEP_TIME]
        last = {topic: positions(data) for topic, _, data in before}
        for kind in POINT_CLASSES:
            shown = np.concatenate([last[f"/all_points/{kind}/{n}"] for n in (3, 2, 1, 0)])
            assert shown.tobytes() == getattr(known, kind).astype("<f4").tobytes()


def test_all_points_of_a_long_session_are_written_a_few_times_each():
    cumulative = CumulativePoints()
    shown: dict[int, np.ndarray] = {}
    written, steps = 0, 4000
    for step in range(steps):
        changed = cumulative.add(np.full((1, 3), float(step)))
        shown |= changed
        written += sum(map(len, changed.values()))
    newest_last = np.concatenate([shown[level] for level in sorted(shown, reverse=True)])
    assert newest_last[:, 0].tolist() == list(range(steps))
    assert written < 17 * steps  # all of them at each step: 2000 times each


@pytest.mark.parametrize("subdivisions", [1, 4])
def test_a_simple_mesh_has_few_faces_and_the_same_shape(subdivisions):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.1)
    vertices, faces = simple_mesh(ball)
    assert len(faces) <= min(400, len(ball.faces))
    found = trimesh.Trimesh(vertices, faces, process=False)
    assert np.linalg.norm(found.vertices, axis=1).min() > 0.09
    assert found.volume == pytest.approx(ball.volume, rel=0.1)  # faces still point outwards


def test_a_mesh_of_loose_vertices_and_points_in_one_place_stays_small():
    loose = trimesh.Trimesh(
        np.concatenate([np.eye(3), np.zeros((5000, 3))]), [[0, 1, 2]] * 900, process=False
    )
    vertices, faces = simple_mesh(loose)
    assert (len(vertices), len(faces)) == (3, 1)
    point = trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]] * 900, process=False)
    assert len(simple_mesh(point)[1]) == 0


def test_rerun_draws_points_of_the_recording_by_itself(events, write):
    path = write(events)
    drawn: dict[str, list[np.ndarray]] = {}
    for chunk in McapReader(path).stream():
        batch = chunk.to_record_batch()
        if "Points3D:positions" in batch.schema.names:
            assert "Points3D:colors" in batch.schema.names or chunk.entity_path.startswith(
                "/points"
            )
            for row in batch.column("Points3D:positions").to_pylist():
                drawn.setdefault(chunk.entity_path, []).append(np.array(row).reshape(-1, 3))
    surfaces = positions(messages(path, "/hypothesis_surfaces")[-1][2])
    assert drawn["/hypothesis_surfaces"][-1].tolist() == surfaces.tolist()
    assert len(drawn["/object_surface"][-1]) == 8
    known = events[0].initial_points
    for probe in (event for event in events if isinstance(event, Probe)):
        known = known.merged(probe.new_points)
    levels = [drawn[f"/all_points/free/{level}"][-1] for level in (3, 2, 1, 0)]
    assert np.concatenate(levels).tolist() == known.free.astype("f4").tolist()


def test_readers_do_not_look_at_what_viewers_get(events, write, assert_same, monkeypatch):
    monkeypatch.setattr(
        "replay.mcap.writer.McapRecorder._add", _with_nonsense_for_viewers, raising=True
    )
    path = write(events)
    monkeypatch.undo()
    assert {data for topic, _, data in messages(path) if topic in SCENE} == {b"\xff"}
    assert_same(read_recording(path).events(), events)
    assert not recording_diff(path, write(events)).differences


def _with_nonsense_for_viewers(self: Any, topic: str, step: int, make: Any) -> None:
    _ADD(self, topic, step, (lambda time: b"\xff") if topic in SCENE else make)


class TestLayout:
    """The layout for Foxglove shows topics and fields that recordings have."""

    layout = json.loads(LAYOUT.read_text())

    def test_its_panels_are_those_that_it_configures(self) -> None:
        def panels(node: Any) -> list[str]:
            return (
                [node] if isinstance(node, str) else panels(node["first"]) + panels(node["second"])
            )

        assert sorted(panels(self.layout["layout"])) == sorted(self.layout["configById"])
        kinds = {name.partition("!")[0] for name in self.layout["configById"]}
        assert kinds == {"3D", "Plot", "RosOut"}  # Foxglove's name of the panel of log lines

    def test_its_scene_has_every_topic_of_a_viewer(self) -> None:
        topics = self.layout["configById"]["3D!scene"]["topics"]
        drawn = {name for name in FOXGLOVE if name not in ("/log", "/object_pose")}
        assert set(topics) == drawn
        shown = {name for name, settings in topics.items() if settings["visible"]}
        all_points = {name for name in VIEWS if name.startswith("/all_points/")}
        drawn_at_first = {"/hypothesis_meshes", "/object_mesh", "/gripper_path", "/next_probe"}
        assert shown == {*drawn_at_first, *all_points}

    def test_its_curves_are_of_fields_that_are_recorded(self) -> None:
        values = [
            path["value"]
            for name, panel in self.layout["configById"].items()
            if name.startswith("Plot!")
            for path in panel["paths"]
        ]
        assert len(values) == 5
        for value in values:
            topic, field = value.split(".")[:2]
            assert field.split("[")[0] in MESSAGES[RECORDS[topic]]

    def test_its_log_is_that_of_the_recording(self) -> None:
        assert self.layout["configById"]["RosOut!log"]["topicToRender"] in FOXGLOVE


def test_the_start_of_a_session_without_points_has_clouds_that_are_empty(events, write):
    start = dataclasses.replace(events[0], initial_points=KnownPoints())
    assert isinstance(start, SessionStarted)
    topics = {topic for topic, _, data in messages(write([start])) if topic in VIEWS}
    clouds = {name for name, kind in VIEWS.items() if kind is PointCloud}
    assert clouds <= topics
