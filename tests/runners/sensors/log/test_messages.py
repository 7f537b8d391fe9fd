"""Messages of both encodings become their content, or are counted as unusable."""

import struct
from collections import Counter

import numpy as np
import pytest

from chsel.errors import SettingError
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.log.decoding import packed_points
from runners.sensors.log.images import compressed_pixels, pixel_rows
from runners.sensors.log.messages import (
    CameraInfoMessage,
    CloudMessage,
    Content,
    ImageMessage,
    TransformMessage,
    UnusableMessage,
    WrenchMessage,
)
from runners.sensors.log.raw_log import RawLog
from runners.simulated_robot.log_writer import image, transform
from tests.runners.sensors.foxglove_log import in_foxgloves_messages
from tests.runners.sensors.small_logs import (
    BEGIN,
    SECOND,
    depth,
    png,
    ros2_cloud,
    ros2_sent,
    write_ros2,
    xyz,
)

TURNED = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])


def moved(x, y, z):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


CAMERA = PinholeCamera(5, 3, fx=400.0, fy=410.0, cx=2.0, cy=1.0)
CONTENTS: dict[str, Content] = {  # of step 3
    "/tf_static": TransformMessage("base", "camera", parent_from_child=moved(0, 0, 1), static=True),
    "/tf": TransformMessage("world", "base", parent_from_child=moved(3, 0, 0)),
    "/depth": ImageMessage("camera", depth(3)),
    "/compressed": ImageMessage("camera", depth(3)),
    "/quantised": ImageMessage("camera", (100.0 / (depth(3) + 20.0)).astype(np.float32)),
    "/info": CameraInfoMessage(CAMERA, rectified=CAMERA),
    "/pose": TransformMessage("base", "", parent_from_child=TURNED),
    "/poses": CloudMessage("base", np.array([[1.0, 2, 3], [1, 2, 3]])),
    "/point": CloudMessage("base", np.array([[1.0, 0, 2]])),
    "/wrench": WrenchMessage("hand", np.array([1.0, 2, -3]), torque=np.array([0.25, 0, 0.5])),
    "/joints": {"elbow": 0.5, "wrist": -0.25},
    "/cloud": CloudMessage("lidar", np.array([[0.0, 1, 2], [3, 4, 5]])),
    "/probe": "begin 3",
    "/touch": "False",
    "/count": "-3",
}
ROS2_ALONE = {"/quantised", "/wrench", "/touch", "/count"}


def by_topic(path):
    """The last message of each topic."""
    log = RawLog(path)
    received = {one.topic: one for one in log.messages(log.topics)}
    assert not log.faults
    assert not log.warnings
    return received


def assert_same(found, expected):
    assert type(found) is type(expected)
    if isinstance(expected, str | dict | CameraInfoMessage):
        assert found == expected
        return
    for name, other in vars(expected).items():
        one = getattr(found, name)
        if isinstance(other, np.ndarray):
            assert one.dtype == other.dtype
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-15)
        else:
            assert one == other


@pytest.mark.parametrize("foxglove", ["", "packed", "rows"])
def test_messages_of_both_encodings_are_decoded(tmp_path, foxglove):
    path = tmp_path / "log.mcap"
    topics = CONTENTS.keys()
    write_ros2(path, ros2_sent(4))
    if foxglove:
        path = in_foxgloves_messages(path, tmp_path / "again.mcap", packed=foxglove == "packed")
        topics = topics - ROS2_ALONE
    found = by_topic(path)
    assert found.keys() == topics
    for topic, received in found.items():
        assert_same(received.content, CONTENTS[topic])
    assert found["/depth"].stamp == BEGIN + 3 * SECOND
    assert found["/probe"].stamp is None


