"""One depth image in place of a log: files, labels, warnings and refusals."""

import dataclasses
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image

import chsel
from chsel.errors import SessionError
from chsel.problem.mesh import load_mesh
from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.settings import build_settings
from chsel.sensing.depth_camera import one_per_voxel
from runners.command.choices import CONF
from runners.objects.loader import ObjectModel
from runners.sensors.depth_frame import depth_frame_points, read_depth_frame
from runners.sensors.rig import GateRig, Rig
from runners.sessions.sensors import SensorsSettings, open_sensors

MODEL = ObjectModel(
    "box", trimesh.creation.box((0.15, 0.1, 0.05)), scale=1.0, epsilon=0.001, configuration="box"
)
WIDTH, HEIGHT = 80, 60
INTRINSICS = {"fx": 100.0, "fy": 110.0, "cx": 39.5, "cy": 29.5}
BOX = (slice(20, 40), slice(30, 60))  # pixels of a box that faces the camera
FRONT, WALL = 0.5, 0.9  # m
POSE = [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def far(metres):
    """A pose (4, 4) so far away."""
    pose = np.eye(4)
    pose[0, 3] = metres
    return pose.tolist()


def rig(**camera):
    values = yaml.safe_load((CONF / "session" / "rig" / "depth_frame.yaml").read_text())
    built = build_settings(Rig, values, where="session.rig")
    (only,) = built.cameras
    return dataclasses.replace(built, cameras=(dataclasses.replace(only, **camera),))


def scene():
    """Depths (H, W) in millimetres of a box before a wall, and the label image."""
    depth = np.full((HEIGHT, WIDTH), 1000 * WALL, dtype=np.uint16)
    depth[BOX] = 1000 * FRONT
    depth[:, :5] = 0
    label = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    label[BOX] = 7
    return depth, label


def written(folder, **changes):
    """A frame's YAML with its images beside it; None takes a key away."""
    depth, label = scene()
    Image.fromarray(depth).save(folder / "depth.png")
    Image.fromarray(label).save(folder / "label.png")
    values = {"depth": "depth.png", "depth_scale": 0.001, "intrinsics": INTRINSICS}
    values |= {"label": "label.png", "object_class": 7, "factor_depth_in_file": 1000, **changes}
    values = {key: value for key, value in values.items() if value is not None}
    path = folder / "frame.yaml"
    path.write_text(json.dumps(values))
    return path


def test_the_lens_of_a_frame_is_undone_in_depth_and_label(tmp_path):
    """A barrel: what is off the axis was shown nearer to it, and comes back outside."""
    frame = read_depth_frame(written(tmp_path, distortion=[-1.2, 0.05, 0.0, 0.0, 0.0]))
    plain = read_depth_frame(written(tmp_path))
    rows, columns = np.nonzero(frame.label)
    x = (columns.max() - INTRINSICS["cx"]) / INTRINSICS["fx"]
    y = (rows.min() - INTRINSICS["cy"]) / INTRINSICS["fy"]
    squared = x * x + y * y
    shown = INTRINSICS["cx"] + INTRINSICS["fx"] * x * (1 - 1.2 * squared + 0.05 * squared**2)
    assert shown == pytest.approx(np.nonzero(plain.label)[1].max(), abs=1.0)
    assert columns.max() > np.nonzero(plain.label)[1].max()
    assert frame.depth[frame.label].max() < FRONT + 1e-9
    with pytest.raises(SessionError, match=r"frame\.yaml: distortion plumb_bob has coefficients"):
        read_depth_frame(written(tmp_path, distortion=[0.1]))


@pytest.mark.parametrize("name", ["opencv_4", "opencv_5", "ros"])
def test_a_calibration_is_that_of_the_numbers_in_it(name, tmp_path):
    """Files by cv::FileStorage of OpenCV 4.12 and 5.0, and by ROS 1's camera_calibration_parsers.

    They have the INTRINSICS and the barrel of the test above.
    """
    calibration = str(Path(__file__).parent / "calibration" / f"{name}.yaml")
    found = read_depth_frame(written(tmp_path, intrinsics=None, calibration=calibration))
    stated = read_depth_frame(written(tmp_path, distortion=[-1.2, 0.05, 0.0, 0.0, 0.0]))
    assert found.camera == stated.camera
    np.testing.assert_array_equal(found.depth, stated.depth)
    np.testing.assert_array_equal(found.label, stated.label)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (("image_width: 80", "image_width: 640"), "image_width is 640, and that of the image 80"),
        (("camera_matrix:", "M1:"), "no camera_matrix; it has image_width, image_height"),
        (("0.050000000000000003, 0, ", ""), "distortion plumb_bob has coefficients"),
        (("plumb_bob", "warped"), "distortion model is 'warped'"),
        (("[100, 0,", "[100,"), "camera_matrix has 8 numbers"),
    ],
)
def test_a_calibration_that_is_of_another_camera_or_form_is_one_line(changed, message, tmp_path):
    text = (Path(__file__).parent / "calibration" / "ros.yaml").read_text()
    (tmp_path / "camera.yaml").write_text(text.replace(*changed))
    with pytest.raises(SessionError, match=rf"calibration .*camera\.yaml: {message}"):
        read_depth_frame(written(tmp_path, intrinsics=None, calibration="camera.yaml"))


