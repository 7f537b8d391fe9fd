"""Sessions of raw logs: known answers, and logs that lack something."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from chsel.errors import SessionError, SettingError
from chsel.events import Logged, Probe, RigDescribed, SensorImage
from chsel.problem.poses import apply, compose, inverse
from runners.sensors.depth_camera import RECTIFIED
from runners.sensors.pose_file import beside, write_pose
from runners.sensors.rig import Annotations, CloudRig, ExtraContacts, HandRig, ProbeTimes
from runners.sessions.sensors import SensorsSettings, SensorsSource
from tests.replay.conftest import same_bits
from tests.runners.sensors.foxglove_log import in_foxgloves_messages
from tests.runners.sensors.sphere_log import (
    ASIDE,
    CENTRE,
    HAND_FROM_PAD,
    LIDAR,
    MEMBRANE,
    OUTER,
    PRESSED,
    RADIUS,
    RIG,
    WORLD_FROM_CAMERA,
    SphereLog,
    hand_pose,
    heights,
    seen,
)

SPACING = 0.01
DIAGONAL = 3**0.5 * SPACING


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return SphereLog().write(tmp_path_factory.mktemp("log") / "sphere.mcap")


@pytest.fixture(scope="module")
def events(log):
    return list(open_log(log).probes())


def open_log(path, rig=RIG, *, seed=0, **changes):
    return SensorsSource(SensorsSettings(rig, str(path), **changes), seed)


def probes(events):
    return [event for event in events if isinstance(event, Probe)]


def free_of(events):
    return np.concatenate([probe.new_points.free for probe in probes(events)])


def lines(events, level="warning"):
    found = [event for event in events if isinstance(event, Logged) and event.level == level]
    return "\n".join(event.text for event in found)


def test_contacts_lie_on_what_was_touched(events):
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


def test_free_space_is_where_rays_passed_and_the_hand_went(events, log):
    free = np.concatenate([open_log(log).initial_points.free, free_of(events)])
    assert len(np.unique(np.rint(free / 1e-6).astype(int), axis=0)) == len(free)
    assert heights(free).min() > -DIAGONAL
    known = cKDTree(free)
    depth = seen()
    edges = maximum_filter(depth, 3) - minimum_filter(depth, 3) > 0.05
    for fraction in (0.3, 0.6, 0.94):
        ways = (fraction * depth[..., None] * OUTER.directions())[~edges][::50]
        points = apply(WORLD_FROM_CAMERA, ways)
        lower, upper = np.array(RIG.workspace).T
        points = points[((points > lower) & (points < upper)).all(axis=1)]
        assert len(points) > 10
        assert (known.query(points, p=np.inf)[0] <= 0.5 * SPACING + 1e-9).all()
    nose = hand_pose(4.0) @ [0.0, 0.0, 0.08, 1.0]
    within_pad = hand_pose(2.0) @ HAND_FROM_PAD @ [0.0, 0.0, MEMBRANE - 0.03, 1.0]
    for place in (nose[:3] - [0.005, 0.0, 0.0], within_pad[:3]):
        assert known.query(place, p=np.inf)[0] <= 0.5 * SPACING + 1e-9
    assert known.query(np.add(CENTRE, [0.5 * RADIUS, 0.0, 0.0]))[0] > 0.01  # behind


def test_a_pad_frees_what_is_before_its_membrane_and_nothing_behind_it(log):
    free = free_of(open_log(log, replace(RIG, cameras=(), hand=None)).probes())
    assert len(free) > 100
    # A voxel is marked up to half its diagonal before the membrane, so no centre is in the sphere,
    # and none is beyond the furthest place of the membrane's plane.
    assert heights(free).min() > 0.0
    aside = np.abs(free[:, 1]) < ASIDE / 2
    assert free[aside, 0].max() < CENTRE[0] - RADIUS + PRESSED
    # What is a whole diagonal before the membrane at the end of the push is marked.
    end = hand_pose(2.0) @ HAND_FROM_PAD
    before = apply(end, np.array([[0.0, 0.0, MEMBRANE - PRESSED - DIAGONAL - 0.001]]))
    assert cKDTree(free).query(before, p=np.inf)[0] <= 0.5 * SPACING + 1e-9


def test_images_come_ahead_of_their_probe(events, log):
    kinds = [type(event) for event in events]
    assert kinds[0] is RigDescribed
    assert (events[0].name, events[0].step, events[0].hand.is_watertight) == ("sphere", -1, True)
    assert len(events[0].source) == 32
    first = kinds.index(Probe)
    camera, pad = (event for event in events[:first] if isinstance(event, SensorImage))
    assert (camera.sensor, camera.kind, camera.step) == ("camera", "depth", 0)
    assert (pad.sensor, pad.kind, pad.step) == ("pad", "deformation", 0)
    np.testing.assert_allclose(camera.values * camera.unit, seen(), atol=0.0011)
    np.testing.assert_allclose(camera.world_from_camera, WORLD_FROM_CAMERA, atol=1e-9)
    assert 0.9 < camera.mask.mean() < 1.0
    assert (pad.values * pad.unit).max() == pytest.approx(0.012, abs=0.001)
    assert (pad.values[pad.mask] * pad.unit > 0.0039).all()
    assert pad.mask.sum() > 50
    without = list(open_log(log, images=False).probes())
    assert not any(isinstance(event, SensorImage) for event in without)
    for one, other in zip(probes(events), probes(without), strict=True):
        assert one.new_points.digest == other.new_points.digest
    path = probes(events)[0].gripper_path
    assert 10 < len(path) <= 200
    np.testing.assert_allclose(path[0], hand_pose(0.0), atol=1e-9)
    furthest = path[np.argmax(path[:, 0, 3])]
    np.testing.assert_allclose(furthest[:3, 3], hand_pose(2.0)[:3, 3], atol=0.003)


def test_the_seed_chooses_among_contact_pixels_and_changes_nothing_else(events, log):
    session = open_log(log)
    again = probes(session.probes())[0]
    assert session.report.total()["pad"].contacts == 50
    other = probes(open_log(log, seed=1).probes())[0]
    first = probes(events)[0]
    assert again.new_points.digest == first.new_points.digest
    np.testing.assert_array_equal(other.new_points.free, first.new_points.free)
    assert len(other.contacts) == 50
    assert not np.array_equal(other.contacts, first.contacts)


def test_contacts_count_between_begin_and_end_alone(tmp_path, log):
    marks = ((0.5, "begin 3"), (1.2, "end 3"), (2.8, "begin 4"), (4.9, "end 4"))
    found = probes(open_log(SphereLog(marks=marks).write(tmp_path / "log.mcap")).probes())
    assert [(probe.step, probe.outcome) for probe in found] == [(3, "free"), (4, "free")]
    # What is seen between two probes is known with the first of them.
    assert len(found[0].new_points.free) > 10 * len(found[1].new_points.free)
    rig = replace(RIG, markers=None)  # the log is one probe
    (probe,) = probes(open_log(log, rig).probes())
    assert (probe.step, probe.outcome, len(probe.contacts)) == (0, "contact", 50)
    rig = replace(rig, probes=(ProbeTimes(1.0, 1.2), ProbeTimes(1.5, 3.0), ProbeTimes(3.0, 4.9)))
    found = probes(open_log(log, rig).probes())
    assert [probe.outcome for probe in found] == ["free", "contact", "free"]
    rig = replace(rig, probes=(ProbeTimes(1.0, 2.0), ProbeTimes(1.5, 3.0)))
    with pytest.raises(SettingError, match=r"probes\[1\] runs from 1.5 to 3.0 s; accepted: a begi"):
        open_log(log, rig)


def test_annotations_leave_out_and_add_contacts(log):
    added = ((0.9, 0.01, 0.41), (9.0, 0.0, 0.4), (0.9, 0.0, 0.41))
    annotations = Annotations((0,), (ExtraContacts(1, added), ExtraContacts(7, added)))
    events = list(open_log(log, replace(RIG, annotations=annotations)).probes())
    first, second = probes(events)
    assert (first.outcome, len(first.contacts)) == ("free", 0)
    np.testing.assert_array_equal(second.contacts, [added[0], added[2]])
    assert (second.contact_normals == 0.0).all()
    assert "annotates probe 7, which the log does not have" in lines(events)
    assert "probe 1: a contact left out, as it is out of the workspace" in lines(events)
    assert "probe 0: contacts left out" in lines(events, "info")
    with pytest.raises(SettingError, match=r"points\[1\] is not finite"):
        ExtraContacts(0, ((0.9, 0.0, 0.4), (0.9, float("nan"), 0.4)))


# The box of the rig, 2 cm aside of its place as long as the finger's joint is at 0.
HAND_URDF = """<robot name="hand"><link name="flange"/>
  <link name="pad"><collision><geometry><box size="0.04 0.06 0.08"/></geometry></collision></link>
  <joint name="finger" type="prismatic"><parent link="flange"/><child link="pad"/>
    <origin xyz="0 -0.02 0.04"/><axis xyz="0 1 0"/></joint></robot>"""


def test_a_hand_of_a_urdf_sweeps_what_its_boxes_sweep(tmp_path):
    pytest.importorskip("yourdfpy")
    (tmp_path / "hand.urdf").write_text(HAND_URDF)
    linked = HandRig("hand", urdf=str(tmp_path / "hand.urdf"), joints="/joint_states")
    found = []
    for hand, finger in ((RIG.hand, 0.02), (linked, 0.02), (linked, 0.05)):
        log = SphereLog(finger=finger).write(tmp_path / "log.mcap")
        session = open_log(log, replace(RIG, cameras=(), hand=hand))
        events = list(session.probes())
        swept = session.report.total()["hand"].free
        found.append((swept, free_of(events), events[0].hand.centroid))
    boxes, same, aside = found
    assert boxes[0] == same[0] > 200
    np.testing.assert_array_equal(boxes[1], same[1])
    np.testing.assert_allclose(same[2], boxes[2], atol=1e-9)
    np.testing.assert_allclose(aside[2], boxes[2] + [0.0, 0.03, 0.0], atol=1e-9)
    assert not np.array_equal(aside[1], boxes[1])
    with pytest.raises(SessionError, match=r"sphere names: /joint_states \(joints of the h"):
        open_log(SphereLog().write(tmp_path / "log.mcap"), replace(RIG, hand=linked))


@pytest.mark.parametrize("packed", [False, True])
def test_a_log_of_foxgloves_messages_gives_the_same_to_the_bit(events, log, tmp_path, packed):
    other = in_foxgloves_messages(log, tmp_path / "foxglove.mcap", packed=packed)
    again = list(open_log(other).probes())
    assert again[0].source != events[0].source
    again[0] = replace(again[0], source=events[0].source)
    for one, before in zip(again, events, strict=True):
        assert same_bits(one, before), f"{type(one).__name__} of probe {one.step}"


def test_clouds_are_rays_or_surface_or_contacts(tmp_path):
    cloud = ((0.2, 0.0, 0.0), (0.2, 0.0, 0.001), (np.nan, 0.0, 0.0), (9.0, 0.0, 0.0))
    log = SphereLog(cloud=cloud).write(tmp_path / "log.mcap")
    clouds = CloudRig("/lidar", "rays"), CloudRig("/skin", "contacts")
    rig = replace(RIG, cameras=(), hand=None, clouds=clouds)
    session = open_log(log, rig)
    events = list(session.probes())
    first, second = probes(events)
    assert len(first.contacts) == 51  # one of the cloud's two in a voxel; 9 m is out of the room
    np.testing.assert_allclose(first.contacts[-1], [0.92, 0.1, 0.55], atol=1e-6)
    assert len(second.contacts) == 0
    on_ray = (np.abs(first.new_points.free - LIDAR)[:, 1:] < 1e-9).all(axis=1)
    assert len(first.new_points.free[on_ray]) >= 18
    counts = session.report.by_probe[0]["/skin"]
    assert (counts.images, counts.used, counts.spared, counts.contacts) == (2, 1, 1, 1)
    surface = replace(rig, clouds=(CloudRig("/skin", "surface"),))
    first = probes(open_log(log, surface).probes())[0]
    assert (len(first.contacts), len(first.new_points.known)) == (50, 51)
    assert "/skin" not in lines(events)
    assert "/lidar" not in lines(events)


WRONG = {
    "topic": {"cameras": (replace(RIG.cameras[0], depth="/probe"),)},
    "unit": {"bubbles": (replace(RIG.bubbles[0], unit=0.001),)},  # the pad's are in metres
    "reference": {"bubbles": (replace(RIG.bubbles[0], kind="deformation"),)},
}


@pytest.mark.parametrize(
    ("written", "changes", "message"),
    [
        ({}, {"markers": "/marks"}, r"lacks what rig sphere names: /marks \(markers of probes\);"),
        (
            {"left_out": ("/camera/depth",)},
            {},
            r"/camera/depth \(depth of camera\); it has /camera/info \(sen",
        ),
        ({"left_out": ("/pad/info",)}, {}, r"/pad/info \(camera info of pad\)"),
        ({"left_out": ("/tf", "/tf_static")}, {}, r"camera: frame world is in no .* are none"),
        ({}, {"world": "map"}, r"camera: frame map is in no transform; there are camera_frame, ha"),
        ({}, {"workspace": None}, r"workspace is missing"),
        ({}, {"cameras": (), "bubbles": (), "hand": None}, r"rig sphere has no sensor"),
        ({"unit": 1.0}, {}, r"/camera/depth of camera has depths of 0.001 m \(medi"),
        ({}, WRONG["unit"], r"at 0.001 m a unit\); accepted: from 0.01 to 0.1 m"),
        ({}, WRONG["topic"], r"/probe of camera gives no depth images \(its schem"),
        ({}, WRONG["reference"], r"pad has images of deformation and no reference"),
    ],
)
def test_a_log_that_lacks_something_says_so(tmp_path, written, changes, message):
    log = SphereLog(**written).write(tmp_path / "log.mcap")
    with pytest.raises((SessionError, SettingError), match=message):
        open_log(log, replace(RIG, **changes))


def test_a_hole_in_the_transforms_costs_the_images_within(tmp_path):
    session = open_log(SphereLog(lost_transforms=(3.4, 4.6)).write(tmp_path / "log.mcap"))
    events = list(session.probes())
    first, second = probes(events)
    assert (len(first.contacts), second.outcome) == (50, "free")
    assert [session.report.by_probe[step]["pad"].lost for step in (0, 1)] == [0, 12]
    assert "pad: left out, as the pose of pad_frame is not known then (12 times)" in lines(events)


def test_a_camera_whose_clock_is_ahead_is_put_right(tmp_path, events):
    log = SphereLog(camera_clock=100.0).write(tmp_path / "log.mcap")
    ahead = list(open_log(log).probes())
    assert "/camera/depth is 100 s ahead of other topics'" in lines(ahead)
    for one, other in zip(probes(ahead), probes(events), strict=True):
        assert one.new_points.digest == other.new_points.digest


@pytest.mark.parametrize("step", [-4.4, 4.4])
def test_a_camera_whose_clock_is_set_is_put_right(tmp_path, events, step):
    log = SphereLog(camera_clock=step, camera_clock_set=2.4).write(tmp_path / "log.mcap")
    found = list(open_log(log).probes())
    assert f"stamps on /camera/depth start again or jump .* by {step:+g} s" in re.sub(
        "against the log's clock,", ".*", lines(found)
    )
    for one, other in zip(probes(found), probes(events), strict=True):
        assert one.new_points.digest == other.new_points.digest


K = [1.5 * OUTER.fx, 0.0, OUTER.cx, 0.0, 1.5 * OUTER.fy, OUTER.cy, 0.0, 0.0, 1.0]


def test_rectified_images_are_of_the_projection_matrix(tmp_path, log, events):
    """What the camera sees has the intrinsics P; K are those of images that are distorted."""
    wrong = SphereLog(info=(("k", K), ("d", [0.01, 0.0, 0.0, 0.0]))).write(tmp_path / "log.mcap")
    raw = list(open_log(wrong).probes())
    assert "camera: K and P of its camera info differ, and topic /camera/depth does not" in lines(
        raw
    )
    assert heights(free_of(raw)).min() < heights(free_of(events)).min() - 0.005  # in the sphere
    rectified = replace(RIG, cameras=(replace(RIG.cameras[0], rectified=True),))
    found = list(open_log(wrong, rectified).probes())
    assert "camera info" not in lines(found)
    for one, other in zip(probes(found), probes(events), strict=True):
        assert one.new_points.digest == other.new_points.digest
    plain = list(
        open_log(log, replace(RIG, cameras=(replace(RIG.cameras[0], rectified=False),))).probes()
    )
    for one, other in zip(probes(plain), probes(events), strict=True):
        assert one.new_points.digest == other.new_points.digest


def test_a_lens_of_an_unknown_model_is_refused_where_images_are_not_rectified(tmp_path):
    info = (("d", [0.1, 0.0, 0.0]), ("distortion_model", "own"))
    path = SphereLog(info=info).write(tmp_path / "log.mcap")
    with pytest.raises(SessionError, match="camera info of camera: distortion model is 'own'; acc"):
        open_log(path)
    rectified = replace(RIG, cameras=(replace(RIG.cameras[0], rectified=True),))
    assert list(open_log(path, rectified).probes())


@pytest.mark.parametrize(
    ("topic", "is_rectified"),
    [
        ("/camera/depth/image_rect_raw", True),
        ("/rect/depth", True),
        ("/depth/image_rectified", True),
        ("/cam/image_rect/compressedDepth", True),
        ("/camera/direct", False),
        ("/corrected/image_raw", False),
    ],
)
def test_topics_of_rectified_images_by_the_convention_of_ros(topic, is_rectified):
    assert (RECTIFIED.search(topic) is not None) == is_rectified


def test_exchanged_coordinates_of_the_principal_point_are_noticed(tmp_path, events):
    swapped = [OUTER.fx, 0.0, OUTER.cy, 0.0, OUTER.fy, OUTER.cx, 0.0, 0.0, 1.0]
    log = SphereLog(info=(("k", swapped), ("p", [0.0] * 12))).write(tmp_path / "log.mcap")
    told = lines(open_log(log).probes())
    assert "camera: cx, cy are 35.5, 47.5, for an image of 96 x 72" in told
    assert "cx, cy" not in lines(events)


BODY = compose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))


def test_a_sensor_that_gives_next_to_nothing_warns(tmp_path, events):
    assert "check" not in lines(events)
    body = WORLD_FROM_CAMERA @ inverse(BODY)  # x forward, as of a camera's housing
    told = lines(open_log(SphereLog(camera_frame=body).write(tmp_path / "log.mcap")).probes())
    assert "camera: its rays miss the workspace; check its frame, which must be the optical" in told
    assert "(all of 11 images)" in told
    elsewhere = replace(RIG, workspace=((5.0, 5.4), (-0.2, 0.2), (0.3, 0.6)))
    told = lines(open_log(SphereLog().write(tmp_path / "log.mcap"), elsewhere).probes())
    assert "camera: its rays miss the workspace" in told
    assert "pad: its 42 images give no contact and no free voxel; check its frame" in told
    assert "hand: none of its 101 poses brings it into the workspace" in told
    cloud = ((0.1, 0.1, 0.1),)
    log = SphereLog(cloud=cloud, marks=((3.0, "begin 0"), (4.0, "end 0"))).write(
        tmp_path / "log.mcap"
    )
    clouds = CloudRig("/lidar", "rays"), CloudRig("/skin", "contacts")
    told = lines(open_log(log, replace(elsewhere, clouds=clouds)).probes())
    assert "/lidar: its rays miss the workspace, their points are in the first message" in told
    assert "/skin: none of its 2 messages was of use: 2 outside of probes" in told
    empty = SphereLog(cloud=((np.nan, 0.0, 0.0),)).write(tmp_path / "log.mcap")
    told = lines(open_log(empty, replace(RIG, clouds=clouds)).probes())
    assert "/lidar: its 2 messages have no point that is finite" in told


def test_a_pose_that_is_lost_mostly_is_told_with_its_reason(tmp_path):
    log = SphereLog(lost_transforms=(0.1, 1.9)).write(tmp_path / "log.mcap")
    told = lines(open_log(log).probes())
    assert "pad: 18 of 51 poses of pad_frame are not known, and left out: world from pad_f" in told
    log = SphereLog(lost_transforms=(0.05, 9.9)).write(tmp_path / "log.mcap")
    told = lines(open_log(log).probes())
    assert "hand in world was sent once, which counts for 0.5 s; accepted: on tf_static" in told
    assert "pad: 45 of 51 poses of pad_frame are not known, and left out: hand in world" in told


def test_a_pose_beside_the_log_is_the_true_one(tmp_path):
    log = SphereLog().write(tmp_path / "log.mcap")
    assert open_log(log).world_from_object is None
    pose = np.eye(4)
    pose[:3, 3] = CENTRE
    write_pose(beside(log), pose, about={})
    session = open_log(log)
    np.testing.assert_array_equal(session.world_from_object, pose)
    events = list(session.probes())
    assert "the true pose is that of log.pose.yaml" in lines(events, "info")
    assert "workspace" not in lines(events)
    pose[:3, 3] *= 1000.0
    write_pose(beside(log), pose, about={}, overwrite=True)
    told = lines(open_log(log).probes())
    assert "pose of log.pose.yaml is 1e+03 m outside of the workspace; check its unit" in told
    pose[:3, 3] = CENTRE
    write_pose(beside(log), pose, about={}, overwrite=True)
    assert open_log(log, pose="none").world_from_object is None
    with pytest.raises(SessionError, match=r"other.yaml: cannot be read"):
        open_log(log, pose=str(tmp_path / "other.yaml"))
    with pytest.raises(SettingError, match=r"path is missing; pass session.path=LOG"):
        SensorsSettings(RIG)


def test_the_reference_of_a_pad_can_be_a_file(log, tmp_path):
    np.save(tmp_path / "small.npy", np.full((4, 4), 0.06))
    pad = replace(RIG.bubbles[0], reference=str(tmp_path / "small.npy"))
    with pytest.raises(SessionError, match=r"reference of pad has 4 x 4 pixels; accepted: .* 48 x"):
        open_log(log, replace(RIG, bubbles=(pad,)))
    np.save(tmp_path / "whole.npy", np.full((36, 48), MEMBRANE))
    pad = replace(RIG.bubbles[0], reference=str(tmp_path / "whole.npy"))
    found = probes(open_log(log, replace(RIG, bubbles=(pad,))).probes())
    assert np.abs(heights(found[0].contacts)).max() < 0.0015
