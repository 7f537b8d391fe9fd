"""The hand that probes in simulated sessions: where it touches, and what it sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.errors import SettingError
from chsel.next_probe.decision_problem import HandShape
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import Lattice
from chsel.problem.poses import compose
from runners.sensors.hand import HandModel
from runners.sensors.rig import BoxRig, HandRig

if TYPE_CHECKING:
    import trimesh

# World axes of the hand's axes when it probes along world x: hand z is world x, and the wide side
# of the hand (hand y) lies along world y.
ROTATION = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
LARGEST = 0.5  # m: extent of a hand along any axis
SPACING = 0.001  # m: of the points on the hand that can touch
PATCH = 0.010  # m: side of the patches of these points that are passed over as one
_FLUSH = 1e-9  # m: of two solids that share a face


@dataclass(frozen=True)
class DescribedHand:
    """Solid parts of a hand that probes along the z axis of its frame.

    Each counts as its convex hull, as in physics engines. Nothing at all: the built-in hand, a
    Franka hand with closed fingers.
    """

    urdf: str | None = None  # file whose links' collision shapes belong to the hand, joints at 0
    root: str | None = None  # the link of the urdf whose frame is the hand's; None: its base
    boxes: tuple[BoxRig, ...] = ()  # more parts, in the hand's frame


@dataclass(frozen=True, eq=False)
class HandPatches:
    """Points on a hand's surface, by patches that are passed over as one."""

    points: FloatArray  # (S, 3), metres
    labels: np.ndarray  # (S,), indices of their patches
    centres: FloatArray  # (P, 3), metres
    radii: FloatArray  # (P,), metres, of all points of a patch around its centre

    def turned(self, turn: FloatArray) -> HandPatches:
        """Return the patches of a hand that is turned by (3, 3) about its origin."""
        return replace(self, points=self.points @ turn.T, centres=self.centres @ turn.T)


class ProbingHand:
    """Convex solids that may overlap, origin at the hand's; points on them and in them.

    All are in the axes of a world in which the hand probes along x: turned by ROTATION against the
    hand's own.
    """

    def __init__(self, solids: Sequence[trimesh.Trimesh]) -> None:
        self.solids = tuple(solids)

    @cached_property
    def shape(self) -> HandShape:
        """All solids in the hand's own frame, where it probes along z."""
        import trimesh

        joined: Any = trimesh.util.concatenate(list(self.solids))
        return HandShape(np.asarray(joined.vertices) @ ROTATION, joined.faces)

    @cache  # noqa: B019  (there are few hands in a process)
    def surface_points(self, spacing: float) -> FloatArray:
        """Return points (S, 3) that cover the surface about `spacing` apart, with all corners."""
        parts = [self._covering(index, spacing) for index in range(len(self.solids))]
        return np.concatenate(parts)

    @cache  # noqa: B019
    def patches(self) -> HandPatches:
        """Return points that cover the surface 1 mm apart, in patches of 1 cm."""
        points = self.surface_points(SPACING)
        voxels = Lattice((0.0, 0.0, 0.0), PATCH).voxels(points)
        _, labels = np.unique(voxels, axis=0, return_inverse=True)
        count = np.bincount(labels)
        centres = np.stack([np.bincount(labels, axis) / count for axis in points.T], axis=1)
        radii = np.zeros(len(centres))
        np.maximum.at(radii, labels, np.sqrt(((points - centres[labels]) ** 2).sum(axis=1)))
        return HandPatches(points, labels, centres=centres, radii=radii)

    def interior_points(self, spacing: float, depth: float) -> FloatArray:
        """Return nodes (M, 3) of a lattice through the origin, deeper than `depth` in a solid."""
        bounds = np.array([solid.bounds for solid in self.solids])
        first = np.floor(bounds[:, 0].min(axis=0) / spacing)
        last = np.ceil(bounds[:, 1].max(axis=0) / spacing)
        axes = [np.arange(low, high + 1) * spacing for low, high in zip(first, last, strict=True)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        deepest = np.max([_depth(solid, nodes) for solid in self.solids], axis=0)
        return nodes[deepest > depth]

    def _covering(self, index: int, spacing: float) -> FloatArray:
        """Return points on one solid that are in no other; on shared faces, the first solid's."""
        import trimesh

        solid = self.solids[index]
        fine, _ = trimesh.remesh.subdivide_to_size(solid.vertices, solid.faces, spacing)
        voxels = Lattice((0.0, 0.0, 0.0), spacing).voxels(fine)
        _, kept = np.unique(voxels, axis=0, return_index=True)
        points = np.concatenate([solid.vertices, fine[kept]])
        for other, beside in enumerate(self.solids):
            if other != index:
                margin = _FLUSH if other > index else -_FLUSH
                points = points[_depth(beside, points) < margin]
        return points


@cache
def panda_hand() -> ProbingHand:
    """Return a Franka hand with closed fingers, as two convex solids of its outer size.

    The real hand is flat where these bulge by a few millimetres, so that they meet a flat object at
    one point.
    """
    import trimesh

    folder = Path(__file__).parent
    files = [str(folder / f"panda_{part}.ply") for part in ("palm", "fingers")]
    return ProbingHand([trimesh.load_mesh(file, process=False) for file in files])


def open_hand(described: DescribedHand) -> ProbingHand:
    """Return the hand of a session.

    Raise SettingError for a URDF that cannot be used, and for a hand that is too long.
    """
    import trimesh

    if described.urdf is None and not described.boxes:
        if described.root is not None:
            raise SettingError("hand.root without hand.urdf; accepted: both, or neither")
        return panda_hand()
    rig = HandRig(frame="hand", boxes=described.boxes, urdf=described.urdf, root=described.root)
    parts = [np.asarray(part.vertices) @ ROTATION.T for part in HandModel(rig).parts()]
    extent = np.ptp(np.concatenate(parts), axis=0).max()
    if extent > LARGEST:
        raise SettingError(
            f"the hand is {extent:.6g} m long; accepted: at most {LARGEST:g}. Choose the link of "
            "the gripper as hand.root, without the arm"
        )
    return ProbingHand([trimesh.convex.convex_hull(vertices) for vertices in parts])


def turned_from_forward(rotation: FloatArray) -> FloatArray:
    """Return the turn (3, 3), world, from probing along x to a rotation (3, 3) world_from_hand."""
    return rotation @ ROTATION.T


def world_from_gripper(positions: FloatArray, rotation: FloatArray = ROTATION) -> FloatArray:
    """Return poses (..., 4, 4) of a hand at positions (..., 3), turned by a rotation (3, 3)."""
    return compose(np.broadcast_to(rotation, (*positions.shape[:-1], 3, 3)), positions)


def _depth(solid: trimesh.Trimesh, points: FloatArray) -> FloatArray:
    """Return the distance (N,) of points (N, 3) to a convex solid's surface, negative outside.

    It is minus infinity outside of the solid's bounding box.
    """
    lower, upper = np.asarray(solid.bounds)
    near = ((points >= lower - _FLUSH) & (points <= upper + _FLUSH)).all(axis=1)
    chosen = points[near]
    depth = np.full(int(near.sum()), np.inf)
    for normal, corner in zip(solid.face_normals, solid.triangles[:, 0], strict=True):
        np.minimum(depth, (corner - chosen) @ normal, out=depth)
    every = np.full(len(points), -np.inf)
    every[near] = depth
    return every
