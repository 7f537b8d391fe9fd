"""A session goes on from its recording, and another branch asks what other touches would have said.

`touches.mcap` is Friday's file: its last touches are all on one side of the object.
"""

import tempfile
from pathlib import Path

import trimesh
from own_robot import MUSTARD, TRUTH

import chsel

folder = Path(tempfile.mkdtemp())
friday = folder / "touches.mcap"
mesh = chsel.load_mesh(MUSTARD)
surface = mesh.copy().apply_transform(TRUTH)
contacts = trimesh.sample.sample_surface(surface, 60, seed=0)[0]
middle = TRUTH[:3, 3]
near = contacts[contacts[:, 0] < middle[0]][:8]
far = contacts[contacts[:, 0] > middle[0]][:8]

with chsel.Session(mesh, record=friday) as session:
    for n in (0, 4):
        session.add(contacts=near[n : n + 4])
        session.register()
    print(f"Friday, step {session.step}: {session.trust}")

with chsel.Session.resume(friday, record=folder / "monday.mcap") as session:
    session.add(contacts=far)
    session.register()
    print(f"Monday, step {session.step}: {session.trust}")

with chsel.Session.resume(friday, step=0, record=folder / "branch.mcap") as session:
    session.add(contacts=far[:4])
    session.register()
    print(f"had the second touches been there, step {session.step}: {session.trust}")