def test_a_frame_has_intrinsics_or_a_calibration(tmp_path):
    for changes in ({"intrinsics": None}, {"calibration": "camera.yaml"}):
        with pytest.raises(SessionError, match="accepted: intrinsics, or calibration"):
            read_depth_frame(written(tmp_path, **changes))
    twice = {"intrinsics": None, "calibration": "camera.yaml", "distortion": [0.1] * 5}
    with pytest.raises(SessionError, match="calibration and distortion; accepted: one"):
        read_depth_frame(written(tmp_path, **twice))


def test_a_frame_is_read_with_all_its_parts(tmp_path):
    rounded = [[round(value, 6) for value in row] for row in POSE]
    path = written(
        tmp_path, world_from_camera=POSE, world_from_object=rounded, object="sub/box.obj"
    )
    frame = read_depth_frame(path)
    assert frame.depth[30, 45] == pytest.approx(FRONT)
    assert frame.depth[0, 0] == 0.0
    assert (frame.camera.width, frame.camera.height, frame.camera.fy) == (WIDTH, HEIGHT, 110.0)
    assert int(frame.label.sum()) == 20 * 30
    np.testing.assert_allclose(frame.world_from_camera, POSE)
    np.testing.assert_allclose(frame.world_from_object, POSE)
    assert frame.mesh == tmp_path / "sub" / "box.obj"
    plain = read_depth_frame(written(tmp_path, depth_scale=None, label=None, object_class=None))
    assert plain.depth.max() == pytest.approx(WALL)  # integers are millimetres
    assert (plain.label, plain.world_from_object, plain.mesh) == (None, None, None)
    np.testing.assert_array_equal(plain.world_from_camera, np.eye(4))
    every = read_depth_frame(written(tmp_path, object_class=None)).label  # all but 0
    np.testing.assert_array_equal(every, frame.label)
    metres = (scene()[0] / 1000.0).astype(np.float32)  # as floating point is
    metres[0, 10] = np.nan
    np.save(tmp_path / "depth.npy", metres)
    Image.fromarray(metres).save(tmp_path / "depth.tiff")
    for name in ("depth.npy", "depth.tiff"):
        frame = read_depth_frame(written(tmp_path, depth=name, depth_scale=None))
        np.testing.assert_array_equal(frame.depth, metres.astype(float))


def tiff(values, sample_format):
    """A TIFF of one strip, little endian. sample_format: 1 unsigned, 2 signed, 3 floating point."""
    height, width = values.shape
    data = values.tobytes()
    bits = 8 * values.itemsize
    tags = {256: width, 257: height, 258: bits, 259: 1, 262: 1, 273: 8, 277: 1, 278: height}
    tags |= {279: len(data), 339: sample_format}
    entries = [struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items()]
    start = struct.pack("<2sHI", b"II", 42, 8 + len(data))
    return start + data + struct.pack("<H", len(tags)) + b"".join(entries) + bytes(4)


