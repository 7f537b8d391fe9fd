"""The two soft-bubble pads: what their cameras see without noise, and whether they touch."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy import ndimage

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, inverse
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.rig import ContactRig
from runners.simulated_robot.cabinet import CAP, CAP_BASE, PADS, wrist_from_bubble_camera
from runners.simulated_robot.scene import Scene
from runners.simulated_robot.settings import RenderedCamera

THICKNESS = 0.001  # m: how much nearer than its base it can never be pressed
TAUTNESS = 0.003  # m: beside what presses, the dent falls by 1/e over this length
_SWEEPS = 30  # of relaxation, which leave an error of 0.1 %
_MARGIN = 0.025  # m: around what presses, beyond which there is no dent worth a number
_SPACING = 0.004  # m: between the points of the surface that are looked at first


class Membrane:
    """A membrane that gives way, on its rigid base."""

    rest: FloatArray
    """Depth (H, W) of the untouched membrane, and of the base beside it, metres."""

    def __init__(self, camera: PinholeCamera) -> None:
        self.rest = _cap_depth(camera)
        self._most = np.maximum(self.rest - (CAP_BASE + THICKNESS), 0.0)
        pitch = (CAP_BASE + CAP[2]) / camera.fx  # m a pixel
        self._margin = int(np.ceil(_MARGIN / pitch))
        self._kept = 1.0 / (1.0 + (pitch / TAUTNESS) ** 2 / 4.0)

    def pressed(self, beyond: FloatArray) -> FloatArray:
        """Return depth (H, W) of the membrane as depth `beyond` (H, W) of what is outside allows.

        The dent w is the least with w >= rest - beyond that elsewhere hangs as a taut sheet on a
        soft bed does, L^2 (w_xx + w_yy) = w with L = TAUTNESS, and ends where the base begins.
        """
        pressing = np.clip(self.rest - beyond, 0.0, self._most)
        if not pressing.any():
            return self.rest
        rows, columns = _around(pressing > 0.0, self._margin)
        depth = self.rest.copy()
        depth[rows, columns] -= self._hung(pressing[rows, columns], self._most[rows, columns])
        return depth

    def _hung(self, least: FloatArray, most: FloatArray) -> FloatArray:
        """Return the dent (h, w) between bounds, by projected successive over-relaxation."""
        over = 2.0 / (1.0 + np.sqrt(1.0 - self._kept**2))
        rows, columns = np.indices(least.shape)
        even = (rows + columns) % 2 == 0
        dent = least
        for half in [even, ~even] * _SWEEPS:
            edged = np.pad(dent, 1)
            around = edged[:-2, 1:-1] + edged[2:, 1:-1] + edged[1:-1, :-2] + edged[1:-1, 2:]
            moved = dent + over * (self._kept / 4.0 * around - dent)
            dent = np.where(half, np.clip(moved, least, most), dent)
        return dent


def _cap_depth(camera: PinholeCamera) -> FloatArray:
    """Return where the ray of every pixel (H, W) leaves the ellipsoid, or meets the base."""
    x, y = camera.columns, camera.rows[:, None]
    a, b, c = CAP
    # (x s / a)^2 + (y s / b)^2 + ((s - base) / c)^2 = 1, the further of the two depths s
    square = (x / a) ** 2 + (y / b) ** 2 + 1.0 / c**2
    half = CAP_BASE / c**2
    constant = (CAP_BASE / c) ** 2 - 1.0
    inside = half**2 - square * constant
    depth = (half + np.sqrt(np.maximum(inside, 0.0))) / square
    return np.where(inside > 0.0, np.maximum(depth, CAP_BASE), CAP_BASE)


def _around(pixels: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Return the part of an image that holds these pixels (H, W) and a margin."""
    rows, columns = np.flatnonzero(pixels.any(axis=1)), np.flatnonzero(pixels.any(axis=0))
    return (
        slice(max(rows[0] - margin, 0), rows[-1] + margin + 1),
        slice(max(columns[0] - margin, 0), columns[-1] + margin + 1),
    )


class Pads:
    """Both membranes against one object; images are rendered only where it may touch them."""

    def __init__(
        self,
        scene: Scene,
        camera: RenderedCamera,
        *,
        mesh: trimesh.Trimesh,
        world_from_object: FloatArray,
    ) -> None:
        """Make the pads against a mesh in its frame, metres."""
        fine, _ = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, _SPACING, max_iter=20)
        self._surface = apply(world_from_object, np.unique(fine, axis=0))
        self._scene = scene
        self._camera = camera
        self._membrane = Membrane(camera)

    def depths(self, world_from_wrist: FloatArray) -> dict[str, FloatArray]:
        """Return depth (H, W) in metres of each pad's membrane, pressed or not."""
        depths = {}
        for pad in PADS:
            world_from_camera = world_from_wrist @ wrist_from_bubble_camera(pad)
            depths[pad] = self._membrane.rest
            if self._near(world_from_camera):
                beyond = self._scene.depth(self._camera, world_from_camera)
                depths[pad] = self._membrane.pressed(beyond)
        return depths

    def touches(self, depths: dict[str, FloatArray]) -> bool:
        """Return whether so many pixels of a pad are dented, as filtered, that the robot stops."""
        contact = ContactRig()
        rest = self._membrane.rest
        dents = [ndimage.uniform_filter(rest - depth, contact.filter) for depth in depths.values()]
        return any((dent > contact.threshold).sum() >= contact.pixels for dent in dents)

    def _near(self, world_from_camera: FloatArray) -> bool:
        """Return whether the object comes within _SPACING of a membrane."""
        points = apply(inverse(world_from_camera), self._surface) - [0.0, 0.0, CAP_BASE]
        near = ((points / (np.array(CAP) + _SPACING)) ** 2).sum(axis=1) < 1.0
        return bool((near & (points[:, 2] > -_SPACING)).any())
