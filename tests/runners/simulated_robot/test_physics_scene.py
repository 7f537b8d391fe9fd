"""The simulated robot's world: scene, membranes and noise."""

from contextlib import closing

import numpy as np
import pytest
import trimesh

from chsel.errors import SessionError
from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.streams import Purpose, StreamKey
from runners.objects.loader import load_model
from runners.sessions.physics_engine import ENGINES
from runners.simulated_robot import cabinet
from runners.simulated_robot.cabinet import (
    CABINET_CONFIGURATIONS,
    CAP,
    CAP_BASE,
    REST,
    SHELF,
    stood_on_shelf,
)
from runners.simulated_robot.noise import (
    BASELINE,
    BUBBLE_NOISE,
    LOST,
    NOISE,
    bubble_depth,
    stereo_depth,
)
from runners.simulated_robot.pads import TAUTNESS, Membrane
from runners.simulated_robot.settings import BubbleSettings, CameraSettings
from runners.simulated_robot.simulation import open_scene

MESH = load_model("drill")
POSE = stood_on_shelf(MESH, CABINET_CONFIGURATIONS["cabinet_drill"])
HAND = cabinet.world_from_wrist(np.add(REST, [0.12, 0.0, 0.0]))
EXACT = 2e-5  # m


@pytest.fixture(scope="module", params=ENGINES)
def scene(request):
    pytest.importorskip(request.param, reason=f"{request.param} is not installed")
    with closing(open_scene(MESH, POSE, engine=request.param)) as scene:
        yield scene


def solid(hand):
    parts = [cabinet.mesh_of(cabinet.CABINET + cabinet.ROOM), MESH.copy().apply_transform(POSE)]
    parts += [cabinet.whole_mesh().apply_transform(HAND)] if hand else []
    return trimesh.util.concatenate(parts)


def cast(mesh, camera, *, pose):
    """Depth (H, W) of the first hit of every pixel's ray; camera.far where there is none."""
    x, y, _ = camera.directions().reshape(-1, 3).T
    directions = np.stack([x, y, np.ones(len(x))], axis=1) @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    places, rays, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    depth = np.full(len(x), camera.far)
    depth[rays] = np.minimum((places - pose[:3, 3]) @ pose[:3, 2], camera.far)
    return depth.reshape(camera.height, camera.width)


def agreement(seen, exact):
    """Part of the pixels that agree; along silhouettes a ray may pass on either side."""
    return float((np.abs(seen - exact) < EXACT).mean())


@pytest.mark.parametrize("hand", [False, True])
def test_the_outer_camera_sees_exact_depths(scene, hand):
    camera = CameraSettings(width=160).pinhole
    pose = cabinet.world_from_camera()
    seen = scene.depth(camera, pose, world_from_wrist=HAND) if hand else scene.depth(camera, pose)
    assert agreement(seen, cast(solid(hand), camera, pose=pose)) > 0.998


def test_a_bubble_camera_sees_the_object_but_not_its_own_housing(scene):
    camera = BubbleSettings(width=112).pinhole
    pose = HAND @ cabinet.wrist_from_bubble_camera("right")
    seen = scene.depth(camera, pose)
    assert agreement(seen, cast(solid(False), camera, pose=pose)) > 0.998
    assert seen.min() > 0.06


def blocked(scene, *position):
    return scene.is_blocked(cabinet.world_from_wrist(np.array(position)))


def test_the_hand_is_blocked_where_it_touches_a_wall_or_the_object(scene):
    side = cabinet.mesh_of(cabinet.rigid_parts()).bounds[1, 1]  # the hand's y is the world's
    for gap in (0.010, 0.0005, -0.0005, -0.010):
        assert blocked(scene, 0.75, 0.22 - gap - side, 0.45) == (gap < 0.0)
    hand = cabinet.mesh_of(cabinet.rigid_parts())
    points, _ = trimesh.remesh.subdivide_to_size(hand.vertices, hand.faces, 0.002)
    outcomes = []
    for x in np.arange(0.68, 0.80, 0.004):
        placed = apply(cabinet.world_from_wrist(np.array([x, 0.02, 0.45])), points)
        distance = mesh_sdf(MESH, apply(inverse(POSE), placed))[0].min()
        if abs(distance) > 0.0005:
            assert blocked(scene, x, 0.02, 0.45) == (distance < 0.0)
            outcomes.append(distance < 0.0)
    assert {*outcomes} == {True, False}
    assert not blocked(scene, 0.2, 0.0, 0.9)


@pytest.mark.parametrize("name", CABINET_CONFIGURATIONS)
def test_objects_stand_on_the_shelf_within_the_workspace(name):
    configuration = CABINET_CONFIGURATIONS[name]
    mesh = load_model(configuration.object)
    pose = stood_on_shelf(mesh, configuration)
    placed = apply(pose, mesh.vertices)
    assert placed[:, 2].min() == pytest.approx(SHELF, abs=1e-9)
    assert (placed.max(axis=0) < configuration.workspace.upper).all()
    assert np.allclose(apply(pose, mesh.center_mass[None])[0, :2], configuration.position[:2])
    assert np.allclose(pose[:3, 2], [0.0, 0.0, 1.0], atol=0.02)  # upright
    with pytest.raises(SessionError, match="more than the cabinet has"):
        stood_on_shelf(mesh.apply_scale(2.5), configuration)


CAMERA = BubbleSettings().pinhole
APEX = CAP_BASE + CAP[2]


@pytest.fixture(scope="module")
def membrane():
    return Membrane(CAMERA)


