"""Small objects and known points around them, made up at random."""

from collections.abc import Callable

import numpy as np

from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import apply, compose, random_rotations
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from tests.chsel.samples import ball_grid

WORKSPACE = Workspace((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
RESOLUTION = 0.02


def ball(radius=0.1, resolution=RESOLUTION):
    """A ball around the origin."""
    return ball_grid(radius, resolution, half=int(np.ceil((radius + 0.05) / resolution)))


def box(half, resolution=RESOLUTION):
    """A box around the origin; half (3,): of its sides."""
    counts = 2 * np.ceil((half + 0.06) / resolution).astype(int) + 1
    origin = -(counts // 2) * resolution
    nodes = origin[:, None, None, None] + np.indices(counts) * resolution
    over = np.abs(nodes) - half[:, None, None, None]
    outside = np.sqrt((np.maximum(over, 0.0) ** 2).sum(axis=0))
    values = outside + np.minimum(over.max(axis=0), 0.0)
    away = np.maximum(over, 0.0) * np.sign(nodes)
    inner = np.where(over == over.max(axis=0), np.sign(nodes), 0.0)
    gradient = np.where(outside > 0.0, away / np.maximum(outside, 1e-12), inner)
    return SdfGrid(origin, resolution, values=values, gradients=np.moveaxis(gradient, 0, -1))


def noise(stream):
    """Numbers that are no distance to anything, but for a border that is outside.

    On most faces of the border, gradients point out of it.
    """
    shape = tuple(stream.integers(4, 9, 3))
    values = stream.normal(0.0, 0.05, shape)
    border = np.ones(shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    values[border] = np.abs(values[border]) + 1e-3
    gradients = stream.normal(size=(*shape, 3))
    for axis in range(3):
        normals = np.moveaxis(gradients[..., axis], axis, 0)
        for end, sign in ((0, -1.0), (-1, 1.0)):
            if stream.uniform() < 0.9:
                normals[end] = sign * np.abs(normals[end])
    return SdfGrid(stream.uniform(-0.1, 0.0, 3), 0.03, values=values, gradients=gradients)


OBJECTS: dict[str, Callable[[np.random.Generator], SdfGrid]] = {
    "ball": lambda stream: ball(float(stream.uniform(0.05, 0.12))),
    "box": lambda stream: box(stream.uniform(0.03, 0.12, 3)),
    "noise": noise,
}


def scene(stream, sdf, *, far=0.0):
    """A problem with points of every class, and a pose (4, 4) for the truth; `far` off 0."""
    rotation = random_rotations(stream, 1)
    truth = compose(rotation, far + stream.uniform(-0.1, 0.1, (1, 3)))[0]
    middle = sdf.bounds.mean(axis=0)
    span = np.ptp(sdf.bounds, axis=0)

    def around(count, size):
        return apply(truth, middle + stream.uniform(-size, size, (count, 3)) * span)

    free = around(int(stream.integers(0, 60)), 0.9)
    if stream.integers(2) and len(free):
        free = np.unique(np.rint(free / 0.03), axis=0) * 0.03
    known = around(int(stream.integers(0, 12)), 0.5)
    inside = sdf.at(apply(np.linalg.inv(truth), known))[0] if len(known) else []
    values = np.asarray(inside) * stream.integers(0, 2, len(known))
    occupied = around(int(stream.integers(0, 4)), 0.1)
    points = KnownPoints(free, occupied, known=known, known_sdf=values)
    if points.count == 0:
        points = KnownPoints(known=truth[None, :3, 3])
    start = np.eye(4)[None]
    return RegistrationProblem(
        sdf=sdf,
        points=points,
        initial_set=start,
        workspace=WORKSPACE,
        free_resolution=0.03,
        key=StreamKey(7, 2),
    ), truth