def test_whole_numbers_of_a_tiff_are_what_they_are(tmp_path):
    stored = np.full((HEIGHT, WIDTH), 3_000_000_000, dtype="<u4")  # above 2^31
    (tmp_path / "depth.tiff").write_bytes(tiff(stored, 1))
    frame = read_depth_frame(written(tmp_path, depth="depth.tiff", depth_scale=1e-9))
    np.testing.assert_allclose(frame.depth, 3.0)
    signed = np.where(np.arange(WIDTH) < 9, -1, 2000).astype("<i4") + np.zeros((HEIGHT, 1), "<i4")
    (tmp_path / "depth.tiff").write_bytes(tiff(signed, 2))
    frame = read_depth_frame(written(tmp_path, depth="depth.tiff"))
    assert sorted(set(frame.depth.reshape(-1))) == [-0.001, 2.0]
    (tmp_path / "depth.tiff").write_bytes(tiff(np.full((HEIGHT, WIDTH), 0.5, "<f8"), 3))
    with pytest.raises(SessionError, match=r"or float32 \(tifffile writes numpy's float64"):
        read_depth_frame(written(tmp_path, depth="depth.tiff"))


@pytest.mark.parametrize("number", ["1e-3", "1E-3", "+1.e-3", ".1e-2", "0.001", "1.0e-3"])
def test_numbers_of_yaml_are_those_of_json(tmp_path, number):
    path = written(tmp_path)
    path.write_text(path.read_text().replace('"depth_scale": 0.001', f"depth_scale: {number}"))
    assert read_depth_frame(path).depth[30, 45] == FRONT
    path.write_text(path.read_text().replace(f"depth_scale: {number}", "depth_scale: e3"))
    with pytest.raises(SessionError, match=r"depth_scale is 'e3'"):
        read_depth_frame(path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, None),
        ({"world_from_camera": far(0.98)}, None),
        (
            {"world_from_camera": far(980.0)},
            "world_from_camera is 980 m from the origin; check",
        ),
        (
            {"world_from_object": far(980.0)},
            "world_from_object is 980 m from the origin; check",
        ),
        (
            {"intrinsics": INTRINSICS | {"cx": 29.5, "cy": 39.5}},
            "camera: cx, cy are 29.5, 39.5, for an image of 80 x 60 pixels",
        ),
    ],
)
def test_what_is_suspicious_is_told(tmp_path, changes, said):
    settings = SensorsSettings(rig(), str(written(tmp_path, **changes)))
    session = open_sensors(settings, MODEL, seed=0)
    assert list(session.probes())
    told = [text for level, text in session.report.lines if level == "warning"]
    assert [text[: len(said or "")] for text in told] == ([said] if said else [])


def test_a_camera_that_looks_past_the_workspace_is_told(tmp_path):
    past = dataclasses.replace(rig(), workspace=((3.0, 3.4), (0.0, 0.4), (0.0, 0.4)))
    path = written(tmp_path, label=None, object_class=None)
    session = open_sensors(SensorsSettings(past, str(path)), MODEL, seed=0)
    assert list(session.probes())
    told = [text for level, text in session.report.lines if level == "warning"]
    assert [text[:40] for text in told] == ["camera: its rays miss the workspace; che"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": None}, "frame lacks depth$"),
        ({"depth": "none.png"}, r"depth .*none\.png: .*No such file"),
        ({"depth": "frame.yaml"}, r"depth .*frame\.yaml: of no known kind"),
        ({"depth": "label.png"}, r"depth .*label\.png: 8 bits a pixel"),
        ({"label": None}, "object_class without label"),
        ({"object_class": 8}, "object_class 8 is not in label; accepted: 0, 7"),
        ({"label": "other.npy"}, r"label .*other\.npy: 3 x 2 pixels .*accepted: .* 80 x 60"),
        ({"label": "cut.png"}, r"label .*cut\.png: .*accepted: \.png"),
        ({"label": "colour.png"}, r"label .*colour\.png: uint8 of shape \(60, 80, 3\)"),
        ({"world_from_camera": POSE[:3]}, r"world_from_camera has shape \(3, 4\)"),
        ({"world_from_object": (2 * np.eye(4)).tolist()}, "world_from_object.* not a rigid"),
    ],
)
def test_broken_frames_are_refused_in_a_line(tmp_path, changes, message):
    path = written(tmp_path, **changes)
    np.save(tmp_path / "other.npy", np.ones((2, 3), dtype=np.uint8))
    (tmp_path / "cut.png").write_bytes((tmp_path / "label.png").read_bytes()[:60])
    Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(tmp_path / "colour.png")
    with pytest.raises(SessionError, match=message) as caught:
        read_depth_frame(path)
    assert str(caught.value).startswith(f"depth frame {path}: ")
    assert "\n" not in str(caught.value)


def points_of(frame, own=None):
    return depth_frame_points(frame, own or rig(), free_resolution=0.01, diameter=0.3)