def test_the_untouched_membrane_is_half_an_ellipsoid(membrane):
    x, y = CAMERA.directions()[..., :2].transpose(2, 0, 1)
    points = np.stack([x * membrane.rest, y * membrane.rest, membrane.rest - CAP_BASE], axis=-1)
    soft = membrane.rest > CAP_BASE
    assert np.allclose(((points[soft] / CAP) ** 2).sum(axis=-1), 1.0, atol=1e-12)
    assert membrane.rest.max() == pytest.approx(APEX, abs=1e-6)
    beside = points[~soft]
    assert (((beside[:, :2] / CAP[:2]) ** 2).sum(axis=-1) >= 1.0 - 1e-12).all()
    assert 0.7 < soft.mean() < 0.8  # an ellipse in its rectangle: pi / 4


def test_a_plane_flattens_what_it_reaches(membrane):
    plane = APEX - 0.005
    depth = membrane.pressed(np.full(membrane.rest.shape, plane))
    reached = membrane.rest > plane
    deep = membrane.rest > plane + 0.002
    assert np.allclose(depth[deep], plane, atol=1e-12)
    # Where a taut sheet leaves a plane it does so without a kink, a little before the plane does.
    assert (depth[reached] <= plane + 1e-12).all()
    assert (depth[reached] > plane - 0.001).all()
    assert (depth <= membrane.rest).all()
    assert (depth[~reached] < membrane.rest[~reached]).any()


def test_no_object_goes_through_the_base(membrane):
    depth = membrane.pressed(np.full(membrane.rest.shape, 0.02))
    assert (depth >= np.minimum(membrane.rest, CAP_BASE)).all()
    assert (depth[membrane.rest <= CAP_BASE] == CAP_BASE).all()


@pytest.mark.parametrize("width", [224, 112])
def test_beside_a_straight_edge_the_dent_falls_as_that_of_a_taut_sheet(width):
    camera = BubbleSettings(width=width).pinhole
    wide = Membrane(camera)
    beyond = np.full(wide.rest.shape, 1.0)
    beyond[:, : width // 2] = wide.rest[:, : width // 2] - 0.004
    dent = (wide.rest - wide.pressed(beyond))[camera.height // 2]
    pitch = APEX / camera.fx
    away = round(TAUTNESS / pitch)
    edge = width // 2 - 1
    assert dent[edge] == pytest.approx(0.004, abs=1e-12)
    expected = 0.004 * np.exp(-away * pitch / TAUTNESS)
    assert dent[edge + away] == pytest.approx(expected, rel=0.05)


PINHOLE = CameraSettings(width=320).pinhole
CLOSE, FAR = 0.5, 0.9
LEFT, RIGHT = 120, 200  # columns of a bar before a wall


def stream(index=0):
    return StreamKey(7, 0).stream(Purpose.SENSOR_NOISE, index)


@pytest.fixture(scope="module")
def bar():
    """True depths of a bar before a wall, metres, and measured ones, millimetres."""
    depth = np.full((PINHOLE.height, PINHOLE.width), FAR)
    depth[:, LEFT:RIGHT] = CLOSE
    return depth, stereo_depth(depth, PINHOLE, stream=stream())


@pytest.mark.parametrize("distance", [0.5, 1.0, 2.0])
def test_noise_away_from_edges_grows_with_the_depth_squared(distance):
    measured = stereo_depth(
        np.full((PINHOLE.height, PINHOLE.width), distance), PINHOLE, stream=stream()
    )
    assert measured.dtype == np.uint16
    error = measured[measured > 0] / 1000.0 - distance
    expected = np.sqrt((NOISE * distance**2) ** 2 + 0.001**2 / 12.0)  # and rounding
    assert error.std() == pytest.approx(expected, rel=0.02)
    assert abs(error.mean()) < 1e-4
    assert (measured == 0).mean() == pytest.approx(LOST, rel=0.2)


def test_edges_are_where_the_camera_is_worst(bar):
    depth, measured = bar
    wrong = (measured > 0) & (np.abs(measured / 1000.0 - depth) > 0.05)
    columns = np.arange(PINHOLE.width)
    band = (np.abs(columns - LEFT) < 3) | (np.abs(columns - RIGHT) < 3)
    far_off = (np.abs(columns - LEFT) > 40) & (np.abs(columns - RIGHT) > 40)
    assert wrong[:, band].mean() > 0.1
    assert (measured[:, band] == 0).mean() > 0.2
    assert wrong[:, far_off].mean() == 0.0
    assert (measured[:, far_off] == 0).mean() < 0.01
    # Some pixels at edges float between both sides.
    between = (measured > 1000 * (CLOSE + 0.05)) & (measured < 1000 * (FAR - 0.05))
    assert between.sum() > PINHOLE.height / 4
    assert not between[:, (np.abs(columns - LEFT) >= 12) & (np.abs(columns - RIGHT) >= 12)].any()


def test_the_shadow_of_the_second_eye_is_as_wide_as_geometry_says(bar):
    _, measured = bar
    width = PINHOLE.fx * BASELINE * (1.0 / CLOSE - 1.0 / FAR)
    lost = (measured == 0).mean(axis=0)
    inside = lost[round(LEFT - width) + 3 : LEFT - 3]
    assert (inside > 0.6).all()
    assert lost[round(LEFT - width) - 8] < 0.1
    assert lost[RIGHT + 8] < 0.1  # only on the left, as the second eye is on the right


def test_a_bubble_camera_is_noisy_by_what_it_says():
    measured = bubble_depth(np.full((171, 224), 0.07), stream())
    assert measured.dtype == np.float32
    good = measured[measured > 0]
    assert good.std() == pytest.approx(np.sqrt(BUBBLE_NOISE**2 + 0.0001**2 / 12), rel=0.02)
    assert good.mean() == pytest.approx(0.07, abs=1e-5)
    assert 0 < (measured == 0).sum() < 0.003 * measured.size
