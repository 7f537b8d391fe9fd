"""Objects in the cabinet; the engine's depth images and contacts against exact geometry."""

import sys
from contextlib import closing

import numpy as np
import pytest
import trimesh

from chsel.errors import SessionError
from chsel.problem.poses import apply
from runners.objects.loader import load_model
from runners.simulated_robot import cabinet
from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS, REST, SHELF, stood_on_shelf
from runners.simulated_robot.physics_scene import NEAR, PhysicsScene
from runners.simulated_robot.settings import BubbleSettings, CameraSettings

pytest.importorskip("pybullet", reason="PyBullet has wheels for Python 3.11 only")

MESH = load_model("drill")
POSE = stood_on_shelf(MESH, CABINET_CONFIGURATIONS["cabinet_drill"])
HAND = cabinet.world_from_wrist(np.add(REST, [0.12, 0.0, 0.0]))
EXACT = 2e-5  # m


@pytest.fixture(scope="module")
def scene():
    with closing(PhysicsScene(MESH, POSE)) as scene:
        yield scene


def solid(hand):
    parts = [cabinet.mesh_of(cabinet.CABINET + cabinet.ROOM), MESH.copy().apply_transform(POSE)]
    parts += [cabinet.whole_mesh().apply_transform(HAND)] if hand else []
    return trimesh.util.concatenate(parts)


def cast(mesh, camera, pose):
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
    camera, pose = CameraSettings(width=160).pinhole, cabinet.world_from_camera()
    seen = scene.depth(camera, pose, *[HAND] * hand)
    assert agreement(seen, cast(solid(hand), camera, pose)) > 0.998


def test_a_bubble_camera_sees_the_object_but_not_its_own_housing(scene):
    camera = BubbleSettings(width=112).pinhole
    pose = HAND @ cabinet.wrist_from_bubble_camera("right")
    seen = scene.depth(camera, pose)
    assert agreement(seen, cast(solid(False), camera, pose)) > 0.998
    assert seen.min() > 0.06


def test_clearance_is_the_distance_to_what_is_nearest(scene):
    side = cabinet.mesh_of(cabinet.rigid_parts()).bounds[1, 1]  # the hand's y is the world's
    for gap in (0.010, 0.003, -0.002):
        beside_wall = np.array([0.75, 0.22 - gap - side, 0.45])
        seen = scene.clearance(cabinet.world_from_wrist(beside_wall))
        assert seen == pytest.approx(gap, abs=1e-4)
    assert scene.clearance(cabinet.world_from_wrist(np.array([0.2, 0.0, 0.9]))) == NEAR


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


def test_a_missing_engine_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(SessionError, match="PyBullet is not installed"):
        PhysicsScene(MESH, POSE)