@pytest.mark.parametrize("foxglove", [False, True])
def test_normals_of_a_cloud_are_decoded(tmp_path, foxglove):
    path = tmp_path / "log.mcap"
    points, normals = np.arange(6.0).reshape(2, 3), np.array([[0.0, 0.6, -0.8], [np.nan] * 3])
    whole = ros2_cloud(points, BEGIN, normals=normals)
    lacking = whole | {"fields": whole["fields"][:5]}
    coarse = whole | {"fields": [*whole["fields"][:5], whole["fields"][5] | {"datatype": 4}]}
    clouds = {"/whole": whole, "/lacking": lacking} | ({} if foxglove else {"/coarse": coarse})
    kind = "sensor_msgs/PointCloud2"
    write_ros2(path, [(topic, kind, cloud, BEGIN) for topic, cloud in clouds.items()])
    if foxglove:
        path = in_foxgloves_messages(path, tmp_path / "again.mcap", packed=True)
    found = by_topic(path)
    for topic in clouds:
        expected = CloudMessage("lidar", points, normals=normals if topic == "/whole" else None)
        assert_same(found[topic].content, expected)


def test_broken_messages_are_counted_with_their_topic(tmp_path):
    good = ros2_sent(1)
    ages_ago = {"stamp": {"sec": -1, "nanosec": 0}, "frame_id": "a"}
    images = [{"encoding": "rgb8"}, {"height": 2**31}, {"header": ages_ago}]
    usual = image("camera", depth(), stamp=5)
    changed = [("/depth", "sensor_msgs/Image", {**usual, **change}, 9) for change in images]
    picture = {"header": {}, "format": "png", "data": png(depth())[:60]}
    changed.append(("/compressed", "sensor_msgs/CompressedImage", picture, 9))
    for place, turn in ((xyz(0.0, 0.0, 0.0), xyz(0.0, 0.0, 0.0, 0.0)), (xyz(np.nan), {"w": 1.0})):
        pose = {"header": {}, "pose": {"position": place, "orientation": turn}}
        changed.append(("/pose", "geometry_msgs/PoseStamped", pose, 9))
    wrench = {"header": {}, "wrench": {"force": xyz(np.nan), "torque": {}}}
    changed.append(("/wrench", "geometry_msgs/WrenchStamped", wrench, 9))
    write_ros2(tmp_path / "log.mcap", [*good, *changed])
    log = RawLog(tmp_path / "log.mcap")
    assert len(list(log.messages(log.topics))) == len(good)
    counts = Counter(fault.partition(":")[0] for fault in log.faults.elements())
    assert counts == {"/depth": len(images), "/compressed": 1, "/pose": 2, "/wrench": 1}
    said = " ".join(log.faults)
    assert "'rgb8' is no depth" in said
    assert "a force or torque is not finite" in said


def test_of_several_transforms_only_the_broken_one_is_left_out(tmp_path):
    parts = [
        transform("base", name, parent_from_child=moved(x, 0, 0), stamp=5)
        for name, x in (("a", np.nan), ("b", 1))
    ]
    sent = [("/tf", "tf2_msgs/TFMessage", {"transforms": parts}, 9)]
    write_ros2(tmp_path / "log.mcap", sent)
    log = RawLog(tmp_path / "log.mcap")
    (received,) = log.messages(["/tf"])
    assert_same(received.content, TransformMessage("base", "b", parent_from_child=moved(1, 0, 0)))
    assert list(log.faults.values()) == [1]


