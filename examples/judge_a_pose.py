"""Another estimator says where the object is: do the touches bear it out, and what else would?"""

import numpy as np
import trimesh
from own_robot import MUSTARD, TRUTH

import chsel

mesh = chsel.load_mesh(MUSTARD)
surface = mesh.copy().apply_transform(TRUTH)
finger = trimesh.creation.box(bounds=[[-0.01, -0.01, -0.06], [0.01, 0.01, 0.0]])
contacts = trimesh.sample.sample_surface(surface, 16, seed=0)[0]

half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
beside = np.eye(4)
beside[0, 3] = 0.02
claims = {"right": TRUTH, "turned": TRUTH @ half_turn, "beside": beside @ TRUTH}

with chsel.Session(mesh, hand=finger) as session:
    session.add(contacts=contacts[:5])
    for step in ("five touches", "sixteen touches"):
        session.register()
        for name, pose in claims.items():
            print(f"{step}, {name}: {session.judge(pose)}")
        print(f"  by the touches: {session.trust}")
        probe = session.next_probe()
        if probe is not None:
            x, y, z = probe.world_from_hand[:3, 3]
            print(f"  what tells them apart: a touch from [{x:.2f}, {y:.2f}, {z:.2f}] m")
        session.add(contacts=contacts[5:])
