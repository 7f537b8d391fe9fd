"""Simulated logs, read by other packages: is what they hold where the object is?"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy import ndimage
from scipy.spatial.transform import Rotation

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, compose, inverse
from runners.objects.loader import load_model
from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS, REST
from runners.simulated_robot.settings import BubbleSettings, CameraSettings, RobotSettings
from runners.simulated_robot.simulation import START, TICK, SimulatedLog, simulate_log

pytest.importorskip("pybullet", reason="PyBullet has wheels for Python 3.11 only")

CONFIGURATION = CABINET_CONFIGURATIONS["cabinet_mustard"]
MESH = load_model("mustard")
SEED = 3
SMALL = RobotSettings(
    probes=2,
    camera=CameraSettings(width=160, rate=1.0),
    bubbles=BubbleSettings(rate=5.0),
    standing=1.0,
)
# One probe that touches nothing, in which little is seen.
TINY = replace(SMALL, probes=1, push_steps=1, standing=0.2, dwell=0.1, drop=0.0)
PADS = ("left", "right")


@dataclass(frozen=True, eq=False)
class Log:
    """A log's messages by topic, each with its log time, and the truth."""

    truth: SimulatedLog
    messages: dict[str, list[tuple[int, Any]]]
    log_times: list[int]

    def stamps(self, topic: str) -> np.ndarray:
        """Header times of a topic, nanoseconds."""
        return np.array([_stamp(message.header) for _, message in self.messages[topic]])

    def world_from_wrist(self, stamp: int) -> FloatArray:
        """Pose (4, 4) at the time of an image; transforms are sent at every tick."""
        for _, message in self.messages["/tf"]:
            (sent,) = message.transforms
            if _stamp(sent.header) == stamp:
                return _pose(sent.transform)
        raise AssertionError(f"no transform at {stamp}")


def _read(path: Path, truth: SimulatedLog) -> Log:
    messages, log_times = defaultdict(list), []
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, record, message in reader.iter_decoded_messages(log_time_order=False):
            messages[channel.topic].append((record.log_time, message))
            log_times.append(record.log_time)
    return Log(truth, messages, log_times)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    path = tmp_path_factory.mktemp("simulated") / "small.mcap"
    return _read(path, simulate_log(path, CONFIGURATION, MESH, SEED, SMALL))


def test_the_log_is_in_the_order_of_its_clock_and_a_little_later_than_the_senders(
    log: Log,
) -> None:
    assert log.log_times == sorted(log.log_times)
    for topic in ("/camera/depth/image_raw", "/bubble_left/depth/image_raw", "/joint_states"):
        late = np.array([time for time, _ in log.messages[topic]]) - log.stamps(topic)
        assert 0 < late.min() < late.max() < 0.05e9
        assert len(set(late.tolist())) > 1
    assert (np.diff(log.stamps("/joint_states")) == TICK).all()
    assert log.stamps("/joint_states")[0] == START


def test_pushes_end_where_the_pads_feel_the_bottle(log: Log) -> None:
    front = apply(log.truth.world_from_object, MESH.vertices)[:, 0].min()
    for push, (y, z) in zip(log.truth.pushes, CONFIGURATION.grid, strict=False):
        assert push.stopped == "pads"
        assert REST[0] + push.reach + 0.17 == pytest.approx(front, abs=0.03)
        assert abs(push.y - REST[1] - y) < 0.01
        assert abs(push.z - REST[2] - z) < 0.01


def test_dents_lie_on_the_object(log: Log) -> None:
    felt = [_contact(log, push.step) for push in log.truth.pushes]
    exact = trimesh.proximity.ProximityQuery(MESH)
    for points in felt:
        assert len(points) >= 100
        distance = exact.signed_distance(apply(inverse(log.truth.world_from_object), points))
        assert abs(distance.mean()) < 0.0003
        assert np.quantile(np.abs(distance), 0.95) < 0.0015


def test_the_outer_camera_sees_the_cabinet_where_it_is(log: Log) -> None:
    _, image = log.messages["/camera/depth/image_raw"][0]
    _, info = log.messages["/camera/depth/camera_info"][0]
    points = apply(_static(log, "camera_depth_optical_frame"), _points(_values(image) / 1000, info))
    # Of what lies in the cabinet's opening, most is on its shelf, its back or its left wall.
    inside = points[
        (points[:, 0] > 0.75)
        & (np.abs(points[:, 1]) < 0.23)
        & (points[:, 2] > 0.3)
        & (points[:, 2] < 0.61)
        & (points[:, 0] < 1.14)
    ]
    near = (
        (np.abs(inside[:, 2] - 0.31) < 0.01)
        | (np.abs(inside[:, 0] - 1.12) < 0.01)
        | (np.abs(inside[:, 1] - 0.22) < 0.01)
    )
    assert len(inside) > 100
    assert near.mean() > 0.8


def test_the_same_arguments_give_the_same_bytes(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("one.mcap", "two.mcap", "other.mcap")]
    for path, seed in zip(paths, (SEED, SEED, SEED + 1), strict=True):
        simulate_log(path, CONFIGURATION, MESH, seed, TINY)
    one, two, other = (path.read_bytes() for path in paths)
    assert one == two
    assert one != other
    assert [path.name for path in sorted(tmp_path.iterdir())] == sorted(p.name for p in paths)


def _contact(log: Log, step: int) -> FloatArray:
    """World points (C, 3) of the best contact of a probe, found as the paper says."""
    begin, end = (time for time, _ in log.messages["/probe"][2 * step : 2 * step + 2])
    best = np.zeros((0, 3))
    for pad in PADS:
        images = log.messages[f"/bubble_{pad}/depth/image_raw"]
        _, info = log.messages[f"/bubble_{pad}/depth/camera_info"][0]
        first = log.messages["/probe"][0][0]
        rest = np.median([_values(image) for time, image in images if time < first], axis=0)
        for time, image in images:
            if not begin <= time <= end:
                continue
            depth = _values(image).astype(np.float64)
            good = (depth > 0.0) & (rest > 0.0)
            dent = ndimage.uniform_filter(np.where(good, rest - depth, 0.0), 10)
            mask = good & (dent > 0.004) & (dent > np.quantile(dent, 0.9))
            if mask.sum() > len(best):
                pose = log.world_from_wrist(_stamp(image.header))
                camera = pose @ _static(log, f"bubble_{pad}_camera")
                best = apply(camera, _points(np.where(mask, depth, 0.0), info))
    return best


def _points(depth: FloatArray, info: Any) -> FloatArray:
    """Points (N, 3) in the camera's frame of all pixels that have a depth, metres."""
    v, u = np.nonzero(depth)
    z = depth[v, u]
    return np.stack([(u - info.k[2]) / info.k[0] * z, (v - info.k[5]) / info.k[4] * z, z], axis=1)


def _static(log: Log, frame: str) -> FloatArray:
    ((_, message),) = log.messages["/tf_static"]
    (found,) = (sent for sent in message.transforms if sent.child_frame_id == frame)
    return _pose(found.transform)


def _pose(transform: Any) -> FloatArray:
    q, t = transform.rotation, transform.translation
    return compose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), np.array([t.x, t.y, t.z]))


def _values(image: Any) -> np.ndarray:
    kind = {"16UC1": "<u2", "32FC1": "<f4"}[image.encoding]
    return np.frombuffer(bytes(image.data), kind).reshape(image.height, image.width)


def _stamp(header: Any) -> int:
    return int(header.stamp.sec * 1_000_000_000 + header.stamp.nanosec)
