"""Objects, points and poses that tests share, and search spaces in torch."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh

from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.problem.initial_sets import posed_problem
from chsel.problem.noise import EXTENT, FACET, INDEPENDENT, LATER, SHARE, WRONG_NORMALS
from chsel.problem.poses import apply, compose, hat, random_rotations
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE2Space

REPOSITORY = Path(__file__).resolve().parents[2]


def kernel_files():
    """The files of `chsel` that import the compiler of kernels."""
    files = (REPOSITORY / "chsel").rglob("*.py")
    return sorted(file for file in files if "from chsel.numerics.compiler" in file.read_text())


def ball_grid(radius, resolution, *, half):
    """The exact distance to a ball around the origin, `half` nodes to every side of it."""
    nodes = np.moveaxis(np.indices((2 * half + 1,) * 3), 0, -1) * resolution - half * resolution
    distance = np.sqrt((nodes**2).sum(axis=-1))
    safe = np.where(distance > 0.0, distance, 1.0)[..., None]
    gradient = np.where(distance[..., None] > 0.0, nodes / safe, [1.0, 0.0, 0.0])
    return SdfGrid(
        np.full(3, -half * resolution), resolution, values=distance - radius, gradients=gradient
    )


def bracket():
    """An L of 80 x 60 x 40 mm with walls of 6 mm, a corner at the origin."""
    parts = [trimesh.creation.box(bounds=[[0, 0, 0], top]) for top in ([80, 6, 40], [6, 60, 40])]
    return trimesh.boolean.union(parts).apply_scale(0.001)


def box_with_knob(sides):
    """A box with a knob beside the middle of its top, and points (24, 3) of its other sides.

    Turned by pi about its z axis, the body fits these points as well.
    """
    x, y, z = 0.5 * np.asarray(sides)
    knob = trimesh.creation.box(bounds=[[0.0, -y, z], [x, y, 1.5 * z]])
    body = trimesh.boolean.union([trimesh.creation.box(sides), knob], engine="manifold")
    points = np.random.default_rng(1).uniform(-0.45, 0.45, (24, 3)) * sides
    for n, (axis, sign) in enumerate([(0, 1), (0, -1), (1, 1), (1, -1), (2, -1)] * 5):
        if n < len(points):
            points[n, axis] = 0.5 * sign * sides[axis]
    return body, points


def box_distance(points, sides):
    """Signed distances (...) of points (..., 3) to a box around the origin."""
    beyond = np.abs(points) - 0.5 * sides
    outside = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=-1))
    return outside + np.minimum(beyond.max(axis=-1), 0.0)


def normal_density(sigma, cosine, length):
    """F of one normal as chsel.problem.noise has it; sigma: radians, 0 where there is none."""
    if sigma == 0.0:
        return 1.0
    b = 0.5 / (0.5 * sigma**2 + FACET**2 + 1.0 - length)
    right = (1.0 + 2.0 * b) ** 2 / ((1.0 + b) * (1.0 + b * (1.0 - cosine)) ** 3)
    return (1.0 - WRONG_NORMALS) * right + WRONG_NORMALS


def plain_energy(noise, residuals, *, depths, normals=None):
    """E of one pose as chsel.problem.noise has it, of residuals (N,) and depths (M,), metres.

    normals: of each residual the noise, radians, the cosine with the gradient, and its length.
    """
    normals = [(0.0, 1.0, 1.0)] * len(residuals) if normals is None else normals
    factors = [
        normal_density(max(s, bool(s) * noise.least_normal_noise), c, size)
        for s, c, size in normals
    ]
    peaks = [
        normal_density(max(s, bool(s) * noise.least_normal_noise), 1.0, 1.0) for s, _, _ in normals
    ]

    def density(size, sigma, factor):
        normal = math.exp(-0.5 * (size / sigma) ** 2) / (math.sqrt(2.0 * math.pi) * sigma)
        return (1.0 - SHARE) * normal * factor + SHARE / EXTENT

    power = min(1.0, INDEPENDENT / max(len(residuals), 1))
    sizes = [max(abs(r) - noise.shared, 0.0) for r in residuals]
    logs = [
        math.log(w)
        + power
        * sum(
            math.log(density(size, s, factor) / density(0.0, noise.sigmas[0], peak))
            for size, factor, peak in zip(sizes, factors, peaks, strict=True)
        )
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


def plain_energies(noise, sdf, *, points, poses):
    """The same (B,) of poses, by distances between the nodes of a grid."""
    energies = []
    for pose in poses.matrices:
        (known, gradients), (free, _), (occupied, _) = (
            sdf.at(apply(pose, group), lookup="trilinear")
            for group in (points.known, points.free, points.occupied)
        )
        lengths = np.linalg.norm(gradients, axis=1)
        along = (points.normals @ pose[:3, :3].T * gradients).sum(axis=1)
        normals = [*zip(points.normal_noise, along / lengths, lengths, strict=True)]
        depths = np.concatenate([-free, occupied])
        wrong = depths[depths > 0.0]  # others cost nothing
        energies.append(plain_energy(noise, known - points.sdf, depths=wrong, normals=normals))
    return np.array(energies)


def random_poses(stream, count, *, reach):
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


@dataclass(frozen=True)
class Scripted:
    """A method that finds given poses (K, 4, 4): the first set of them, then the next one."""

    script: list
    noise: float = 0.0005
    push_distance: float = 0.0

    @property
    def settings(self):
        """Those of a method with a setting for the sensor's noise."""
        return AnchoredSettings(noise=self.noise)

    @property
    def online(self):
        """As of other methods."""
        return self.settings.online

    def register(self, problem, observer=None):
        """The poses of the step."""
        poses = self.script[min(max(problem.key.step, 0), len(self.script) - 1)]
        return replace(hypotheses_at(poses), push_distance=self.push_distance)


def decode(space, vectors):
    """Rotations (B, 3, 3) and translations (B, 3) of vectors (B, d), differentiable."""
    if not isinstance(space, SE2Space):
        return _gram_schmidt(vectors[:, :6]), vectors[:, 6:9]
    turn = torch.tensor(hat(space.axis))
    rest = torch.tensor(space.resting_rotation)
    e_u, e_v, axis = (torch.tensor(part).double() for part in (space.e_u, space.e_v, space.axis))
    identity = torch.eye(3, dtype=torch.float64)
    sine, cosine = (f(vectors[:, 0])[:, None, None] for f in (torch.sin, torch.cos))
    about_axis = identity + sine * turn + (1.0 - cosine) * (axis[:, None] * axis - identity)
    return about_axis @ rest, vectors[:, 1:2] * e_u + vectors[:, 2:3] * e_v + space.offset * axis


def _gram_schmidt(rows):
    """Rotations (B, 3, 3) of raw 6-D vectors (B, 6) by Gram-Schmidt on two rows (Zhou et al.)."""
    b1 = _unit(rows[:, 0:3])
    second = rows[:, 3:6]
    b2 = _unit(second - (b1 * second).sum(dim=1, keepdim=True) * b1)
    return torch.stack([b1, b2, torch.linalg.cross(b1, b2)], dim=1)


def _unit(vectors):
    return vectors / vectors.norm(dim=1, keepdim=True).clamp_min(1e-12)


def pose_problem(sdf, points, workspace, free_resolution, key, settings, previous):
    """Return the problem of a step, as a loop poses it."""
    return posed_problem(
        sdf,
        points,
        workspace=workspace,
        free_resolution=free_resolution,
        key=key,
        settings=settings,
        previous=previous,
    )
