"""A recorded session is verified, then its problems are solved by other methods.

In the shell: python -m replay verify FILE, python -m replay compare FILE --methods chsel icp
"""

import tempfile
from pathlib import Path

import trimesh
from own_robot import MUSTARD, TRUTH

import chsel
from replay.comparing.verification import verify
from replay.mcap.reader import read_recording

file = Path(tempfile.mkdtemp()) / "touches.mcap"
mesh = chsel.load_mesh(MUSTARD)
contacts = trimesh.sample.sample_surface(mesh.copy().apply_transform(TRUTH), 12, seed=0)[0]
with chsel.Session(mesh, record=file) as session:
    for n in (0, 4, 8):
        session.add(contacts=contacts[n : n + 4])
        session.register()

recording = read_recording(file)
print(f"recorded in {file.stat().st_size >> 10} kB, and registered again:")
for verdict in verify(recording):
    print(verdict.report())
for step in recording.steps:
    problem = recording.problem(step)
    for name in ("anchored", "chsel", "icp"):
        trust = chsel.trust_in(problem, chsel.build_method(name).register(problem))
        print(f"step {step}, {name}: {trust.verdict}, poses {1e3 * trust.spread:.1f} mm apart")
