"""Grids, poses, results, and the files of kernels that tests share."""

import math
from pathlib import Path

import numpy as np

from chsel.problem.noise import EXTENT, INDEPENDENT, LATER, SHARE
from chsel.problem.poses import apply, compose, random_rotations
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.sdf_grid import SdfGrid

REPOSITORY = Path(__file__).resolve().parents[2]


def kernel_files():
    """The files of `chsel` that import the compiler of kernels."""
    files = (REPOSITORY / "chsel").rglob("*.py")
    return sorted(file for file in files if "from chsel.numerics.compiler" in file.read_text())


def ball_grid(radius, resolution, half):
    """The exact distance to a ball around the origin, `half` nodes to every side of it."""
    nodes = np.moveaxis(np.indices((2 * half + 1,) * 3), 0, -1) * resolution - half * resolution
    distance = np.sqrt((nodes**2).sum(axis=-1))
    safe = np.where(distance > 0.0, distance, 1.0)[..., None]
    gradient = np.where(distance[..., None] > 0.0, nodes / safe, [1.0, 0.0, 0.0])
    return SdfGrid(np.full(3, -half * resolution), resolution, distance - radius, gradient)


def box_distance(points, sides):
    """Signed distances (...) of points (..., 3) to a box around the origin."""
    beyond = np.abs(points) - 0.5 * sides
    outside = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=-1))
    return outside + np.minimum(beyond.max(axis=-1), 0.0)


def plain_energy(noise, residuals, depths):
    """E of one pose as chsel.problem.noise has it, of residuals (N,) and depths (M,), metres."""

    def density(size, sigma):
        normal = math.exp(-0.5 * (size / sigma) ** 2) / (math.sqrt(2.0 * math.pi) * sigma)
        return (1.0 - SHARE) * normal + SHARE / EXTENT

    power = min(1.0, INDEPENDENT / max(len(residuals), 1))
    sizes = [max(abs(r) - noise.shared, 0.0) for r in residuals]
    best = density(0.0, noise.sigmas[0])
    logs = [
        math.log(w) + power * sum(math.log(density(size, s) / best) for size in sizes)
        for s, w in zip(noise.sigmas, noise.weights, strict=True)
    ]
    most = max(logs)
    wrong = sum(
        min(max(depth - noise.shared, 0.0) ** 2 / (2.0 * noise.softness**2), noise.wrong)
        for depth in depths
    )
    if wrong > noise.wrong:
        wrong = noise.wrong + LATER * (wrong - noise.wrong)
    return -most - math.log(sum(math.exp(one - most) for one in logs)) + power * wrong


def plain_energies(noise, sdf, points, poses):
    """The same (B,) of poses, by distances between the nodes of a grid."""
    energies = []
    for pose in poses.matrices:
        known, free, occupied = (
            sdf.at(apply(pose, group), lookup="trilinear")[0]
            for group in (points.known, points.free, points.occupied)
        )
        depths = np.concatenate([-free, occupied])
        wrong = depths[depths > 0.0]  # others cost nothing
        energies.append(plain_energy(noise, known - points.sdf, wrong))
    return np.array(energies)


def random_poses(stream, count, reach):
    """Transforms (count, 4, 4) of any rotation, translated by at most `reach` along each axis."""
    rotations = random_rotations(stream, count)
    return compose(rotations, stream.uniform(-reach, reach, (count, 3)))


def hypotheses_at(object_from_world, duplicate=None):
    """A result of poses (B, 4, 4) at the costs 0, 1, 2, ..., from no archive."""
    count = len(object_from_world)
    return Hypotheses(
        object_from_world=object_from_world,
        cost=np.arange(float(count)),
        duplicate=np.zeros(count, bool) if duplicate is None else np.array(duplicate, bool),
        cell=np.full(count, -1),
        elites=object_from_world,
    )
