"""Makes problems.npz: `python -m tests.tools.make_problems`. New problems need new digests.

The numbers are stored because a mesh's signed distance, or a sine, may differ by machine.
"""

import argparse

import numpy as np

from chsel.problem.poses import apply, axis_angle, compose, inverse
from tests.chsel.samples import box_distance
from tests.determinism.stages import PROBLEMS_FILE

SPACING = 0.04  # of free points, metres
TILT = compose(axis_angle(np.array([0.0, 0.6, 0.8]), 0.7), np.array([0.2, 0.1, 0.3]))
STANDING = compose(axis_angle(np.array([0.0, 0.0, 1.0]), 2.0), np.array([0.2, 0.1, 0.3]))
WORKSPACE = np.array([[0.0, -0.1, 0.1], [0.4, 0.3, 0.5]])


def bracket(points):
    """Signed distance (N,) to flat faces, edges and corners, without symmetry."""
    arms = np.array([[0.2, 0.06, 0.05], [0.06, 0.14, 0.05], [0.06, 0.06, 0.1]])
    return np.min([box_distance(points - arm / 2.0, arm) for arm in arms], axis=0)


def mallet(points):
    """Signed distance (N,) to what is round all over: a handle with a head off its axis."""
    nearest = np.zeros_like(points)
    nearest[:, 0] = np.clip(points[:, 0], 0.0, 0.16)
    handle = np.sqrt(((points - nearest) ** 2).sum(axis=1)) - 0.025
    head = np.sqrt(((points - [0.15, 0.02, 0.01]) ** 2).sum(axis=1)) - 0.045
    return np.minimum(handle, head)


BODIES = {"bracket": (bracket, 0.0125), "mallet": (mallet, 0.015)}


def grid(name):
    """Signed distances and unit gradients in 32 bits on a grid around a body."""
    body, resolution = BODIES[name]
    around = np.argwhere(np.ones((40, 40, 40))) * 0.01 - 0.1
    inside = around[body(around) < 0.0]
    origin = inside.min(axis=0) - 0.04
    shape = np.floor((inside.max(axis=0) + 0.04 - origin) / resolution).astype(int) + 2
    nodes = origin + np.argwhere(np.ones(shape)) * resolution
    return {
        "origin": origin,
        "resolution": np.array(resolution),
        "values": body(nodes).reshape(shape).astype(np.float32),
        "gradients": slopes(body, nodes).reshape(*shape, 3).astype(np.float32),
    }


def slopes(body, points):
    """Unit gradients (N, 3) of a signed distance, by central differences."""
    rises = [body(points + step) - body(points - step) for step in 1e-6 * np.eye(3)]
    gradient = np.stack(rises, axis=1)
    length = np.sqrt((gradient**2).sum(axis=1, keepdims=True))
    return np.where(length > 1e-9, gradient / np.maximum(length, 1e-9), [1.0, 0.0, 0.0])


def points(name, world_from_object, contacts):
    """Contacts, points near the surface, points inside, and a lattice of free points."""
    body, _ = BODIES[name]
    stream = np.random.Generator(np.random.Philox(7))
    near = stream.uniform([-0.06, -0.06, -0.06], [0.22, 0.16, 0.12], (4000, 3))
    near = near[np.abs(body(near)) < 0.02]
    touched, felt = near[:contacts], near[contacts : contacts + 6]
    touched = touched - body(touched)[:, None] * slopes(body, touched)
    lattice = np.argwhere(np.ones((15, 15, 15))) * SPACING + [-0.1, -0.2, 0.0]
    return {
        "contacts": apply(world_from_object, touched),
        "felt": apply(world_from_object, felt),
        "felt_sdf": body(felt),
        "occupied": apply(world_from_object, near[body(near) < -0.012][:5]),
        "free": lattice[body(apply(inverse(world_from_object), lattice)) > 0.03],
        "free_resolution": np.array(SPACING),
        "workspace": WORKSPACE,
    }


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    parts = {f"grid/{name}": grid(name) for name in BODIES}
    parts["points/bracket"] = points("bracket", TILT, 20)
    parts["points/standing"] = points("bracket", STANDING, 12)
    parts["points/mallet"] = points("mallet", TILT, 12)
    named = {
        f"{part}/{name}": array for part, held in parts.items() for name, array in held.items()
    }
    np.savez_compressed(PROBLEMS_FILE, **named)
    print(f"{PROBLEMS_FILE.name}: {PROBLEMS_FILE.stat().st_size} bytes")
