"""A hand feels two objects at once: which touch was of which, and where is each?"""

import numpy as np
import trimesh
from own_robot import MUSTARD, TRUTH

import chsel
from chsel.problem.poses import axis_angle, compose

CAN = MUSTARD.with_name("spam_can.ply")
beside = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.5)), TRUTH[:3, 3] + [0.13, 0, 0])
truths = {"mustard": TRUTH, "can": beside}
meshes = {"mustard": chsel.load_mesh(MUSTARD), "can": chsel.load_mesh(CAN)}
touches = {
    name: trimesh.sample.sample_surface(mesh.copy().apply_transform(truths[name]), 10, seed=4)[0]
    for name, mesh in meshes.items()
}
workspace = chsel.Workspace(TRUTH[:3, 3] - 0.3, TRUTH[:3, 3] + 0.4)

with chsel.Scene(meshes, workspace=workspace) as scene:
    for n in range(0, 10, 2):  # two on each, and nobody says which is which
        scene.add(contacts=np.concatenate([touches[name][n : n + 2] for name in meshes]))
        objects = scene.register()
    print("touches are of:", ", ".join(scene.owners))
    for name, one in objects.items():
        x, y, z = 1e3 * one.world_from_object[:3, 3]
        print(f"{name}: at ({x:.0f}, {y:.0f}, {z:.0f}) mm, {one.answer.trust}")
