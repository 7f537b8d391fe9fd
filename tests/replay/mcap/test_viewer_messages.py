"""What viewers draw of a recording without our help."""

import dataclasses

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader

from chsel.events import Believed, Decided, HypothesesFound, Probe
from chsel.problem.points import POINT_CLASSES
from chsel.problem.poses import axis_angle, inverse, rotation_matrices
from replay.mcap.foxglove_messages import VIEWS
from replay.mcap.schemas import STEP_TIME
from replay.mcap.viewer_messages import modes, next_probe
from tests.replay.conftest import example_events, nth


def messages(path, *topics):
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages(topics or None)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in found]


def positions(cloud):
    """What a viewer reads: x, y, z where the fields say that they are."""
    parsed = PointCloud.FromString(cloud)
    assert [field.name for field in parsed.fields[:3]] == ["x", "y", "z"]
    rows = np.frombuffer(parsed.data, np.uint8).reshape(-1, parsed.point_stride)
    return np.ascontiguousarray(rows[:, :12]).view("<f4")


def placed(mesh):
    """The points of a mesh of a scene, moved by its pose."""
    p, q = mesh.pose.position, mesh.pose.orientation
    rotation = rotation_matrices(np.array([[q.x, q.y, q.z, q.w]]))[0]
    points = np.array([(point.x, point.y, point.z) for point in mesh.points])
    return points @ rotation.T + (p.x, p.y, p.z)


def test_a_scene_holds_the_object_at_each_distinct_hypothesis(events, write):
    data = messages(write(events), "/hypothesis_meshes")[-1][2]
    scene = SceneUpdate.FromString(data)
    assert scene.SerializeToString(deterministic=True) == data  # put together of bytes
    (entity,) = scene.entities
    found = nth(events, HypothesesFound, number=-1).hypotheses
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


def test_the_last_clouds_of_all_topics_hold_all_points_known_at_that_time(write):
    events = example_events(steps=12, free=5)
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


def test_the_next_probe_is_an_arrow_from_start_to_end(steered_events):
    first, last = (nth(steered_events, Decided, number=number) for number in (0, -1))
    (entity,) = SceneUpdate.FromString(next_probe(first, 5)).entities
    (arrow,) = entity.arrows
    pose = first.problem.actions.world_from_hand[first.decision.chosen]
    position, q = arrow.pose.position, arrow.pose.orientation
    np.testing.assert_allclose([position.x, position.y, position.z], pose[:3, 3])
    along = rotation_matrices(np.array([[q.x, q.y, q.z, q.w]]))[0] @ [1.0, 0.0, 0.0]
    np.testing.assert_allclose(along, pose[:3, 2], atol=1e-12)
    length = first.problem.actions.length[first.decision.chosen]
    assert np.isclose(arrow.shaft_length + arrow.head_length, length)
    (entity,) = SceneUpdate.FromString(next_probe(last, 5)).entities
    assert len(entity.arrows) == 0


def test_modes_are_ellipsoids_of_two_standard_deviations():
    turn = axis_angle(np.array([0.0, 0.6, 0.8]), np.array(0.7))
    covariances = np.zeros((2, 6, 6))
    covariances[0, :3, :3] = turn @ np.diag([0.01, 0.02, 0.03]) ** 2 @ turn.T
    centres = np.array([[0.1, 0.2, 0.3], [0.0, 0.0, 0.5]])
    poses = np.stack([np.eye(4)] * 2)
    believed = Believed(
        3,
        np.array([4, 0]),
        weights=np.array([0.9, 0.1]),
        object_from_world=poses,
        centres=centres,
        covariances=covariances,
        spread=0.1,
    )
    (entity,) = SceneUpdate.FromString(modes(believed, 5)).entities
    first, second = entity.spheres
    size = first.size
    position = first.pose.position
    q = first.pose.orientation
    np.testing.assert_allclose([size.x, size.y, size.z], [0.04, 0.08, 0.12])
    np.testing.assert_allclose([position.x, position.y, position.z], centres[0])
    axes = rotation_matrices(np.array([[q.x, q.y, q.z, q.w]]))[0]
    np.testing.assert_allclose(np.abs(axes.T @ turn), np.eye(3), atol=1e-7)
    assert [second.size.x, second.size.y, second.size.z] == [0.001] * 3
    nothing = Believed(4, *(part[:0] for part in list(vars(believed).values())[1:6]), 0.1)
    (entity,) = SceneUpdate.FromString(modes(nothing, 6)).entities
    assert (entity.id, len(entity.spheres)) == ("modes", 0)  # in place of those before


def test_poses_and_the_true_pose_are_there_to_the_bit(events, write):
    path = write(events)
    found = nth(events, HypothesesFound, number=-1).hypotheses
    poses = PosesInFrame.FromString(messages(path, "/hypothesis_poses")[-1][2]).poses
    positions = [[pose.position.x, pose.position.y, pose.position.z] for pose in poses]
    assert positions == inverse(found.object_from_world)[:, :3, 3].tolist()
    truth = FrameTransform.FromString(messages(path, "/object_pose")[0][2])
    assert (truth.parent_frame_id, truth.child_frame_id) == ("world", "object")
    assert truth.translation.y == events[0].world_from_object[1, 3]
