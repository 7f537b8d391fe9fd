"""Contact points and a mesh of your own: the poses that explain them, and how far to trust these.

python examples/own_points.py [MESH POINTS.csv]: in metres, a point x,y,z of the world in each line
"""

import sys
from pathlib import Path

import numpy as np

import chsel

MUSTARD = Path(__file__).parents[1] / "runners/objects/models/mustard.ply"
TOUCHED = """0.5028,0.0938,0.0758
0.4150,0.0868,0.0875
0.4975,0.1099,0.1242
0.4865,0.1167,0.0385
0.4418,0.1275,0.0385
0.4748,0.0907,0.1766
0.4480,0.0695,0.0452
0.4488,0.0688,0.0795
0.4800,0.0645,0.0621
0.4456,0.0743,0.1638
0.4102,0.0947,0.0270
0.4511,0.1049,0.1836"""

files = sys.argv[1:] or (MUSTARD, TOUCHED.splitlines())
mesh = chsel.load_mesh(files[0])
contacts = np.loadtxt(files[1], delimiter=",", ndmin=2)
hypotheses = chsel.register(mesh, contacts=contacts)
print(f"{len(contacts)} contacts: {hypotheses.trust}")
for index in hypotheses.trust.best_of_modes:
    world_from_object = hypotheses.world_from_object[index]
    print(f"world_from_object of a mode:\n{world_from_object.round(3)}")
