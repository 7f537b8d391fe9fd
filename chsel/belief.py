"""Beliefs about an object from hypotheses: where it can be, and whether an action would work.

All members count alike. So a chance is the share of the members for which something holds, with
Wilson's interval for their number (Wilson, 1927).
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from chsel.errors import PoseError, SettingError, require_at_most, require_positive
from chsel.events import Believed
from chsel.next_probe.decision_problem import HandShape
from chsel.numerics.arrays import FloatArray, IntArray, evenly_spaced, frozen
from chsel.plausible.symmetry import grid_symmetry
from chsel.problem.noise import LIMIT, noise_model
from chsel.problem.object_symmetry import ObjectSymmetry
from chsel.problem.pose_distances import distances_apart, turned
from chsel.problem.poses import (
    Poses,
    apply,
    compose,
    hat,
    inverse,
    nearest_rigid,
    product,
    rotated,
    rotation_angle,
    twice_sine_axis,
)
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem, Trust
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import CheckedSettings
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import signed_distances, surface_points
from chsel.problem.trust import SENSOR_NOISE, pose_energies
from chsel.sensing.free_space import interior_lattice

if TYPE_CHECKING:
    import trimesh

_CONFIDENCE = 0.9  # of intervals
# By how much the deviations of a mode are widened, after the sensor's noise is added: found on 92
# results of sessions with exact contacts, see docs/belief.md.
_WIDENED = 1.25
_LEVER = 0.25  # of the diameter: at which the sensor's noise turns a pose
_SAME_MODE = 0.1  # of the diameter: as far as a mode moves from one result to the next
_WIDEST = 2.0  # m: between fingers
_FINEST = 0.002  # m: nodes of a hand that collides
_NODES_ACROSS = 5.0  # of a hand
_DRAWN = 1500  # points of a surface
_TRIED = 6  # members at whose poses grasps of the object are tried


class Chances(NamedTuple):
    """Chances with their 90 % intervals."""

    chance: FloatArray  # (G,)
    lower: FloatArray  # (G,)
    upper: FloatArray  # (G,)


@dataclass(frozen=True, eq=False)
class Mode:
    """A place of the object that explains the points."""

    number: int  # the same from one result of a session to the next
    weight: float  # share of the members
    object_from_world: FloatArray  # (4, 4): the best member
    # (6, 6), of the others about it: of the object's centre (metres) and of the rotation vector
    # (radians), both in world axes, after the symmetry that brings each member nearest.
    covariance: FloatArray
    # (6, 6), the same, widened: of a normal distribution whose ellipsoid of 90 % holds the true
    # pose in 9 cases of 10, and more. Never singular, so filters and `PosePrior` take it.
    wide_covariance: FloatArray
    # (6, 6), the same of the origin of the object's frame in place of its centre, as
    # geometry_msgs/PoseWithCovariance of ROS has it.
    pose_covariance: FloatArray
    members: IntArray  # indices of poses

    @property
    def world_from_object(self) -> FloatArray:
        """Pose (4, 4) of the object in the world by the best member."""
        return inverse(self.object_from_world)

    @property
    def deviations(self) -> tuple[float, float]:
        """Root mean squares of how far members are off: of the centre, metres, and radians."""
        squares = np.diagonal(self.covariance)
        return float(np.sqrt(squares[:3].sum())), float(np.sqrt(squares[3:].sum()))


class Ball(NamedTuple):
    """A pose, and how far from it the farthest member is."""

    world_from_object: FloatArray  # (4, 4)
    radius: float  # root mean square distance of the surfaces, metres
    centre: float  # of the object's centre, metres
    turn: float  # radians, but for symmetries


@dataclass(frozen=True)
class Gripper(CheckedSettings):
    """Two parallel fingers; by default those of a Franka Panda hand. Metres.

    Its frame has z towards the object and y from finger to finger; the origin is in the middle
    between the fingers' tips.
    """

    width: float = 0.020  # of a finger, along x
    thickness: float = 0.014  # of a finger, along y
    length: float = 0.045  # of a finger, along z
    pad: float = 0.018  # of its length: what holds the object
    opening: float = 0.080  # the largest distance between the fingers

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in vars(self).items():
            require_positive(name, value)
            require_at_most(name, value, most=_WIDEST)


class PoseBelief:
    """The members of a result, and what they say.

    object_from_world (K, 4, 4): the members, the best first. modes: places that explain the points,
    the best first; empty where the result is wide, as a continuum has none, or where nothing fits.
    trust: in the result.
    """

    def __init__(
        self,
        sdf: SdfGrid,
        hypotheses: Hypotheses,
        *,
        symmetry: ObjectSymmetry | None = None,
        previous: PoseBelief | None = None,
        problem: RegistrationProblem | None = None,
        noise: float = SENSOR_NOISE,
    ) -> None:
        """symmetry: of the object, for covariances. previous: whose numbers modes keep.

        problem: whose points members have to explain, up to 9 nats above the lowest energy by the
        sensor's noise, metres; methods that keep poses for diversity keep others, too.
        Raises PoseError for a result without trust, as it has no pose.
        """
        if hypotheses.trust is None:
            raise PoseError("the result has no trust; accepted: that of chsel.register")
        kept = ~hypotheses.duplicate & np.isfinite(hypotheses.object_from_world).all(axis=(1, 2))
        if problem is not None:
            at = np.flatnonzero(kept)
            poses = Poses.of(hypotheses.object_from_world[at])
            carried = problem.carried(hypotheses.push_distance)
            energies = pose_energies(carried, poses, noise=noise_model(noise))
            kept[at[energies > energies.min(initial=np.inf) + LIMIT]] = False
        kept[list(hypotheses.trust.best_of_modes)] = True
        self.object_from_world: FloatArray = hypotheses.object_from_world[kept]
        self.trust: Trust = hypotheses.trust
        self._sdf = sdf
        self._poses = Poses.of(self.object_from_world)
        self._symmetry = symmetry or grid_symmetry(sdf)
        self._noise = noise
        places = np.cumsum(kept) - 1
        firsts = places[list(hypotheses.trust.best_of_modes)][: self.trust.modes]
        self.numbers: int = 0 if previous is None else previous.numbers  # given to modes so far
        self.modes: list[Mode] = self._modes(firsts, previous)
        # The last that there were, as results without modes come in between.
        self._known: list[Mode] = self.modes or ([] if previous is None else previous._known)

    def _modes(self, firsts: IntArray, previous: PoseBelief | None) -> list[Mode]:
        """Return the modes; a member is of that whose best is nearest and not turned against it."""
        if len(firsts) == 0:
            return []
        apart = distances_apart(self._sdf, self._poses)
        every = np.ones_like(apart, dtype=bool)
        apart = apart + np.where(
            turned(self._sdf, self._poses, pairs=every), apart.max() + 1.0, 0.0
        )
        mode = np.argmin(apart[firsts], axis=0)
        numbers = self._numbers(firsts, previous)
        found = []
        for n, first in enumerate(firsts):
            members = np.flatnonzero(mode == n)
            weight = len(members) / len(mode)
            best = self.object_from_world[first]
            off = pose_offsets(self._symmetry, best, others=self.object_from_world[members])
            covariance = np.asarray((off[:, :, None] * off[:, None]).mean(axis=0))
            wide = self._widened(covariance)
            found.append(
                Mode(
                    numbers[n],
                    weight,
                    object_from_world=best,
                    covariance=covariance,
                    wide_covariance=wide,
                    pose_covariance=self._at_origin(wide, best),
                    members=members,
                )
            )
        return found

    def _widened(self, covariance: FloatArray) -> FloatArray:
        """Return a covariance (6, 6) with the sensor's noise, and wider than the members are."""
        turn = self._noise / (_LEVER * self._sdf.diameter)
        own = np.diag(np.repeat([self._noise**2, turn**2], 3))
        return _WIDENED**2 * (covariance + own)

    def _at_origin(self, covariance: FloatArray, object_from_world: FloatArray) -> FloatArray:
        """Return the covariance (6, 6) with the frame's origin for the centre, for small turns."""
        rotation = object_from_world[:3, :3].T
        from_centre = -rotated(rotation, self._symmetry.centre[None])[0]  # to the origin, world
        moved = np.eye(6)
        moved[:3, 3:] = -hat(from_centre)  # a turn about the centre moves the origin
        return np.asarray(moved @ covariance @ moved.T)

    def _numbers(self, firsts: IntArray, previous: PoseBelief | None) -> list[int]:
        """Return numbers of modes: those of the nearest before, or new ones."""
        before = [] if previous is None else previous._known
        given: dict[int, int] = {}
        if before:
            old = Poses.of(np.stack([mode.object_from_world for mode in before]))
            both = Poses.joined([self._poses[firsts], old])
            apart = distances_apart(self._sdf, both)
            away = apart + np.where(turned(self._sdf, both, pairs=apart < np.inf), np.inf, 0.0)
            away = away[: len(firsts), len(firsts) :]
            for at in np.argsort(away, axis=None, kind="stable"):
                n, k = divmod(int(at), len(before))
                near = away[n, k] <= _SAME_MODE * self._sdf.diameter
                if near and n not in given and before[k].number not in given.values():
                    given[n] = before[k].number
        for n in range(len(firsts)):
            if n not in given:
                given[n] = self.numbers
                self.numbers = self.numbers + 1
        return [given[n] for n in range(len(firsts))]

    @property
    def world_from_object(self) -> FloatArray:
        """Poses (K, 4, 4) of the object in the world, by the members."""
        return inverse(self.object_from_world)

    def event(self, step: int) -> Believed:
        """Return the belief as recordings of a session have it."""
        poses = np.array([mode.object_from_world for mode in self.modes]).reshape(-1, 4, 4)
        return Believed(
            step,
            np.array([mode.number for mode in self.modes], dtype=np.int64),
            weights=np.array([mode.weight for mode in self.modes]),
            object_from_world=poses,
            centres=apply(inverse(poses), self._symmetry.centre[None])[:, 0],
            covariances=np.array([mode.covariance for mode in self.modes]).reshape(-1, 6, 6),
            spread=self.spread,
        )

    @cached_property
    def ball(self) -> Ball:
        """The member from which no other is as far as from all others, and how far they are.

        A planner that takes this pose is off by at most so much, if one of the members is right.
        """
        apart = distances_apart(self._sdf, self._poses).max(axis=1)
        middle = int(np.argmin(apart))
        own = self.object_from_world[middle]
        off = pose_offsets(self._symmetry, own, others=self.object_from_world)
        centre, turn = np.sqrt((off.reshape(-1, 2, 3) ** 2).sum(axis=2)).max(axis=0)
        return Ball(inverse(own), float(apart[middle]), centre=float(centre), turn=float(turn))

    @property
    def spread(self) -> float:
        """Root mean square distance of two members' surfaces, metres."""
        return self.trust.spread

    def __len__(self) -> int:
        return len(self.object_from_world)

    def __repr__(self) -> str:
        lines = [f"<PoseBelief: {len(self)} poses, {self.trust}"]
        for mode in self.modes[:3]:
            size = 1000.0 * mode.deviations[0]
            x, y, z = inverse(mode.object_from_world)[:3, 3]
            place = f"at [{x:.3f}, {y:.3f}, {z:.3f}] m, its centre deviates by {size:.1f} mm"
            lines.append(f"mode {mode.number}: {100.0 * mode.weight:.0f} %, {place}")
        if len(self.modes) > 3:
            lines.append(f"and {len(self.modes) - 3} more")
        return "\n  ".join(lines) + ">"

    def sample(self, count: int, seed: int = 0) -> FloatArray:
        """Return poses object_from_world (count, 4, 4) of members, drawn alike."""
        chosen = np.random.default_rng(seed).integers(len(self), size=count)
        return self.object_from_world[chosen]

    def occupancy(self, points: Any) -> FloatArray:
        """Return the chance (N,) that each of points (N, 3), world, is inside of the object."""
        return (self._distances(points) < 0.0).mean(axis=0)

    def contact_chance(self, points: Any, within: float = 0.002) -> FloatArray:
        """Return the chance (N,) that the surface is near points (N, 3), world; within: metres."""
        require_positive("within", within)
        return (np.abs(self._distances(points)) <= within).mean(axis=0)

    def collision_chance(self, hand: trimesh.Trimesh | HandShape, path: Any) -> Chances:
        """Return the chance that a closed hand meets the object on its path; arrays of one number.

        path (P, 4, 4): poses world_from_hand at which it is tested.
        """
        import trimesh

        solid = trimesh.Trimesh(hand.vertices, hand.faces, process=False)
        poses = nearest_rigid("path", frozen("path", path, shape=(None, 4, 4), error=PoseError))
        side = max(float(solid.extents.min()) / _NODES_ACROSS, _FINEST)
        own = np.concatenate([np.asarray(solid.vertices), interior_lattice(solid, side)])
        met = (self._distances(apply(poses, own).reshape(-1, 3)) < 0.0).any(axis=1)
        return self._chances(np.reshape(met, (-1, 1)))

    def grasp_chance(
        self, world_from_gripper: Any, width: Any, *, gripper: Gripper | None = None
    ) -> Chances:
        """Return the chances (G,) that grasps work, as far as geometry says.

        world_from_gripper (G, 4, 4), width (G,): between the fingers, metres; one number for all.
        A grasp works where the fingers are free, something of the object is between their pads, and
        the hand opens so far.
        """
        gripper = gripper or Gripper()
        return self._chances(
            grasps_work(
                self._sdf,
                self._poses,
                world_from_gripper=world_from_gripper,
                width=width,
                gripper=gripper,
            )
        )

    def best_grasp(
        self, object_from_gripper: Any, width: Any, *, gripper: Gripper | None = None
    ) -> tuple[FloatArray, float]:
        """Return the pose world_from_gripper (4, 4) of the largest chance to work, and this chance.

        object_from_gripper (G, 4, 4), width (G,): grasps of the object, as planned on its mesh.
        They are tried where some members have the object, the best and the modes' among them.
        """
        grasps = frozen(
            "object_from_gripper", object_from_gripper, shape=(None, 4, 4), error=PoseError
        )
        if len(grasps) == 0:
            raise SettingError("there is no grasp; accepted: at least one")
        modes = [int(mode.members[0]) for mode in self.modes]
        tried = [*dict.fromkeys([0, *modes, *evenly_spaced(len(self), _TRIED).tolist()])]
        world = inverse(self.object_from_world[tried])[:, None]  # (T, 1, 4, 4)
        turns = product(world[..., :3, :3], grasps[:, :3, :3])
        places = rotated(world[..., :3, :3], grasps[:, :3, 3]) + world[..., :3, 3]
        widths = np.broadcast_to(np.asarray(width, dtype=np.float64), places.shape[:2])
        world = compose(turns, places).reshape(-1, 4, 4)
        chance = self.grasp_chance(world, widths.reshape(-1), gripper=gripper).chance
        return world[int(np.argmax(chance))], float(chance.max())

    def _distances(self, points: Any) -> FloatArray:
        """Return signed distances (K, N) of world points from every member's surface."""
        return signed_distances(
            self._sdf, self._poses, points=frozen("points", points, shape=(None, 3))
        )

    def _chances(self, works: np.ndarray) -> Chances:
        """Return shares of members (K, G) for which something holds."""
        return wilson(works.mean(axis=0), len(works))

    def _repr_png_(self) -> bytes:
        """Return the outlines of all members from above and from the side, for notebooks."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8.0, 4.0), layout="constrained")
        world_from_object = inverse(self.object_from_world)
        stream = StreamKey(0, 0).stream(Purpose.MESH_SAMPLES)
        surface = surface_points(self._sdf, _DRAWN, stream=stream)
        colors = np.full(len(self), "0.6", dtype=object)
        for n, mode in enumerate(self.modes):
            colors[mode.members] = f"C{n}"
        for n, (across, up) in enumerate(((0, 1), (0, 2))):
            axes = figure.add_subplot(1, 2, n + 1, aspect="equal")
            for pose, color in zip(world_from_object, colors, strict=True):
                seen = apply(pose, surface)
                axes.plot(seen[:, across], seen[:, up], ".", color=color, ms=1.0, alpha=0.1)
            axes.set(xlabel="xyz"[across] + " / m", ylabel="xyz"[up] + " / m")
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=80)
        return file.getvalue()


def grasps_work(
    sdf: SdfGrid, poses: Poses, *, world_from_gripper: Any, width: Any, gripper: Gripper
) -> np.ndarray:
    """Return whether each grasp (G,) works on the object at each of poses: flags (K, G).

    world_from_gripper, width: as `PoseBelief.grasp_chance` takes them.
    """
    grasps = frozen("world_from_gripper", world_from_gripper, shape=(None, 4, 4), error=PoseError)
    grasps = nearest_rigid("world_from_gripper", grasps)
    widths = np.broadcast_to(np.asarray(width, dtype=np.float64), (len(grasps),))
    if not ((widths > 0.0) & (widths <= _WIDEST)).all():
        raise SettingError(
            f"width is not above 0 and up to {_WIDEST:g}; accepted: metres between the fingers"
        )
    fingers, between = _nodes(gripper)
    own = np.concatenate([fingers, between])  # of width 1, but for the fingers' thickness
    count = len(fingers)
    local = np.broadcast_to(own, (len(grasps), *own.shape)).copy()
    local[:, :count, 1] += np.sign(own[:count, 1]) * 0.5 * widths[:, None]
    local[:, count:, 1] *= widths[:, None]
    world = rotated(grasps[:, None, :3, :3], local) + grasps[:, None, :3, 3]
    inside = signed_distances(sdf, poses, points=world.reshape(-1, 3)) < 0.0
    inside = inside.reshape(len(poses), len(grasps), len(own))
    free = ~inside[..., :count].any(axis=-1)
    held = inside[..., count:].any(axis=-1)
    return np.asarray(free & held & (widths <= gripper.opening))


def pose_offsets(symmetry: ObjectSymmetry, own: FloatArray, *, others: FloatArray) -> FloatArray:
    """Return how poses (M, 4, 4), object_from_world, are off one (4, 4): vectors (M, 6).

    Of the object's centre (metres) and the rotation vector (radians), both in world axes, after
    the symmetry of the object that brings each of the others nearest.
    """
    world_from_object = inverse(np.concatenate([own[None], others]))
    centres = apply(world_from_object, symmetry.centre[None])[:, 0]
    rotations = world_from_object[:, :3, :3]
    turns = product(symmetry.nearest(rotations[1:], rotations[0]), rotations[0].T)
    return np.concatenate([centres[1:] - centres[0], _rotation_vectors(turns)], axis=1)


def wilson(share: Any, count: int) -> Chances:
    """Return shares (G,) of `count` trials with Wilson's interval."""
    share = np.asarray(share, dtype=np.float64)
    successes, index = np.unique(np.rint(share * count).astype(int), return_inverse=True)
    ends = np.array([_interval(number, count) for number in successes.tolist()]).reshape(-1, 2)
    return Chances(share, lower=ends[index, 0], upper=ends[index, 1])


