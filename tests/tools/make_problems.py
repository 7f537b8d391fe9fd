"""Makes problems.npz: `python -m tests.tools.make_problems`. New problems need new digests.

The numbers are stored because a mesh's signed distance, or a sine, may differ by machine.
"""

from __future__ import annotations

import argparse

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, axis_angle, compose, inverse
from tests.determinism.problems import PROBLEMS_FILE

SPACING = 0.04  # of free points, metres
TILT = compose(axis_angle(np.array([0.0, 0.6, 0.8]), 0.7), np.array([0.2, 0.1, 0.3]))
STANDING = compose(axis_angle(np.array([0.0, 0.0, 1.0]), 2.0), np.array([0.2, 0.1, 0.3]))
WORKSPACE = np.array([[0.0, -0.1, 0.1], [0.4, 0.3, 0.5]])


def box(points: FloatArray, lower: list[float], upper: list[float]) -> FloatArray:
    """Signed distance (N,) to a box."""
    centre, half = np.add(lower, upper) / 2.0, np.subtract(upper, lower) / 2.0
    beyond = np.abs(points - centre) - half
    outside = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=1))
    return outside + np.minimum(beyond.max(axis=1), 0.0)


def capsule(points: FloatArray, length: float, radius: float) -> FloatArray:
    """Signed distance (N,) to a capsule from the origin along x."""
    nearest = np.zeros_like(points)
    nearest[:, 0] = np.clip(points[:, 0], 0.0, length)
    return np.sqrt(((points - nearest) ** 2).sum(axis=1)) - radius


def bracket(points: FloatArray) -> FloatArray:
    """Flat faces, edges and corners, without symmetry."""
    arms = [[0.2, 0.06, 0.05], [0.06, 0.14, 0.05], [0.06, 0.06, 0.1]]
    return np.min([box(points, [0.0, 0.0, 0.0], arm) for arm in arms], axis=0)


def mallet(points: FloatArray) -> FloatArray:
    """Round all over: a handle with a head off its axis."""
    head = np.sqrt(((points - [0.15, 0.02, 0.01]) ** 2).sum(axis=1)) - 0.045
    return np.minimum(capsule(points, 0.16, 0.025), head)


BODIES = {"bracket": (bracket, 0.0125), "mallet": (mallet, 0.015)}


def grid(name: str) -> dict[str, FloatArray]:
    """Signed distances and unit gradients in 32 bits on a grid around a body."""
    body, resolution = BODIES[name]
    around = np.argwhere(np.ones((40, 40, 40))) * 0.01 - 0.1
    inside = around[body(around) < 0.0]
    origin = inside.min(axis=0) - 0.04
    shape = np.floor((inside.max(axis=0) + 0.04 - origin) / resolution).astype(int) + 2
    nodes = origin + np.argwhere(np.ones(shape)) * resolution
    values, gradients = body(nodes), slopes(body, nodes)
    return {
        "origin": origin,
        "resolution": np.array(resolution),
        "values": values.reshape(shape).astype(np.float32),
        "gradients": gradients.reshape(*shape, 3).astype(np.float32),
    }


def slopes(body: object, points: FloatArray) -> FloatArray:
    """Unit gradients (N, 3) of a signed distance, by central differences."""
    step = 1e-6 * np.eye(3)
    rises = [body(points + step[i]) - body(points - step[i]) for i in range(3)]  # type: ignore[operator]
    gradient = np.stack(rises, axis=1)
    length = np.sqrt((gradient**2).sum(axis=1, keepdims=True))
    return np.where(length > 1e-9, gradient / np.maximum(length, 1e-9), [1.0, 0.0, 0.0])


def points(name: str, world_from_object: FloatArray, contacts: int) -> dict[str, FloatArray]:
    """Contacts, points near the surface, points inside, and a lattice of free points."""
    body, _ = BODIES[name]
    stream = np.random.Generator(np.random.Philox(7))
    near = stream.uniform([-0.06, -0.06, -0.06], [0.22, 0.16, 0.12], (4000, 3))
    near = near[np.abs(body(near)) < 0.02]
    touched = near[:contacts] - body(near[:contacts])[:, None] * slopes(body, near[:contacts])
    felt = near[contacts : contacts + 6]
    inside = near[body(near) < -0.012][:5]
    lattice = np.argwhere(np.ones((15, 15, 15))) * SPACING + [-0.1, -0.2, 0.0]
    free = lattice[body(apply(inverse(world_from_object), lattice)) > 0.03]
    return {
        "contacts": apply(world_from_object, touched),
        "felt": apply(world_from_object, felt),
        "felt_sdf": body(felt),
        "occupied": apply(world_from_object, inside),
        "free": free,
        "free_resolution": np.array(SPACING),
        "workspace": WORKSPACE,
    }


def main() -> None:
    """Write the file."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    parts = {
        **{f"grid/{name}": grid(name) for name in BODIES},
        "points/bracket": points("bracket", TILT, 20),
        "points/standing": points("bracket", STANDING, 12),
        "points/mallet": points("mallet", TILT, 12),
    }
    arrays = {
        f"{part}/{name}": array for part, held in parts.items() for name, array in held.items()
    }
    np.savez_compressed(PROBLEMS_FILE, **arrays)
    print(f"{PROBLEMS_FILE.name}: {PROBLEMS_FILE.stat().st_size} bytes")
    print({name: array.shape for name, array in arrays.items()})


if __name__ == "__main__":
    main()
