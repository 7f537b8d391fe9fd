"""The two soft-bubble pads: what their cameras see without noise, and whether they touch."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy import ndimage

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, inverse
from runners.sensors.rig import ContactRig
from runners.twin import wrist
from runners.twin.membrane import CAP, CAP_BASE, Membrane
from runners.twin.pinhole import Pinhole
from runners.twin.scene import Scene

_SPACING = 0.004  # m: between the points of the surface that are looked at first


class Pads:
    """Both membranes against one object; images are rendered only where it may touch them."""

    def __init__(
        self,
        scene: Scene,
        camera: Pinhole,
        mesh: trimesh.Trimesh,
        world_from_object: FloatArray,
    ) -> None:
        """mesh: in its own frame, metres."""
        fine, _ = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, _SPACING, max_iter=20)
        self._surface = apply(world_from_object, np.unique(fine, axis=0))
        self._scene = scene
        self._camera = camera
        self._membrane = Membrane(camera)
        self._contact = ContactRig()

    def depths(self, world_from_wrist: FloatArray) -> dict[str, FloatArray]:
        """Depth (H, W) in metres of each pad's membrane, pressed or not."""
        return {pad: self._depth(world_from_wrist, pad) for pad in wrist.PADS}

    def pressed(self, depths: dict[str, FloatArray]) -> dict[str, int]:
        """How many pixels of each pad are dented beyond the robot's threshold, as it filters."""
        counts = {}
        for pad, depth in depths.items():
            dent = ndimage.uniform_filter(self._membrane.rest - depth, self._contact.filter)
            counts[pad] = int((dent > self._contact.threshold).sum())
        return counts

    def touches(self, depths: dict[str, FloatArray]) -> bool:
        """Whether so many pixels of a pad are dented that the robot stops."""
        return max(self.pressed(depths).values()) >= self._contact.pixels

    def _depth(self, world_from_wrist: FloatArray, pad: str) -> FloatArray:
        world_from_camera = world_from_wrist @ wrist.wrist_from_bubble_camera(pad)
        if not self._near(world_from_camera):
            return self._membrane.rest
        return self._membrane.pressed(self._scene.depth(self._camera, world_from_camera))

    def _near(self, world_from_camera: FloatArray) -> bool:
        """Whether the object comes within _SPACING of a membrane."""
        points = apply(inverse(world_from_camera), self._surface) - [0.0, 0.0, CAP_BASE]
        near = ((points / (np.array(CAP) + _SPACING)) ** 2).sum(axis=1) < 1.0
        return bool((near & (points[:, 2] > -_SPACING)).any())
