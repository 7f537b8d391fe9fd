"""Sessions of raw logs: known answers, and logs that lack something."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from chsel.errors import SessionError, SettingError
from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.settings import build_settings, settings_mapping
from replay.events import Logged, Probe, RigDescribed, SensorImage
from runners.command.choices import CONF
from runners.objects.loader import ObjectConfig, load_object
from runners.sensors.pose_file import beside, write_pose
from runners.sensors.rig import (
    Annotations,
    BubbleRig,
    CloudRig,
    ExtraContacts,
    HandRig,
    ProbeTimes,
    Rig,
)
from runners.sessions import session_settings
from runners.sessions.sensors import SensorsSession, SensorsSettings
from tests.replay.conftest import same_bits
from tests.runners.sensors.foxglove_log import in_foxgloves_messages
from tests.runners.sensors.small_logs import Sent, ros2_cloud, ros2_transform, write_ros2
from tests.runners.sensors.sphere_log import (
    ASIDE,
    BEGIN,
    CENTRE,
    HAND_FROM_PAD,
    LATENCY,
    MEMBRANE,
    OUTER,
    PRESSED,
    RADIUS,
    RIG,
    SECOND,
    WORLD_FROM_CAMERA,
    SphereLog,
    hand_pose,
    seen,
)

SPACING = 0.01
DIAGONAL = 3**0.5 * SPACING


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return SphereLog().write(tmp_path_factory.mktemp("log") / "sphere.mcap")


@pytest.fixture(scope="module")
def events(log: Path) -> list[Any]:
    return list(open_log(log).probes())


def open_log(path: Path, rig: Rig = RIG, seed: int = 0, **changes: Any) -> SensorsSession:
    return SensorsSession(SensorsSettings(rig, str(path), **changes), seed)


def probes(events: Any) -> list[Probe]:
    return [event for event in events if isinstance(event, Probe)]


def lines(events: Any, level: str = "warning") -> str:
    found = [event for event in events if isinstance(event, Logged) and event.level == level]
    return "\n".join(event.text for event in found)


def heights(points: np.ndarray) -> np.ndarray:
    """Signed distance (N,) to the sphere."""
    return np.sqrt(((points - CENTRE) ** 2).sum(axis=1)) - RADIUS


def test_contacts_lie_on_what_was_touched(events: list[Any]) -> None:
    touching, passing = probes(events)
    assert (touching.step, touching.outcome) == (0, "contact")
    assert (passing.step, passing.outcome) == (1, "free")
    assert len(touching.contacts) == 50
    assert len(passing.contacts) == len(passing.new_points.known) == 0
    assert np.abs(heights(touching.contacts)).max() < 0.0015
    np.testing.assert_array_equal(touching.new_points.contacts, touching.contacts)
    outward = (touching.contacts - CENTRE) / RADIUS
    assert ((outward * touching.contact_normals).sum(axis=1) > 0.99).all()
    # A tenth of the pixels is a disk of 7.4 of them, 1 mm each at that depth.
    across = np.sqrt(((touching.contacts - CENTRE)[:, 1:] ** 2).sum(axis=1))
    assert across.max() == pytest.approx(0.0071, abs=0.0007)
    assert touching.contacts[:, 0].max() < CENTRE[0]


def test_free_space_is_where_rays_passed_and_the_hand_went(events: list[Any], log: Path) -> None:
    free = np.concatenate(
        [open_log(log).initial_points.free, *(probe.new_points.free for probe in probes(events))]
    )
    assert len(np.unique(np.rint(free / 1e-6).astype(int), axis=0)) == len(free)
    assert heights(free).min() > -DIAGONAL
    known = cKDTree(free)
    depth = seen()
    edges = maximum_filter(depth, 3) - minimum_filter(depth, 3) > 0.05
    for fraction in (0.3, 0.6, 0.94):
        ways = (fraction * depth[..., None] * OUTER.directions())[~edges][::50]
        points = ways @ WORLD_FROM_CAMERA[:3, :3].T + WORLD_FROM_CAMERA[:3, 3]
        lower, upper = np.array(RIG.workspace).T
        points = points[((points > lower) & (points < upper)).all(axis=1)]
        assert len(points) > 10
        assert (known.query(points, p=np.inf)[0] <= 0.5 * SPACING + 1e-9).all()
    nose = hand_pose(4.0) @ [0.0, 0.0, 0.08, 1.0]
    assert known.query(nose[:3] - [0.005, 0.0, 0.0], p=np.inf)[0] <= 0.5 * SPACING + 1e-9
    within_pad = hand_pose(2.0) @ HAND_FROM_PAD @ [0.0, 0.0, MEMBRANE - 0.03, 1.0]
    assert known.query(within_pad[:3], p=np.inf)[0] <= 0.5 * SPACING + 1e-9
    behind = np.array([0.5 * RADIUS, 0.0, 0.0])
    assert known.query(CENTRE + behind)[0] > 0.01


def test_a_pad_frees_what_is_before_its_membrane_and_nothing_behind_it(log: Path) -> None:
    session = open_log(log, replace(RIG, cameras=(), hand=None))
    free = np.concatenate([probe.new_points.free for probe in probes(session.probes())])
    assert len(free) > 100
    # A voxel is marked up to half its diagonal before the membrane, so no centre is in the sphere,
    # and none is beyond the furthest place of the membrane's plane.
    assert heights(free).min() > 0.0
    beside = np.abs(free[:, 1]) < ASIDE / 2
    assert free[beside, 0].max() < CENTRE[0] - RADIUS + PRESSED
    # What is a whole diagonal before the membrane at the end of the push is marked.
    end = hand_pose(2.0) @ HAND_FROM_PAD
    before = apply(end, np.array([[0.0, 0.0, MEMBRANE - PRESSED - DIAGONAL - 0.001]]))
    assert cKDTree(free).query(before, p=np.inf)[0] <= 0.5 * SPACING + 1e-9


def test_images_come_ahead_of_their_probe(events: list[Any], log: Path) -> None:
    kinds = [type(event) for event in events]
    assert kinds[0] is RigDescribed
    assert (events[0].name, events[0].step, events[0].hand.is_watertight) == ("sphere", -1, True)
    assert len(events[0].source) == 32
    first = kinds.index(Probe)
    images = [event for event in events[:first] if isinstance(event, SensorImage)]
    assert [(image.sensor, image.kind, image.step) for image in images] == [
        ("camera", "depth", 0),
        ("pad", "deformation", 0),
    ]
    camera, pad = images
    np.testing.assert_allclose(camera.values * camera.unit, seen(), atol=0.0011)
    np.testing.assert_allclose(camera.world_from_camera, WORLD_FROM_CAMERA, atol=1e-9)
    assert 0.9 < camera.mask.mean() < 1.0
    deepest = (pad.values * pad.unit).max()
    assert deepest == pytest.approx(0.012, abs=0.001)
    assert (pad.values[pad.mask] * pad.unit > 0.0039).all()
    assert pad.mask.sum() > 50
    without = list(open_log(log, images=False).probes())
    assert not any(isinstance(event, SensorImage) for event in without)
    for one, other in zip(probes(events), probes(without), strict=True):
        assert one.new_points.digest == other.new_points.digest


def test_the_hand_is_shown_where_it_was(events: list[Any]) -> None:
    path = probes(events)[0].gripper_path
    assert 10 < len(path) <= 200
    np.testing.assert_allclose(path[0], hand_pose(0.0), atol=1e-9)
    furthest = path[np.argmax(path[:, 0, 3])]
    np.testing.assert_allclose(furthest[:3, 3], hand_pose(2.0)[:3, 3], atol=0.003)


def test_the_seed_chooses_among_contact_pixels_and_changes_nothing_else(
    events: list[Any], log: Path
) -> None:
    again = probes(open_log(log).probes())[0]
    other = probes(open_log(log, seed=1).probes())[0]
    first = probes(events)[0]
    assert again.new_points.digest == first.new_points.digest
    np.testing.assert_array_equal(other.new_points.free, first.new_points.free)
    assert len(other.contacts) == 50
    assert not np.array_equal(other.contacts, first.contacts)


def test_contacts_count_between_begin_and_end_alone(tmp_path: Path) -> None:
    marks = ((0.5, "begin 3"), (1.2, "end 3"), (2.8, "begin 4"), (4.9, "end 4"))
    log = SphereLog(marks=marks).write(tmp_path / "log.mcap")
    session = open_log(log)
    found = probes(session.probes())
    assert [(probe.step, probe.outcome) for probe in found] == [(3, "free"), (4, "free")]
    # What is seen between two probes is known with the first of them.
    assert len(found[0].new_points.free) > 10 * len(found[1].new_points.free)


def test_a_log_without_markers_is_one_probe_and_times_can_stand_in_for_them(
    tmp_path: Path, log: Path
) -> None:
    rig = replace(RIG, markers=None)
    (probe,) = probes(open_log(log, rig).probes())
    assert (probe.step, probe.outcome, len(probe.contacts)) == (0, "contact", 50)
    rig = replace(rig, probes=(ProbeTimes(1.0, 1.2), ProbeTimes(1.5, 3.0), ProbeTimes(3.0, 4.9)))
    found = probes(open_log(log, rig).probes())
    assert [probe.outcome for probe in found] == ["free", "contact", "free"]
    rig = replace(rig, probes=(ProbeTimes(1.0, 2.0), ProbeTimes(1.5, 3.0)))
    with pytest.raises(SettingError, match=r"probes\[1\] runs from 1.5 to 3.0 s; accepted: a begi"):
        open_log(log, rig)


def test_annotations_leave_out_and_add_contacts(log: Path) -> None:
    annotations = Annotations(
        exclude=(0,),
        contacts=(
            ExtraContacts(0, foremost=5),
            ExtraContacts(1, points=((0.9, 0.01, 0.41), (0.9, 0.0, 0.41))),
            ExtraContacts(7, points=((0.9, 0.01, 0.41),)),
        ),
    )
    events = list(open_log(log, replace(RIG, annotations=annotations)).probes())
    first, second = probes(events)
    # The foremost part of a plane that gives way is at the membrane's rim.
    assert first.contacts[0, 0] == pytest.approx(CENTRE[0] - RADIUS + 0.012, abs=0.001)
    assert len(first.contacts) == 1
    np.testing.assert_array_equal(second.contacts, [[0.9, 0.01, 0.41], [0.9, 0.0, 0.41]])
    assert (second.contact_normals == 0.0).all()
    assert "annotates probe 7, which the log does not have" in lines(events)
    assert "probe 0: contacts left out" in lines(events, "info")


def test_contacts_that_a_rig_adds_must_be_finite_and_within_the_workspace(log: Path) -> None:
    with pytest.raises(SettingError, match=r"points\[1\]\[1\] is not finite"):
        ExtraContacts(0, points=((0.9, 0.0, 0.4), (0.9, float("nan"), 0.4)))
    added = (ExtraContacts(1, points=((0.9, 0.0, 0.41), (9.0, 0.0, 0.4))),)
    events = list(open_log(log, replace(RIG, annotations=Annotations((), added))).probes())
    np.testing.assert_array_equal(probes(events)[1].contacts, [[0.9, 0.0, 0.41]])
    assert "probe 1: a contact that the rig adds is left out, as it is out of" in lines(events)


def test_the_references_ways_tell_less(log: Path, events: list[Any]) -> None:
    assert RIG.hand is not None
    scaled = replace(RIG.cameras[0], rays="scaled_images")
    backwards = replace(RIG.hand, sweep="backwards")
    rig = replace(RIG, cameras=(scaled,), hand=backwards)
    found = probes(open_log(log, rig).probes())
    both = [sum(len(p.new_points.free) for p in some) for some in (found, probes(events))]
    assert 0.3 * both[1] < both[0] < both[1]
    rig = replace(RIG, cameras=(), hand=backwards)
    free = probes(open_log(log, rig).probes())[0].new_points.free
    end = hand_pose(2.0)[:3, 3] + [HAND_FROM_PAD[2, 3] + MEMBRANE, 0.0, 0.0]
    behind = end[0] - free[:, 0]
    # 0.02 to 0.15 m behind the membrane, as deep as it was pressed in; one voxel is the grid's.
    assert len(free) > 50
    assert -0.5 * SPACING < behind.min() - 0.02 < SPACING
    assert behind.max() < 0.15 + 0.012 + SPACING


# The box of the rig, 2 cm aside of its place as long as the finger's joint is at 0.
HAND_URDF = """<robot name="hand">
  <link name="flange"/>
  <link name="pad">
    <collision><geometry><box size="0.04 0.06 0.08"/></geometry></collision>
  </link>
  <joint name="finger" type="prismatic">
    <parent link="flange"/><child link="pad"/>
    <origin xyz="0 -0.02 0.04"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