@cache
def _interval(successes: int, count: int) -> tuple[float, float]:
    """Return the ends of Wilson's interval of a share."""
    from scipy.stats import binomtest  # which takes long to import

    low, high = binomtest(successes, count).proportion_ci(_CONFIDENCE, method="wilson")
    return float(low), float(high)


def _nodes(gripper: Gripper) -> tuple[FloatArray, FloatArray]:
    """Return points of both fingers, from the opening outwards, and between the pads at width 1."""
    across = 0.5 * gripper.width * np.linspace(-1.0, 1.0, 3)
    outwards = gripper.thickness * np.array([1e-6, 1.0])  # the inner and the outer side
    back, pad = -gripper.length * np.linspace(0.0, 1.0, 4), -gripper.pad * np.linspace(0, 1, 2)

    def lattice(*axes: Sequence[float] | FloatArray) -> FloatArray:
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    fingers = lattice(across, np.concatenate([-outwards, outwards]), back)
    return fingers, lattice(across, np.linspace(-0.45, 0.45, 5), pad)


def _rotation_vectors(turns: FloatArray) -> FloatArray:
    """Return axes times angles (M, 3), radians, of rotations (M, 3, 3)."""
    double = twice_sine_axis(turns)
    size = np.sqrt((double**2).sum(axis=1, keepdims=True))
    return double * rotation_angle(turns)[:, None] / np.maximum(size, 1e-300)
