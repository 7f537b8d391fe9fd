"""A depth image shows one face of a box; two touches, from above and behind, settle its pose."""

import numpy as np
from own_robot import FINGER, MUSTARD, FakeRobot

import chsel

CAMERA = np.array([[140.0, 0.0, 59.5], [0.0, 140.0, 44.5], [0.0, 0.0, 1.0]])  # pixels
EYE = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, 0.1], [0, 0, 0, 1]])
ABOVE = np.array(
    [[1.0, 0.0, 0.0, 0.45], [0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, 0.4], [0, 0, 0, 1]]
)
BEHIND = np.array([[0.0, 0.0, -1.0, 0.7], [0.0, 1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.1], [0, 0, 0, 1]])
TRUTH = np.array([[0.0, -1.0, 0.0, 0.45], [1.0, 0.0, 0.0, 0.1], [0.0, 0.0, 1.0, 0.0], [0, 0, 0, 1]])


def rendered(scene):
    """Depth (90, 120) along the z axis of EYE, metres, 0 where there is nothing."""
    rows, columns = np.indices((90, 120)).reshape(2, -1)
    pixels = np.stack([columns, rows, np.ones_like(rows)])  # (3, N)
    rays = (EYE[:3, :3] @ np.linalg.inv(CAMERA) @ pixels).T
    starts = np.broadcast_to(EYE[:3, 3], rays.shape)
    hits, ray, _ = scene.ray.intersects_location(starts, rays, multiple_hits=False)
    depth = np.zeros(len(rays))
    depth[ray] = (hits - EYE[:3, 3]) @ EYE[:3, 2]
    return depth.reshape(90, 120)


mesh = chsel.load_mesh(MUSTARD.with_name("cracker_box.ply"))
robot = FakeRobot(mesh, TRUTH)
depth = rendered(robot.scene)
with chsel.Session(mesh) as session:
    session.add(depth=depth, mask=depth > 0.0, camera=CAMERA, world_from_camera=EYE)
    print(f"one look, {len(session.points.contacts)} points: {session.register().trust}")
    for start in (ABOVE, BEHIND):
        path, contact = robot.touch(start, 0.3)
        session.add(hand=FINGER, path=path, contact=contact)
    print(f"and two touches: {session.register().trust}")
