"""A camera and a hand add to one session at once; each call waits for those before it."""

import threading

import numpy as np
import trimesh
from own_robot import MUSTARD, TRUTH

import chsel

mesh = chsel.load_mesh(MUSTARD)
surface = mesh.copy().apply_transform(TRUTH)
contacts = trimesh.sample.sample_surface(surface, 20, seed=0)[0]
camera = chsel.PinholeCamera(32, 24, fx=60.0, fy=60.0, cx=15.5, cy=11.5)
above = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.9], [0, 0, 0, 1]])
above[:2, 3] = TRUTH[:2, 3] + [0.4, 0.0]  # beside the object, so that what it sees is the table


def look(session):
    for _ in range(5):
        table = np.full((24, 32), above[2, 3])
        session.add(depth=table, camera=camera, world_from_camera=above)


def touch(session):
    for n in range(0, 20, 4):
        session.add(contacts=contacts[n : n + 4])


workspace = chsel.Workspace(TRUTH[:3, 3] - 0.3, TRUTH[:3, 3] + 0.3)
with chsel.Session(mesh, workspace=workspace) as session:
    threads = [threading.Thread(target=one, args=[session]) for one in (look, touch)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    session.register()
    print(f"{session.step + 1} additions, {len(session.points.contacts)} contacts:", session.trust)