def test_intrinsics_are_those_of_the_pixels_that_are_sent(tmp_path):
    topic, kind, message, log_time = next(one for one in ros2_sent(1) if one[0] == "/info")
    sent = {
        **message,
        "width": 640,
        "height": 480,
        "k": [400.0, 0.0, 320.0, 0.0, 410.0, 240.0, 0.0, 0.0, 1.0],
        "p": [800.0, 0.0, 300.0, 9.0, 0.0, 820.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        "d": [0.0, 0.1],
        "binning_x": 2,
        "binning_y": 4,
        "roi": {"x_offset": 100, "y_offset": 40, "width": 320, "height": 240},
    }
    write_ros2(tmp_path / "log.mcap", [(topic, kind, sent, log_time)])
    camera = PinholeCamera(160, 60, fx=200.0, fy=102.5, cx=110.0, cy=50.0)
    content = by_topic(tmp_path / "log.mcap")["/info"].content
    rectified = PinholeCamera(160, 60, fx=400.0, fy=205.0, cx=100.0, cy=40.0)
    assert content == CameraInfoMessage(
        camera, distortion=(0.0, 0.1), distortion_model="plumb_bob", rectified=rectified
    )


@pytest.mark.parametrize(
    "k",
    [
        [400.0, 0.0, 0.0, 0.0, 410.0, 0.0, 2.0, 1.0, 1.0],  # by columns
        [800.0, 0.0, 4.0, 0.0, 820.0, 2.0, 0.0, 0.0, 2.0],
        [400.0, 0.0, 2.0, 0.0, 410.0, 1.0, 0.0, 0.0, 0.0],
        [400.0, 9.0, 2.0, 0.0, 410.0, 1.0, 0.0, 0.0, 1.0],
        [400.0, 0.0, float("nan"), 0.0, 410.0, 1.0, 0.0, 0.0, 1.0],
    ],
)
@pytest.mark.parametrize("foxglove", [False, True])
def test_a_matrix_that_is_none_of_a_camera_is_refused(tmp_path, k, foxglove):
    topic, kind, message, log_time = next(one for one in ros2_sent(1) if one[0] == "/info")
    path = tmp_path / "log.mcap"
    write_ros2(path, [(topic, kind, {**message, "k": k}, log_time)])
    if foxglove:
        path = in_foxgloves_messages(path, tmp_path / "again.mcap", packed=True)
    log = RawLog(path)
    assert not list(log.messages(log.topics))
    listed = ", ".join(f"{value:g}" for value in k)
    expected = f"/info: K is [{listed}]; accepted: fx, 0, cx, 0, fy, cy, 0, 0, 1"
    assert list(log.faults) == [expected]


def test_a_little_skew_of_a_driver_is_left_out(tmp_path):
    topic, kind, message, log_time = next(one for one in ros2_sent(1) if one[0] == "/info")
    k = [400.0, 0.39, 2.0, 0.0, 410.0, 1.0, 0.0, 0.0, 1.0]  # less than a thousandth of 400
    write_ros2(
        tmp_path / "log.mcap", [(topic, kind, {**message, "k": k, "p": [0.0] * 12}, log_time)]
    )
    assert by_topic(tmp_path / "log.mcap")["/info"].content == CameraInfoMessage(CAMERA)
    with pytest.raises(SettingError, match="not a pinhole camera's matrix"):
        PinholeCamera.of_matrix(np.reshape(k, (3, 3)), 5, height=3)


def test_a_rectified_matrix_that_is_none_does_not_matter(tmp_path):
    topic, kind, message, log_time = next(one for one in ros2_sent(1) if one[0] == "/info")
    for p in ([0.0] * 12, [float("nan")] * 12, [*range(1, 13)]):
        write_ros2(tmp_path / "log.mcap", [(topic, kind, {**message, "p": p}, log_time)])
        assert by_topic(tmp_path / "log.mcap")["/info"].content == CameraInfoMessage(CAMERA)


VALUES = np.random.default_rng(0).integers(0, 2**16, (4, 7)).astype(np.uint16)


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(("encoding", "kind"), [("16UC1", "u2"), ("mono16", "u2"), ("32FC1", "f4")])
@pytest.mark.parametrize("padding", [0, 3])
def test_rows_of_pixels(encoding, kind, big_endian, padding):
    stored = VALUES.astype((">" if big_endian else "<") + kind)
    rows = np.pad(stored.view(np.uint8).reshape(4, -1), ((0, 0), (0, padding)))
    found = pixel_rows(
        rows.tobytes(), encoding, size=(7, 4), step=rows.shape[1], big_endian=big_endian
    )
    assert found.dtype == np.dtype(kind)
    np.testing.assert_array_equal(found, VALUES)
    for size, step in (((7, 5), rows.shape[1]), ((7, 3), 0)):
        with pytest.raises(UnusableMessage, match=f"cannot have {rows.size} bytes"):
            pixel_rows(rows.tobytes(), encoding, size=size, step=step)


@pytest.mark.parametrize("step", [0, 1280, 2**32 - 1])
def test_rows_without_gaps_need_no_length(step):
    np.testing.assert_array_equal(
        pixel_rows(VALUES.tobytes(), "16UC1", size=(7, 4), step=step), VALUES
    )
    points = np.arange(18.0).reshape(6, 3)
    fields = {name: (8 * k, 8) for k, name in enumerate("xyz")}
    for size in ((6, 1), (3, 2)):
        found = packed_points(points.tobytes(), fields, stride=24, size=size, row=step)
        np.testing.assert_array_equal(found, points)
    with pytest.raises(UnusableMessage, match="cannot have 144 bytes"):
        packed_points(points.tobytes(), fields, stride=24, size=(5, 1), row=step)


@pytest.mark.parametrize(
    ("data", "text", "reason"),
    [
        (png(VALUES.astype(np.uint8)), "png", "mode L"),
        (png(np.zeros((2, 2, 3), np.uint8)), "png", "mode RGB"),
        (png(VALUES)[:-40], "png", "is no PNG"),
        (b"\xff\xd8\xff\xe0", "jpeg", "JPEG"),
        (bytes(30), "16UC1; compressedDepth rvl", "RVL"),
        (b"short", "16UC1; compressedDepth", "is no PNG"),
    ],
)
def test_what_is_no_depth_is_refused(data, text, reason):
    with pytest.raises(UnusableMessage, match=reason):
        compressed_pixels(data, text)


def test_compressed_depth_is_that_of_image_transport():
    np.testing.assert_array_equal(compressed_pixels(png(VALUES), "png"), VALUES)
    whole = struct.pack("<iff", 0, 0.0, 0.0) + png(VALUES)
    np.testing.assert_array_equal(compressed_pixels(whole, "16UC1; compressedDepth png"), VALUES)
    depth = np.array([[0.5, 2.0], [8.0, np.nan]])  # as the sender quantises: n = a / depth + b
    scale = 100.0 * 101.0
    offset = 1.0 - 100.0 * 101.0 / 10.0
    numbers = np.where(np.isnan(depth), 0, np.rint(scale / np.nan_to_num(depth, nan=1.0) + offset))
    data = struct.pack("<iff", 1, scale, offset) + png(numbers.astype(np.uint16))
    found = compressed_pixels(data, "32FC1; compressedDepth")
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, depth, rtol=5e-3)