def test_surface_points_are_the_boxes_front_without_its_outline(tmp_path):
    frame = read_depth_frame(written(tmp_path, world_from_camera=POSE))
    found = points_of(frame)
    expected = np.zeros((HEIGHT, WIDTH), dtype=bool)
    expected[23:37, 33:57] = True  # 3 pixels within: the reach of an edge of depth
    np.testing.assert_array_equal(found.surface, expected)
    in_camera = apply(inverse(frame.world_from_camera), found.points.known)
    np.testing.assert_allclose(in_camera[:, 2], FRONT, atol=1e-12)
    assert in_camera[:, 0].min() == pytest.approx((33 - 39.5) / 100 * FRONT)
    assert in_camera[:, 1].max() == pytest.approx((36 - 29.5) / 110 * FRONT)
    assert found.labelled.edges == 600 - 14 * 24  # inside of the outline
    assert found.counts.edges == found.labelled.edges + 26 * 36 - 600  # and outside
    assert found.counts.invalid == HEIGHT * 5
    # No outline is wider.
    assert int(found.rays.sum()) == HEIGHT * WIDTH - HEIGHT * 5 - found.counts.edges
    points = frame_points(frame, found)
    bounds = [points.min(axis=0) - 0.3, points.max(axis=0) + 0.3]
    np.testing.assert_allclose(found.workspace.bounds, bounds)
    # Where no edge of depth is, two pixels are left out of the label.
    flat = dataclasses.replace(frame, depth=np.full_like(frame.depth, FRONT))
    expected[22:38, 32:58] = True
    for chosen in (rig(), rig(edge=None)):
        np.testing.assert_array_equal(points_of(flat, chosen).surface, expected)


def test_a_label_that_reaches_the_border_of_the_image_keeps_its_pixels_there(tmp_path):
    """Nothing else is beside it there: the object goes on outside of the image."""
    frame = read_depth_frame(written(tmp_path))
    label = np.zeros((HEIGHT, WIDTH), dtype=bool)
    label[40:, 60:] = True
    flat = dataclasses.replace(frame, depth=np.full_like(frame.depth, FRONT), label=label)
    expected = np.zeros_like(label)
    expected[42:, 62:] = True  # two pixels within the outline
    found = points_of(flat)
    np.testing.assert_array_equal(found.surface, expected)
    assert found.labelled.outline == label.sum() - expected.sum()
    assert found.labelled.invalid == found.labelled.edges == 0
    none = flat.depth.copy()
    none[50:, 70:] = none[:5, :5] = 0.0
    assert points_of(dataclasses.replace(flat, depth=none)).labelled.invalid == 10 * 10


@pytest.mark.parametrize(
    ("blob", "depth", "kept", "reason"),
    [
        ((slice(28, 32), slice(40, 44)), 0.55, False, "small"),  # 50 mm behind, at once
        ((slice(28, 32), slice(40, 44)), 0.515, True, "none"),  # as an inclined surface could be
        ((slice(20, 40), slice(30, 41)), 0.56, True, "none"),  # a part beside an occluder
        ((slice(20, 40), slice(30, 41)), WALL, False, "far"),  # further than the object is long
    ],
)
def test_pixels_of_a_label_that_are_not_connected_are_left_out(tmp_path, blob, depth, kept, reason):
    frame = read_depth_frame(written(tmp_path))
    frame.depth[blob] = depth
    found = points_of(frame, rig(edge_reach=1))
    labelled = found.labelled
    assert bool(found.surface[blob].any()) is kept
    assert {"small": labelled.small > 0, "far": labelled.far > 0, "none": kept}[reason]
    assert (labelled.small > 0) + (labelled.far > 0) == (not kept)
    if not kept:  # and no ray passes through the object there
        assert not found.rays[blob].any()
        free = np.abs(found.points.free - [0.0, 0.0, 0.56]).max(axis=1) < 0.03
        assert not free.any() or reason == "far"
    assert found.points.known[:, 2].max() == pytest.approx(depth if kept else FRONT)


def test_few_pixels_of_another_depth_give_no_rays(tmp_path):
    frame = read_depth_frame(written(tmp_path, label=None, object_class=None))
    bounds = ((-0.3, 0.3), (-0.3, 0.3), (0.3, 1.5))
    own = dataclasses.replace(rig(), workspace=bounds)
    frame.depth[0:9, 60:69] = 1.4
    found = depth_frame_points(frame, own, free_resolution=0.02)
    assert found.counts.small == 6 * 3  # but for the edge around them
    assert found.points.free[:, 2].max() < WALL
    every = dataclasses.replace(own, gate=GateRig(speckle=18))
    assert depth_frame_points(frame, every, free_resolution=0.02).points.free[:, 2].max() > 1.3


