"""Simulated logs: is what they hold where the object is?"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from omegaconf import OmegaConf

from chsel.events import Probe
from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from runners.command.choices import CONF
from runners.objects.loader import load_model
from runners.sensors.log.messages import Received
from runners.sensors.log.raw_log import RawLog
from runners.sessions import session_settings
from runners.sessions.sensors import SensorsSource
from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS, REST, world_from_camera
from runners.simulated_robot.settings import BubbleSettings, CameraSettings, RobotSettings
from runners.simulated_robot.simulation import START, TICK, SimulatedLog, simulate_log

CONFIGURATION = CABINET_CONFIGURATIONS["cabinet_mustard"]
MESH = load_model("mustard")
SEED = 3
SMALL = RobotSettings(2, CameraSettings(width=160, rate=1.0), bubbles=BubbleSettings(rate=5.0))
# One probe that touches nothing, in which little is seen.
TINY = replace(SMALL, probes=1, push_steps=1, standing=0.2, dwell=0.1, drop=0.0)


@dataclass(frozen=True, eq=False)
class Log:
    """A log, its messages in their order, and the truth."""

    path: Path
    truth: SimulatedLog
    messages: list[Received]

    def on(self, topic):
        return [message for message in self.messages if message.topic == topic]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("simulated") / "small.mcap"
    truth = simulate_log(path, CONFIGURATION, mesh=MESH, seed=SEED, settings=SMALL)
    raw = RawLog(path)
    return Log(path, truth, messages=list(raw.messages(raw.topics)))


def test_messages_are_logged_a_little_later_than_they_are_sent(log):
    for topic in ("/camera/depth/image_raw", "/bubble_left/depth/image_raw", "/joint_states"):
        late = np.array([message.log_time - (message.stamp or 0) for message in log.on(topic)])
        assert 0 < late.min() < late.max() < 0.05e9
        assert len(set(late.tolist())) > 1
    stamps = sorted(message.stamp or 0 for message in log.on("/joint_states"))
    assert (np.diff(stamps) == TICK).all()
    assert stamps[0] == START


def test_pushes_end_where_the_pads_feel_the_bottle(log):
    front = apply(log.truth.world_from_object, MESH.vertices)[:, 0].min()
    for push, (y, z) in zip(log.truth.pushes, CONFIGURATION.grid, strict=False):
        assert push.stopped == "pads"
        assert REST[0] + push.reach + 0.17 == pytest.approx(front, abs=0.03)
        assert abs(push.y - REST[1] - y) < 0.01
        assert abs(push.z - REST[2] - z) < 0.01


def test_contacts_lie_on_the_object_and_free_space_beside_it(log):
    rig = OmegaConf.to_container(OmegaConf.load(CONF / "session" / "rig" / "cabinet.yaml"))
    rig["cameras"][0]["edge_reach"] = 2  # of fewer pixels than usual
    for pad, degrees in zip(rig["bubbles"], (10, 5), strict=True):
        pad["normals"] = degrees
    session = SensorsSource(session_settings("sensors", {"path": str(log.path), "rig": rig}), 0)
    probes = [event for event in session.probes() if isinstance(event, Probe)]
    assert [len(probe.contacts) for probe in probes] == [50, 50]

    def distance(points):
        object_from_world = inverse(log.truth.world_from_object)
        return mesh_sdf(MESH, apply(object_from_world, np.concatenate(points)))[0]

    contacts = [probe.contacts for probe in probes]
    felt = distance(contacts)
    normals = np.concatenate([probe.new_points.normals for probe in probes])
    local = apply(inverse(log.truth.world_from_object), np.concatenate(contacts))
    faces = trimesh.proximity.closest_point(MESH, local)[2]
    outward = MESH.face_normals[faces] @ log.truth.world_from_object[:3, :3].T
    off = np.degrees(np.arccos(np.minimum((normals * outward).sum(axis=1), 1.0)))
    assert np.sqrt((off**2).mean()) < 4.0
    assert off.max() < 12.0
    for probe in probes:  # the left pad's contacts come first
        left = session.report.by_probe[probe.step]["bubble_left"].contacts
        noise = np.radians([10.0] * left + [5.0] * (50 - left))
        np.testing.assert_allclose(probe.new_points.normal_noise, noise)
    assert abs(felt.mean()) < 0.0003
    assert np.quantile(np.abs(felt), 0.95) < 0.0015
    free = distance([probe.new_points.free for probe in probes])
    assert len(free) > 5000
    assert free.min() > -0.02  # a coarse image with strays at edges
    assert (free < 0.0).mean() < 0.01
    assert sum(counts.lost for counts in session.report.total().values()) == 0


def test_the_outer_camera_sees_the_cabinet_where_it_is(log):
    image, info = (
        log.on(f"/camera/depth/{name}")[0].content for name in ("image_raw", "camera_info")
    )
    seen = info.camera.back_project(image.values / 1000.0)[image.values > 0]
    points = apply(world_from_camera(), seen)
    # Of what lies in the cabinet's opening, most is on its shelf, its back or its left wall.
    lower, upper = np.array([[0.75, -0.23, 0.3], [1.14, 0.23, 0.61]])
    inside = points[((points > lower) & (points < upper)).all(axis=1)]
    near = np.abs(inside - [1.12, 0.22, 0.31]) < 0.01
    assert len(inside) > 100
    assert near.any(axis=1).mean() > 0.8


def test_the_same_arguments_give_the_same_bytes(tmp_path):
    paths = [tmp_path / name for name in ("one.mcap", "two.mcap", "other.mcap")]
    for path, seed in zip(paths, (SEED, SEED, SEED + 1), strict=True):
        simulate_log(path, CONFIGURATION, mesh=MESH, seed=seed, settings=TINY)
    one, two, other = (path.read_bytes() for path in paths)
    assert one == two
    assert one != other
    assert sorted(tmp_path.iterdir()) == sorted(paths)
