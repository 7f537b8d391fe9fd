"""Decision problems that tests share: a ball, a hand, actions from around it."""

from functools import cache

import numpy as np
import trimesh

from chsel.next_probe.decision_problem import Actions, DecisionProblem, HandShape, WeightedPoses
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import compose
from chsel.problem.streams import StreamKey
from tests.chsel.samples import ball_grid

RADIUS = 0.05
WORKSPACE = Workspace((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3))


@cache
def box_hand():
    """A box of 4 cm by 2 cm, which ends at the origin of the hand."""
    box = trimesh.creation.box((0.04, 0.02, 0.1))
    box.apply_translation((0.0, 0.0, -0.05))
    return HandShape.of(box)


def facing(start, ahead):
    """Where a hand is, world_from_hand (4, 4), that starts at (3,) and moves along (3,)."""
    z = np.asarray(ahead, dtype=np.float64) / np.linalg.norm(ahead)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return compose(np.stack([x, np.cross(z, x), z], axis=1), np.asarray(start, dtype=np.float64))


def along_x(places, length=0.6):
    """Actions in +x from x = -0.3 at some y and z."""
    poses = np.array([facing(np.array([-0.3, y, z]), np.array([1.0, 0.0, 0.0])) for y, z in places])
    return Actions(poses, np.full(len(places), length))


def at(*centres):
    """Poses (K, 4, 4), object_from_world, with the object's origin at some places."""
    return compose(np.tile(np.eye(3), (len(centres), 1, 1)), -np.array(centres))


def ball_problem(poses, actions, *, weights=None, available=None, points=None, step=0, seed=7):
    """What to do about a ball that is in one of some poses."""
    if weights is None:
        weights = np.full(len(poses), 1.0 / len(poses))
    if available is None:
        available = np.ones(len(actions), dtype=bool)
    return DecisionProblem(
        sdf=ball(),
        points=points or KnownPoints(),
        workspace=WORKSPACE,
        free_resolution=0.01,
        belief=WeightedPoses(poses, weights),
        actions=actions,
        available=available,
        hand=box_hand(),
        key=StreamKey(seed, step),
    )


@cache
def ball():
    """The grid of the ball, 5 mm fine."""
    return ball_grid(RADIUS, 0.005, half=14)
