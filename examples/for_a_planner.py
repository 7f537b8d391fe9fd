"""What a filter, a controller and a planner take from the same touches."""

import numpy as np
import trimesh
from own_robot import MUSTARD, TRUTH

import chsel

mesh = chsel.load_mesh(MUSTARD)
surface = mesh.copy().apply_transform(TRUTH)
contacts = trimesh.sample.sample_surface(surface, 24, seed=0)[0]
corners = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 0.1

with chsel.Session(mesh) as session:
    for n in range(0, 24, 6):
        session.add(contacts=contacts[n : n + 6])
        session.register()
        belief = session.belief
        print(f"{n + 6} touches: {session.trust.verdict}")
        for mode in belief.modes:  # a filter: each is a pose with a covariance, under its number
            position = 1e3 * np.sqrt(np.trace(mode.pose_covariance[:3, :3]))
            turn = np.degrees(np.sqrt(np.trace(mode.pose_covariance[3:, 3:])))
            print(f"  mode {mode.number}, {mode.weight:.0%}: within {position:.1f} mm, {turn:.1f}°")
        x, y, z = 1e3 * session.pose[:3, 3]  # a controller: one pose that does not jump
        print(f"  one pose: ({x:.0f}, {y:.0f}, {z:.0f}) mm")
        ball = belief.ball  # a planner: one pose, and how far off it can be
        print(f"  or one that is off by {1e3 * ball.centre:.0f} mm at most")
        chance = belief.occupancy(TRUTH[:3, 3] + corners)  # of places on its way
        print("  the object is there:", ", ".join(f"{one:.0%}" for one in chance))