def frame_points(frame, found):
    """World points of all surface pixels."""
    return apply(frame.world_from_camera, frame.camera.back_project(frame.depth)[found.surface])


def test_free_space_is_what_rays_passed(tmp_path):
    frame = read_depth_frame(written(tmp_path))
    found = points_of(frame)
    free = found.points.free
    column = np.rint(free[:, 0] / free[:, 2] * 100 + 39.5).astype(int)
    row = np.rint(free[:, 1] / free[:, 2] * 110 + 29.5).astype(int)
    behind = free[:, 2] > 0.95 * FRONT + 0.01
    # Behind the box's front, no ray went but beside it, a voxel's half diagonal away or more.
    within = (column > 33) & (column < 56) & (row > 23) & (row < 36)
    assert not (behind & within).any()
    assert (behind & ~within).any()
    assert free[within][:, 2].max() > 0.95 * FRONT - 0.01
    assert free[:, 2].max() < 0.95 * WALL + 0.01
    closer = points_of(frame, rig(fraction=1.0)).points.free
    assert len(closer) > len(free)
    # No centre is so near to the surface that it may lie behind.
    on_object = frame_points(frame, found)
    distances = np.linalg.norm(closer[:, None] - on_object[None, ::5], axis=-1)
    assert distances.min() > np.sqrt(0.75) * 0.01


def test_one_point_a_voxel_is_kept_the_one_nearest_its_centre():
    points = np.array([[0.004, 0, 0], [0.011, 0, 0], [0.001, 0.001, 0], [0.01, 0, 0]])
    np.testing.assert_array_equal(one_per_voxel(points, 0.01), points[[2, 3]])
    assert one_per_voxel(np.zeros((0, 3)), 0.01).shape == (0, 3)


def real_frame(folder, name):
    """A frame, its points, its mesh, and the signed distances of surface points at its pose."""
    path = folder / "ycbv_000001" / name
    if not path.is_file():
        pytest.skip(f"optional data directory has no real/ycbv_000001/{name}")
    frame = read_depth_frame(path)
    mesh = load_mesh(frame.mesh or folder / "ycbv_foam_brick.obj")
    diameter = float(np.linalg.norm(mesh.extents))
    found = depth_frame_points(frame, rig(), free_resolution=0.01, diameter=diameter)
    truth = inverse(frame.world_from_object)
    return frame, found, mesh, mesh_sdf(mesh, apply(truth, found.points.known))[0]


def test_the_real_frame_registers_near_its_published_pose(real_directory):
    frame, found, mesh, distance = real_frame(real_directory, "frame.yaml")
    points = found.points
    truth = inverse(frame.world_from_object)
    assert np.abs(distance).mean() < 0.0008
    assert np.abs(distance).max() < 0.0035  # no pixel of the background is among them
    assert mesh_sdf(mesh, apply(truth, points.free))[0].min() > -0.002  # free space is outside
    assert len(points.known) > 400
    assert len(points.free) > 10_000
    hypotheses = chsel.register(
        mesh, contacts=points.known, free=points.free, workspace=found.workspace, seed=1
    )
    best = hypotheses.object_from_world[int(np.argmin(hypotheses.cost))]
    assert np.abs(mesh_sdf(mesh, apply(best, points.known))[0]).mean() < 0.004
    centre = mesh.bounds.mean(axis=0)[None]  # the same place, whichever way round the box is found
    miss = apply(inverse(best), centre) - apply(frame.world_from_object, centre)
    assert np.linalg.norm(miss) < 0.015


def test_the_real_frame_of_a_brick_has_no_point_off_it_and_no_free_voxel_in_it(real_directory):
    frame, found, mesh, distance = real_frame(real_directory, "frame_foam_brick.yaml")
    assert found.labelled.small == 50  # a patch 26 mm behind the brick, at its upper edge
    assert np.abs(distance).max() < 0.0035
    truth = inverse(frame.world_from_object)
    assert mesh_sdf(mesh, apply(truth, found.points.free))[0].min() > 0.0
    assert len(found.points.known) > 500
