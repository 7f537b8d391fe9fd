"""Free space as a dense grid over the workspace: where rays passed, and where solids were."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from chsel.errors import PointsError, PoseError, SettingError, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray, frozen
from chsel.numerics.threads import spread
from chsel.problem.points import Lattice, Workspace
from chsel.problem.poses import SENSOR_TOLERANCE, Poses, check_rigid
from chsel.sensing.depth_camera import PinholeCamera
from chsel.sensing.ray_kernels import (
    MarkedVoxels,
    RayImage,
    mark_image,
    mark_points,
    mark_segments,
    settle,
)

MOST_VOXELS = 200_000_000  # two bytes each
MOST_VIEWS = 250
SCALES = np.linspace(0.95, 0.40, 20)  # of depth, as the reference implementation has them
_REPORTED = 255  # more than any number of views
_RAYS_PER_THREAD = 20_000
_POINTS_PER_THREAD = 100_000
_STAY = np.eye(4)[None]


class FreeGrid:
    """Which voxels of a workspace are known to be free, and which of them became free last.

    The centre of the first voxel is the workspace's lower corner, and the last voxels are those
    nearest to its upper corner. What lies outside of all voxels is ignored, and so are rays and
    points that are not finite.

    A ray passes a voxel if more than one point of it is inside: touching an edge or a corner does
    not count, as far as rounding allows. A ray within the face between two voxels is in the voxel
    of the greater index; so are its ends. A point of `at` is in the voxel whose centre is nearest,
    ties to even, as in Lattice.
    """

    def __init__(self, workspace: Workspace, spacing: float, *, views: int = 1) -> None:
        """spacing: side of a voxel, metres. views: how many views make a voxel free.

        A view is one call of along_rays, from_depth or scaled_images. Raises SettingError for a
        grid that is too large.
        """
        require_positive("views", views)
        if views > MOST_VIEWS or int(views) != views:
            raise SettingError(f"views is {views}; accepted: a whole number up to {MOST_VIEWS}")
        self.lattice = Lattice(workspace.lower, spacing)
        self.shape = _shape(workspace, spacing)
        self.count = 0
        self._views = int(views)
        voxels = int(np.prod(self.shape))
        self._words = np.zeros(-(-voxels // 8), dtype=np.uint64)
        marks = self._words.view(np.uint8)[:voxels]  # in the current view
        self._seen = np.zeros(voxels, dtype=np.uint8)  # number of views, then _REPORTED
        self._grid = MarkedVoxels(marks, self.shape, np.array(workspace.lower), float(spacing))

    def along_rays(self, origin: Any, ends: Any) -> int:
        """One view: mark what segments from origin (3,) or (N, 3) to ends (N, 3) pass, ends too.

        Returns the number of voxels that became free.
        """
        origins, ends = _rows("origin", origin), _rows("ends", ends)
        if len(origins) not in (1, len(ends)):
            raise PointsError(f"origin has {len(origins)} points; accepted: 1, or {len(ends)}")
        self._mark(mark_segments, origins, ends, count=len(ends), least=_RAYS_PER_THREAD)
        return self._settle(1)

    def from_depth(
        self,
        depth: FloatArray,
        camera: PinholeCamera,
        world_from_camera: FloatArray,
        mask: BoolArray,
        *,
        fraction: float = 0.95,
    ) -> int:
        """One view: mark along the rays of the masked pixels up to `fraction` of their depth.

        depth (H, W): metres along z. mask (H, W). Returns the number of voxels that became free.
        Raises PointsError for another shape than the camera's, PoseError for a pose that is not
        rigid.
        """
        require_positive("fraction", fraction)
        move, mask = _pose(world_from_camera), camera.image("mask", mask, bool)
        parts = camera.image("depth", depth), mask, camera.columns, camera.rows
        image = RayImage(*(np.require(part, requirements=("C", "W")) for part in parts))
        pose, least = tuple(Poses.of(move[None]).numbers[0]), -(-_RAYS_PER_THREAD // camera.width)
        self._mark(mark_image, image, pose, float(fraction), count=camera.height, least=least)
        return self._settle(1)

    def scaled_images(
        self,
        depth: FloatArray,
        camera: PinholeCamera,
        world_from_camera: FloatArray,
        mask: BoolArray,
        factors: FloatArray = SCALES,
    ) -> int:
        """One view: mark the points of images whose depth is scaled by each of the factors (F,).

        As in the reference implementation, which leaves gaps between the images and in front of
        all. Otherwise as from_depth.
        """
        move, mask = _pose(world_from_camera), camera.image("mask", mask, bool)
        factors = frozen("factors", factors, (None,), error=SettingError)
        moves = np.repeat(move[None], len(factors), axis=0)
        moves[:, :3, :3] *= factors[:, None, None]  # about the camera
        self._mark_points(camera.back_project(depth)[mask], moves)
        return self._settle(1)

    def at(self, points: Any, *, poses: FloatArray = _STAY) -> int:
        """Mark the voxels that points (N, 3) are in when moved by each of poses (P, 4, 4).

        These are free whatever the number of views. Returns the number of voxels that became free.
        Raises PoseError for poses that are not finite.
        """
        poses = frozen("poses", np.reshape(poses, (-1, 4, 4)), (None, 4, 4), error=PoseError)
        self._mark_points(_rows("points", points), np.array(poses))
        return self._settle(self._views)

    def new(self) -> FloatArray:
        """Centres (M, 3) of the voxels that became free since the last call, in order of index."""
        voxels = np.flatnonzero(self._seen == self._views)
        self._seen[voxels] = _REPORTED
        return self.lattice.centres(np.stack(np.unravel_index(voxels, self.shape), axis=1))

    def _mark_points(self, points: FloatArray, moves: FloatArray) -> None:
        numbers, least = Poses.of(moves).numbers, -(-_POINTS_PER_THREAD // max(len(moves), 1))
        self._mark(mark_points, points, numbers, count=len(points), least=least)

    def _mark(self, kernel: Callable[..., None], *arguments: Any, count: int, least: int) -> None:
        """Run a kernel on pieces of range(count), of at least `least`, on several threads."""

        def run(first: int, last: int, _: None) -> None:
            kernel(self._grid, *arguments, first, last)

        spread(run, count, lambda: None, least=least)

    def _settle(self, views: int) -> int:
        """Count the marked voxels as seen in `views` more views; how many became free."""
        fresh = int(settle(self._words, self._grid.marks, self._seen, views, self._views))
        self.count += fresh
        return fresh


def _shape(workspace: Workspace, spacing: float) -> tuple[int, int, int]:
    lower, upper = workspace.bounds
    with np.errstate(over="ignore"):
        counts = np.rint((upper - lower) / spacing) + 1.0
        voxels = float(counts[0] * counts[1] * counts[2])
    if not voxels <= MOST_VOXELS:
        raise SettingError(
            f"a workspace of {' x '.join(f'{side:.4g}' for side in upper - lower)} m has "
            f"{voxels:.4g} voxels of {spacing:g} m; accepted: at most {MOST_VOXELS:_}, so a "
            "smaller workspace or larger voxels"
        )
    nx, ny, nz = (int(count) for count in counts)
    return nx, ny, nz


def _rows(name: str, points: Any) -> FloatArray:
    """Points (N, 3), finite or not; one point (3,) is a row."""
    rows = np.asarray(points, dtype=np.float64)
    rows = rows[None] if rows.shape == (3,) else rows
    rows = np.zeros((0, 3)) if rows.size == 0 else rows
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise PointsError(f"{name} has shape {rows.shape}; accepted: (any, 3)")
    return np.require(rows, requirements=("C", "W"))  # one type of array, so one compilation


def _pose(world_from_camera: FloatArray) -> FloatArray:
    """A checked copy."""
    pose = frozen("world_from_camera", world_from_camera, (4, 4), error=PoseError)
    check_rigid("world_from_camera", pose[None], SENSOR_TOLERANCE)
    return np.array(pose)
