"""The scene of tests of methods: an L (MESH, GRID) or a box (BOX, BOX_GRID) whose pose is TRUTH.

POINTS are 40 contacts with the L at TRUTH and the free voxels around it; `posed(method, points)` is
a problem of the L, `box_problem(points)` one of the box, and `energy_of(points, noise)` the energy
of poses of the box. A `Watcher` is an observer that keeps what it sees.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import trimesh

from chsel.methods.anchor_sampling import most_informative_first
from chsel.methods.anchored.energy import Energy
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse, product
from chsel.problem.registration_problem import (
    ArchiveSnapshot,
    NullObserver,
    RegistrationProblem,
)
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from tests.chsel.samples import pose_problem

# world_from_object: tilted, and upright
TRUTH = compose(axis_angle(np.array([0.0, 0.6, 0.8]), np.array(0.7)), np.array([0.2, 0.1, 0.3]))
STANDING = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(2.0)), np.array([0.2, 0.1, 0.3]))
WORKSPACE = Workspace((-0.1, -0.2, 0.0), (0.5, 0.4, 0.6))
SIDE = 0.025  # of free voxels, metres


def l_shape():
    """A body without symmetry."""
    arms = ([0.2, 0.06, 0.05], [0.06, 0.14, 0.05], [0.06, 0.06, 0.1])
    parts = [trimesh.creation.box(bounds=np.array([[0.0, 0.0, 0.0], arm])) for arm in arms]
    return trimesh.boolean.union(parts, engine="manifold")


MESH = l_shape()  # in its frame, 20 x 14 x 10 cm
GRID = SdfGrid.from_mesh(MESH, 0.01)
BOX_SIDES = np.array([0.2, 0.12, 0.08])
BOX = trimesh.creation.box(BOX_SIDES)
BOX_GRID = SdfGrid.from_mesh(BOX, 0.01)


def contacts_on(mesh, count):
    """Points (count, 3) all over a body at TRUTH."""
    return apply(TRUTH, np.asarray(trimesh.sample.sample_surface(mesh, count, seed=1)[0]))


def on_faces(count, height=0.0):
    """Points (count, 3) over the middles of the faces of BOX in turn, in its frame.

    height: above the surface, metres. Nearby, distances change as those from planes.
    """
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (count, 3)) * BOX_SIDES
    n = np.arange(count)
    sides = np.where(n // 3 % 2, 1.0, -1.0)
    points[n, n % 3] = sides * (0.5 * BOX_SIDES[n % 3] + height)
    return points


def box_problem(points):
    """Points of BOX, whatever its pose."""
    return RegistrationProblem(
        sdf=BOX_GRID,
        points=points,
        initial_set=np.eye(4)[None],
        workspace=WORKSPACE,
        free_resolution=0.03,
        key=StreamKey(5, 2),
    )


def energy_of(points, noise):
    """The energy of poses of BOX."""
    return Energy(box_problem(points), most_informative_first(points), noise=noise)


def poses_around_truth(count, shift, *, turn):
    """Poses turned by an angle, radians, and shifted in any direction by a length, metres."""
    random = np.random.default_rng(count)
    axes, ways = random.standard_normal((2, count, 3))
    axes /= np.sqrt((axes**2).sum(axis=1, keepdims=True))
    ways *= shift / np.sqrt((ways**2).sum(axis=1, keepdims=True))
    return Poses.of(inverse(TRUTH @ compose(axis_angle(axes, turn), ways)))


def known_points(world_from_object, contacts):
    """Contacts with the L, and the free voxels of the workspace that miss it."""
    surface = trimesh.sample.sample_surface(MESH, contacts, seed=1)[0]
    lower, upper = WORKSPACE.bounds
    counts = np.rint((upper - lower) / SIDE).astype(int)
    free = lower + SIDE * (0.5 + np.indices(counts).reshape(3, -1).T)
    sdf, _ = GRID.at(apply(inverse(world_from_object), free))
    return KnownPoints(free=free[sdf > SIDE], known=apply(world_from_object, surface))


POINTS = known_points(TRUTH, 40)
_FREE, _KNOWN = POINTS.free, POINTS.known
_INSIDE = apply(TRUTH, np.array([[0.03, 0.03, 0.03], [0.15, 0.03, 0.025]]))
ODD = {
    "one contact": KnownPoints(known=_KNOWN[:1]),
    "two contacts": KnownPoints(known=_KNOWN[:2]),
    "three contacts": KnownPoints(known=_KNOWN[:3]),
    "one place": KnownPoints(known=np.repeat(_KNOWN[:1], 20, axis=0)),
    "a line": KnownPoints(known=np.linspace([0.1, 0.1, 0.1], [0.3, 0.3, 0.3], 5)),
    "hundreds": known_points(TRUTH, 400),
    "free": KnownPoints(free=_FREE),
    "one voxel": KnownPoints(free=_FREE[:1]),
    "one voxel and contacts": KnownPoints(free=_FREE[:1], known=_KNOWN[:4]),
    "occupied": KnownPoints(occupied=_INSIDE),
    "occupied and contacts": KnownPoints(occupied=_INSIDE, known=_KNOWN[:3]),
    "depths": KnownPoints(known=_KNOWN[:4], known_sdf=[0.05, -0.01, 0.0, 0.3]),
    "contradictory": KnownPoints(free=_KNOWN, known=_KNOWN),
    "far": KnownPoints(free=_FREE + 1e6, known=_KNOWN + 1e6),
}
"""Points that tell little, or are hardly those of an object."""


def posed(method, points=POINTS, *, previous=None, sdf=GRID, **changes):
    """The problem that a method is given, with other fields as said."""
    key = StreamKey(3, 1)
    problem = pose_problem(
        sdf,
        points,
        workspace=WORKSPACE,
        free_resolution=SIDE,
        key=key,
        settings=method.online,
        previous=previous,
    )
    return replace(problem, **changes)


def around_truth(count=8, angle=0.3, *, shift=0.03):
    """E_0 (count, 4, 4), turned by an angle and shifted at random."""
    random = np.random.default_rng(3)
    axis = random.standard_normal((count, 3))
    axis /= np.sqrt((axis**2).sum(axis=1, keepdims=True))
    turn = product(axis_angle(axis, angle), TRUTH[:3, :3])
    return inverse(compose(turn, TRUTH[:3, 3] + shift * random.standard_normal((count, 3))))


class Trace(NamedTuple):
    """A state of a search that an observer sees."""

    stage: str
    iteration: int
    vectors: FloatArray  # (B, d)
    cost: FloatArray  # (B,)


@dataclass
class Watcher(NullObserver):
    """Keeps all that it is shown, and spoils the arrays."""

    snapshot_interval: int = 0

    def __post_init__(self):
        self.traces: list[Trace] = []
        self.progressed: list[tuple[str, int, int]] = []  # stage, iteration, total
        self.archives: list[ArchiveSnapshot] = []

    @property
    def iterations(self):
        """Those that were traced."""
        return [trace.iteration for trace in self.traces]

    def trace(self, stage, iteration, vectors, cost):
        """Keep copies."""
        self.traces.append(Trace(stage, iteration, vectors=vectors.copy(), cost=cost.copy()))
        vectors[:], cost[:] = np.nan, np.nan

    def progress(self, stage, iteration, total):
        """Keep the numbers."""
        self.progressed.append((stage, iteration, total))

    def snapshot(self, archive):
        """Keep it."""
        self.archives.append(archive)
