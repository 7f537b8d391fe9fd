"""Probe sessions by geometry alone: the first contact of two rigid bodies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from chsel.numerics.arrays import FloatArray
from runners.sessions.gripper import START, Touch
from runners.sessions.mesh_surface import MeshSurface
from runners.sessions.probing_hand import ProbingHand, turned_from_forward
from runners.sessions.probing_settings import ProbingSettings

if TYPE_CHECKING:
    import trimesh

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
        self._patches = self._forward = hand.patches()
        self._turn = np.eye(3)  # of the patches, from how a hand probes along x
        self._position = np.array(START)
        self._force = settings.max_force
        # No point of a patch is nearer to the object than this; kept true as the hand moves.
        self._clearance = np.zeros(len(self._patches.centres))
        self.move(world_from_object)

    def move(self, world_from_object: FloatArray) -> None:
        """Put the object at a pose (4, 4)."""
        self.world_from_object = world_from_object
        self._object = MeshSurface(self._mesh, world_from_object)
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