@pytest.mark.parametrize("order", ["<", ">"])
def test_points_of_several_rows_with_gaps(order):
    points = np.random.default_rng(1).normal(size=(2, 3, 3))
    points[..., 1] = points[..., 1].astype(np.float32)
    kinds = [order + kind for kind in ("f8", "f4", "f8")]
    layout = np.dtype(
        {"names": list("xyz"), "formats": kinds, "offsets": [8, 16, 0], "itemsize": 30}
    )
    packed = np.zeros((2, 3), layout)
    for axis, name in enumerate("xyz"):
        packed[name] = points[:, :, axis]
    rows = np.pad(packed.view(np.uint8).reshape(2, 90), ((0, 0), (0, 40)))
    fields = {"x": (8, 8), "intensity": (24, 4), "y": (16, 7), "z": (0, 8)}
    big = order == ">"
    found = packed_points(rows.tobytes(), fields, stride=30, size=(3, 2), row=130, big_endian=big)
    np.testing.assert_array_equal(found, points.reshape(-1, 3))
    for size in ((5, 2), (3, 3)):
        with pytest.raises(UnusableMessage, match="cannot have 260 bytes"):
            packed_points(rows.tobytes(), fields, stride=30, size=size, row=130)
    with pytest.raises(UnusableMessage, match="has no field z of float32 or float64"):
        packed_points(b"", {"x": (0, 7), "y": (4, 7), "z": (0, 5)}, stride=30, size=(0, 1), row=0)
    assert packed_points(b"", fields, stride=30, size=(0, 1), row=0).shape == (0, 3)
