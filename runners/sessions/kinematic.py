"""Probe sessions by geometry alone: the first contact of two rigid bodies."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import igl
import numpy as np
import trimesh

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import Lattice
from chsel.problem.poses import apply
from runners.sessions.gripper import START, Touch
from runners.sessions.probing_hand import ProbingHand, turned_from_forward
from runners.sessions.probing_settings import ProbingSettings

SPACING = 0.001  # m: of the points on the hand that can touch
PATCH = 0.010  # m: side of the patches of these points that are passed over as one
PRECISION = 1e-6  # m: of the first contact along a mini-step


class KinematicEngine:
    """The hand follows its targets until a point of its surface meets the object, and waits."""

    def __init__(
        self,
        mesh: trimesh.Trimesh,
        world_from_object: FloatArray,
        *,
        settings: ProbingSettings,
        hand: ProbingHand,
    ) -> None:
        """Put a mesh, metres, in its frame, at world_from_object (4, 4), until it is moved."""
        self._mesh = mesh
        self._patches = self._forward = _patches(hand)
        self._turn = np.eye(3)  # of the patches, from how a hand probes along x
        self._position = np.array(START)
        self._force = settings.max_force
        # No point of a patch is nearer to the object than this; kept true as the hand moves.
        self._clearance = np.zeros(len(self._patches.centres))
        self.move(world_from_object)

    def move(self, world_from_object: FloatArray) -> None:
        """Put the object at a pose (4, 4)."""
        self.world_from_object = world_from_object
        self._object = _Surface(self._mesh, world_from_object)
        self._clearance[:] = 0.0

    def advance(self, target: FloatArray) -> Touch:
        """Move to target (3,), or as far as the first contact on the straight way there."""
        motion = target - self._position
        length = float(np.sqrt(motion @ motion))
        self._clearance -= length
        near = np.flatnonzero(self._clearance <= 0.0)
        if len(near) > 0:
            patches = self._patches
            distance = self._object.distance(patches.centres[near] + target)
            self._clearance[near] = distance - patches.radii[near]
            # Only what is nearer now than the way it went can have gone through the surface.
            close = near[self._clearance[near] <= length]
            if len(close) > 0:
                points = patches.points[np.isin(patches.labels, close)]
                points = points[self._object.distance(points + target) <= length]
                if len(points) > 0:
                    points = points[self._object.closest(points + target)[0] <= 0.0]
                if len(points) > 0:
                    return self._touch(points, motion, length=length)
        self._position = target
        return Touch(target)

    def place(self, pose: FloatArray) -> bool:
        """Put the hand at a pose (4, 4); False, and not to be used, if the object is there."""
        turn = turned_from_forward(pose[:3, :3])
        position = pose[:3, 3]
        if not (turn == self._turn).all():
            self._turn = turn
            self._patches = self._forward.turned(turn)
        self._position = position
        patches = self._patches
        self._clearance = self._object.distance(patches.centres + position) - patches.radii
        close = np.isin(patches.labels, np.flatnonzero(self._clearance <= 0.0))
        close[0] = True  # far from its surface, all or nothing is in the object
        return not (self._object.closest(patches.points[close] + position)[0] < 0.0).any()

    def close(self) -> None:
        """Release nothing, as nothing is held."""

    def _touch(self, points: FloatArray, motion: FloatArray, *, length: float) -> Touch:
        """Bisect for when the first of points (S, 3) gets in; at the end of the way all are in."""
        start = self._position
        free = 0.0
        blocked = 1.0
        while (blocked - free) * length > PRECISION:
            middle = 0.5 * (free + blocked)
            inside = self._object.closest(points + start + middle * motion)[0] <= 0.0
            if inside.any():
                blocked, points = middle, points[inside]
            else:
                free = middle
        self._position = start + free * motion
        # The clearances above hold at the target; the hand has stopped short of it.
        self._clearance -= (1.0 - free) * length
        distance, contacts, normals = self._object.closest(points + self._position)
        first = int(np.argmin(distance))
        return Touch(self._position, self._force, contact=contacts[first], normal=normals[first])


@dataclass(frozen=True, eq=False)
class _Patches:
    """Points on the hand's surface, by patches."""

    points: FloatArray  # (S, 3), metres
    labels: np.ndarray  # (S,), indices of their patches
    centres: FloatArray  # (P, 3), metres
    radii: FloatArray  # (P,), metres, of all points of a patch around its centre

    def turned(self, turn: FloatArray) -> _Patches:
        """Return the patches of a hand that is turned by (3, 3) about its origin."""
        return replace(self, points=self.points @ turn.T, centres=self.centres @ turn.T)


@lru_cache(maxsize=2)
def _patches(hand: ProbingHand) -> _Patches:
    points = hand.surface_points(SPACING)
    voxels = Lattice((0.0, 0.0, 0.0), PATCH).voxels(points)
    _, labels = np.unique(voxels, axis=0, return_inverse=True)
    count = np.bincount(labels)
    centres = np.stack([np.bincount(labels, axis) / count for axis in points.T], axis=1)
    radii = np.zeros(len(centres))
    np.maximum.at(radii, labels, np.sqrt(((points - centres[labels]) ** 2).sum(axis=1)))
    return _Patches(points, labels, centres=centres, radii=radii)


class _Surface:
    """Exact signed distance to a fixed mesh in the world, its search tree built only once.

    The sign is that of the pseudonormal of the nearest face, edge or corner, which needs no more
    than the surface around it.
    """

    def __init__(self, mesh: trimesh.Trimesh, world_from_object: FloatArray) -> None:
        self._vertices = np.ascontiguousarray(apply(world_from_object, np.asarray(mesh.vertices)))
        self._faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        rotation = world_from_object[:3, :3].T
        self._face_normals = np.asarray(mesh.face_normals) @ rotation
        self._corner_normals = np.asarray(mesh.vertex_normals) @ rotation
        neighbours, _ = igl.triangle_triangle_adjacency(self._faces)
        across = np.where(neighbours[..., None] < 0, 0.0, self._face_normals[neighbours])
        self._edge_normals = self._face_normals[:, None] + across  # by face and first corner

    def distance(self, points: FloatArray) -> FloatArray:
        """Return unsigned distance (N,) in metres at points (N, 3)."""
        return np.sqrt(self._tree.squared_distance(self._vertices, self._faces, points)[0])

    def closest(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return signed distances (N,) of points (N, 3), nearest points (N, 3), and normals."""
        squared, face, nearest = self._tree.squared_distance(self._vertices, self._faces, points)
        triangles = self._vertices[self._faces[face]]
        weights = trimesh.triangles.points_to_barycentric(triangles, nearest)
        on_side = weights < 1e-9  # of the edge opposite to this corner
        normals = self._face_normals[face]
        edge = on_side.sum(axis=1) == 1
        opposite = np.argmax(on_side[edge], axis=1)
        normals[edge] = self._edge_normals[face[edge], (opposite + 1) % 3]
        corner = on_side.sum(axis=1) == 2
        heaviest = np.argmax(weights[corner], axis=1)
        normals[corner] = self._corner_normals[self._faces[face[corner], heaviest]]
        outside = ((points - nearest) * normals).sum(axis=1) >= 0.0
        return np.where(outside, 1.0, -1.0) * np.sqrt(squared), nearest, self._face_normals[face]