</robot>"""


def test_a_hand_of_a_urdf_sweeps_what_its_boxes_sweep(tmp_path: Path) -> None:
    pytest.importorskip("yourdfpy")
    (tmp_path / "hand.urdf").write_text(HAND_URDF)
    linked = HandRig("hand", urdf=str(tmp_path / "hand.urdf"), joints="/joint_states")
    found = {}
    for finger in (0.02, 0.05):
        log = SphereLog(finger=finger).write(tmp_path / f"{finger}.mcap")
        for hand in (RIG.hand, linked):
            session = open_log(log, replace(RIG, cameras=(), hand=hand))
            events = list(session.probes())
            swept = session.report.total()["hand"].free
            free = np.concatenate([probe.new_points.free for probe in probes(events)])
            found[finger, hand] = swept, free, events[0].hand.centroid
    boxes, same, aside = (found[key] for key in ((0.02, RIG.hand), (0.02, linked), (0.05, linked)))
    assert boxes[0] == same[0] > 200
    np.testing.assert_array_equal(boxes[1], same[1])
    np.testing.assert_allclose(same[2], boxes[2], atol=1e-9)
    np.testing.assert_allclose(aside[2], boxes[2] + [0.0, 0.03, 0.0], atol=1e-9)
    assert not np.array_equal(aside[1], boxes[1])
    with pytest.raises(SessionError, match=r"sphere names: /joint_states \(joints of the h"):
        open_log(SphereLog().write(tmp_path / "log.mcap"), replace(RIG, hand=linked))


@pytest.mark.parametrize("packed", [False, True])
def test_a_log_of_foxgloves_messages_gives_the_same_to_the_bit(
    events: list[Any], log: Path, tmp_path: Path, packed: bool
) -> None:
    other = in_foxgloves_messages(log, tmp_path / "foxglove.mcap", packed=packed)
    session = open_log(other)
    again = list(session.probes())
    assert {topic.encoding for topic in session._log.topics.values()} == {"protobuf"}
    assert again[0].source != events[0].source
    again[0] = replace(again[0], source=events[0].source)
    assert len(again) == len(events)
    for one, before in zip(again, events, strict=True):
        assert same_bits(one, before), f"{type(one).__name__} of probe {one.step}"


LIDAR = np.array([0.72, 0.1, 0.55])  # m: its place in the world


def log_with_clouds(folder: Path, points: np.ndarray) -> Path:
    """The sphere's log with points (N, 3) in the lidar's frame on /lidar and /skin, twice each."""
    sent: list[Sent] = []

    class Collector:
        def add(self, topic: str, kind: str, message: Any, stamp: int, log_time: int) -> None:
            sent.append((topic, kind, message, log_time))

    SphereLog().send(Collector())
    fixed = {"transforms": [ros2_transform("world", "lidar", LIDAR, BEGIN)]}
    sent.append(("/tf_static", "tf2_msgs/TFMessage", fixed, BEGIN))
    for seconds in (0.5, 2.0):
        stamp = BEGIN + round(seconds * SECOND)
        for topic in ("/lidar", "/skin"):
            cloud = ros2_cloud(points, stamp)
            sent.append((topic, "sensor_msgs/PointCloud2", cloud, stamp + LATENCY))
    write_ros2(folder / "log.mcap", sorted(sent, key=lambda one: one[3]), chunk_size=10**6)
    return folder / "log.mcap"


def test_clouds_are_rays_or_surface_or_contacts(tmp_path: Path) -> None:
    origin = LIDAR
    points = np.array([[0.2, 0.0, 0.0], [0.2, 0.0, 0.001], [np.nan, 0.0, 0.0], [9.0, 0.0, 0.0]])
    log = log_with_clouds(tmp_path, points)
    with_clouds = replace(
        RIG,
        cameras=(),
        hand=None,
        clouds=(CloudRig("/lidar", "rays"), CloudRig("/skin", "contacts")),
    )
    session = open_log(log, with_clouds)
    events = list(session.probes())
    first, second = probes(events)
    assert len(first.contacts) == 51  # one of the cloud's two in a voxel; 9 m is out of the room
    np.testing.assert_allclose(first.contacts[-1], [0.92, 0.1, 0.55], atol=1e-6)
    assert len(second.contacts) == 0
    on_ray = (np.abs(first.new_points.free - origin)[:, 1:] < 1e-9).all(axis=1)
    assert len(first.new_points.free[on_ray]) >= 18
    counts = session.report.by_probe[0]["/skin"]
    assert (counts.images, counts.used, counts.spared, counts.contacts) == (2, 1, 1, 1)
    surface = replace(with_clouds, clouds=(CloudRig("/skin", "surface"),))
    first = probes(open_log(log, surface).probes())[0]
    assert (len(first.contacts), len(first.new_points.known)) == (50, 51)
    assert "/skin" not in lines(events)
    assert "/lidar" not in lines(events)


@pytest.mark.parametrize("role", ["surface", "contacts", "rays"])
def test_a_topic_whose_points_are_all_out_of_reach_is_a_warning(tmp_path: Path, role: str) -> None:
    """Here, as they are in millimetres."""
    points = np.array([[200.0, 0.0, 0.0], [200.0, 0.0, 1.0], [np.nan, 0.0, 0.0]])
    log = log_with_clouds(tmp_path, points)
    session = open_log(log, replace(RIG, cameras=(), clouds=(CloudRig("/skin", role),)))
    count = 2 if role == "contacts" else 4  # of which the second message is between probes
    reach = "over 100 m away" if role == "rays" else "out of the workspace"
    text = (
        f"/skin: all {count} points are {reach}, in the first message around [200.7, 0.1, 1.05] m"
    )
    assert text in lines(session.probes())
    assert ("warning", text) in [(level, line[: len(text)]) for level, line in session.report.lines]


@pytest.mark.parametrize(
    ("changes", "left_out", "message"),
    [
        (
            {"markers": "/marks"},
            (),
            r"lacks what rig sphere names: /marks \(markers of probes\);",
        ),
        (
            {},
            ("/camera/depth",),
            r"/camera/depth \(depth of camera\); it has /camera/info \(sen",
        ),
        ({}, ("/pad/info",), r"/pad/info \(camera info of pad\)"),
        ({}, ("/tf", "/tf_static"), r"camera: frame world is in no transform; there are none"),
        ({"world": "map"}, (), r"camera: frame map is in no transform; there are camera_frame, ha"),
        ({"workspace": None}, (), r"workspace is missing"),
        ({"cameras": (), "bubbles": (), "hand": None}, (), r"rig sphere has no sensor"),
    ],
)
def test_a_log_that_lacks_something_says_so(
    tmp_path: Path, changes: dict[str, Any], left_out: tuple[str, ...], message: str
) -> None:
    log = SphereLog(left_out=left_out).write(tmp_path / "log.mcap")
    with pytest.raises((SessionError, SettingError), match=message):
        open_log(log, replace(RIG, **changes))


def test_depths_in_another_unit_are_an_error_that_names_it(tmp_path: Path, log: Path) -> None:
    metres = SphereLog(unit=1.0).write(tmp_path / "log.mcap")  # so that whole metres are sent
    with pytest.raises(SessionError, match=r"/camera/depth of camera has depths of 0.001 m \(medi"):
        open_log(metres)
    # Depths a thousand times as large: the pad's are in metres.
    millimetres = replace(RIG.bubbles[0], unit=0.001)
    with pytest.raises(SessionError, match=r"at 0.001 m a unit\); accepted: from 0.01 to 0.1 m"):
        open_log(log, replace(RIG, bubbles=(millimetres,)))


def test_a_topic_of_another_kind_is_no_depth(log: Path) -> None:
    wrong = replace(RIG.cameras[0], depth="/probe")
    with pytest.raises(SessionError, match=r"/probe of camera gives no depth images \(its schem"):
        open_log(log, replace(RIG, cameras=(wrong,)))


def test_a_hole_in_the_transforms_costs_the_images_within(tmp_path: Path) -> None:
    log = SphereLog(lost_transforms=(3.4, 4.6)).write(tmp_path / "log.mcap")
    session = open_log(log)
    events = list(session.probes())
    first, second = probes(events)
    assert len(first.contacts) == 50
    assert (second.outcome, session.report.by_probe[0]["pad"].lost) == ("free", 0)
    assert session.report.by_probe[1]["pad"].lost == 12
    assert "pad: left out, as the pose of pad_frame is not known then (12 times)" in lines(events)
    # Nothing is swept across the hole.
    steps = np.abs(np.diff(second.gripper_path[:, 0, 3]))
    assert steps.max() > 0.02 or len(second.gripper_path) < 20


def test_a_camera_whose_clock_is_ahead_is_put_right(tmp_path: Path, events: list[Any]) -> None:
    log = SphereLog(camera_clock=100.0).write(tmp_path / "log.mcap")
    ahead = list(open_log(log).probes())
    assert "/camera/depth is 100 s ahead of other topics'" in lines(ahead)
    for one, other in zip(probes(ahead), probes(events), strict=True):
        np.testing.assert_array_equal(one.contacts, other.contacts)
        np.testing.assert_array_equal(one.new_points.free, other.new_points.free)


def test_a_pose_beside_the_log_is_the_true_one(tmp_path: Path) -> None:
    log = SphereLog().write(tmp_path / "log.mcap")
    assert open_log(log).world_from_object is None
    pose = np.eye(4)
    pose[:3, 3] = CENTRE
    write_pose(beside(log), pose, {})
    session = open_log(log)
    np.testing.assert_array_equal(session.world_from_object, pose)
    assert "the true pose is that of log.pose.yaml" in lines(session.probes(), "info")
    assert open_log(log, pose="none").world_from_object is None
    with pytest.raises(SessionError, match=r"other.yaml: cannot be read"):
        open_log(log, pose=str(tmp_path / "other.yaml"))


def test_a_pad_that_sends_deformations_needs_its_shape(log: Path, tmp_path: Path) -> None:
    pad = BubbleRig("pad", "/pad/depth", "/pad/info", kind="deformation")
    with pytest.raises(SessionError, match=r"pad has images of deformation and no reference"):
        open_log(log, replace(RIG, bubbles=(pad,)))
    np.save(tmp_path / "small.npy", np.full((4, 4), 0.06))
    pad = replace(RIG.bubbles[0], reference=str(tmp_path / "small.npy"))
    with pytest.raises(SessionError, match=r"reference of pad has 4 x 4 pixels; accepted: .* 48 x"):
        open_log(log, replace(RIG, bubbles=(pad,)))
    np.save(tmp_path / "whole.npy", np.full((36, 48), MEMBRANE))
    pad = replace(RIG.bubbles[0], reference=str(tmp_path / "whole.npy"))
    found = probes(open_log(log, replace(RIG, bubbles=(pad,))).probes())
    assert np.abs(heights(found[0].contacts)).max() < 0.0015


def test_rigs_are_plain_settings_in_which_misspelled_keys_are_errors(log: Path) -> None:
    values = {"path": str(log), "rig": settings_mapping(RIG)}
    assert session_settings("sensors", values).rig == RIG
    values["rig"]["cameras"][0]["edges"] = 0.1
    with pytest.raises(SettingError, match=r"rig.cameras\[0\].edges does not exist; did you mean"):
        session_settings("sensors", values)
    with pytest.raises(SettingError, match=r"path is missing; pass session.path=LOG"):
        build_settings(SensorsSettings, {"rig": settings_mapping(RIG)}, "session")


def test_the_simulated_cell_is_read_like_any_other(tmp_path: Path) -> None:
    pytest.importorskip("pybullet")
    from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS
    from runners.simulated_robot.settings import BubbleSettings, CameraSettings, RobotSettings
    from runners.simulated_robot.simulation import simulate_log

    mesh = load_object(ObjectConfig("mustard", 1.0, 0.0003, "mustard"), tmp_path).mesh
    small = RobotSettings(
        probes=1, camera=CameraSettings(width=96), bubbles=BubbleSettings(width=64)
    )
    log = tmp_path / "log.mcap"
    made = simulate_log(log, CABINET_CONFIGURATIONS["cabinet_mustard"], mesh, 0, small)
    rig = OmegaConf.to_container(OmegaConf.load(CONF / "session" / "rig" / "cabinet.yaml"))
    rig["cameras"][0]["edge_reach"] = 2  # of fewer pixels than usual
    session = SensorsSession(session_settings("sensors", {"path": str(log), "rig": rig}), 0)
    (probe,) = probes(session.probes())
    object_from_world = inverse(made.world_from_object)
    heights = mesh_sdf(mesh, apply(object_from_world, probe.contacts))[0]
    assert len(heights) >= 30
    assert np.abs(heights).mean() < 0.001
    assert np.abs(heights).max() < 0.003
    free = mesh_sdf(mesh, apply(object_from_world, probe.new_points.free))[0]
    assert len(free) > 5000
    assert free.min() > -0.02  # a coarse image with strays at edges
    assert (free < 0.0).mean() < 0.01
    lost = [counts.lost for counts in session.report.total().values()]
    assert sum(lost) == 0
