"""Free space as a dense grid over the workspace: where rays passed, and where solids moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import floor, inf, prod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from chsel.errors import PointsError, PoseError, SettingError, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray, frozen
from chsel.numerics.cell_set import voxel_of
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import moved, pose_at
from chsel.numerics.threads import parallel_for
from chsel.problem.points import Lattice, Workspace
from chsel.problem.poses import (
    SENSOR_TOLERANCE,
    Poses,
    check_rigid,
    interpolated,
    product,
    rotation_angle,
)
from chsel.problem.sdf_grid import mesh_sdf
from chsel.sensing.depth_camera import PinholeCamera

if TYPE_CHECKING:
    import trimesh


MOST_VOXELS = 200_000_000  # two bytes each
MOST_VIEWS = 250
_RUN = 1024  # voxels that are searched for marks together: most have none
_RAYS_PER_THREAD = 20_000
_POINTS_PER_THREAD = 100_000
_STAY = np.eye(4)[None]
_FARTHEST = 2.0**52  # voxels from the first: beyond, neighbours are the same number
_SHORTEST = 1e-100  # voxels: shorter moves along an axis count as none
MOST_NODES = 2_000_000
MOST_POSES = 1_000_000
_DEEPEST_ON_SURFACE = 1e-9  # m: a node on the surface is not inside, however it is rounded
_ROUNDING = 1e-9  # steps: a move of one step is not two


class MarkedVoxels(NamedTuple):
    """Marks of V voxels. Threads may mark one grid at once: all they ever do is write ones."""

    marks: NDArray[np.uint8]  # (V or more,) in C order, 1 for a marked voxel
    counts: tuple[int, int, int]  # voxels per axis
    lower: FloatArray  # (3,): centre of the first voxel, metres
    spacing: float  # of the centres, metres


class RayImage(NamedTuple):
    """Depths of a camera, and which of its rays count."""

    depth: FloatArray  # (H, W), metres along z
    mask: BoolArray  # (H, W)
    columns: FloatArray  # (W,): x / z of the pixels
    rows: FloatArray  # (H,): y / z of the pixels


class FreeGrid:
    """The voxels of a workspace that are known to be free, and those that became free last.

    The centre of the first voxel is the workspace's lower corner, and the last voxels are those
    nearest to its upper corner. What lies outside of all voxels is ignored, and so are rays and
    points that are not finite.

    A ray passes a voxel if more than one point of it is inside: touching an edge or a corner does
    not count, as far as rounding allows. A ray within the face between two voxels is in the voxel
    of the greater index; so are its ends. A point of `at` is in the voxel whose centre is nearest,
    ties to even, as in Lattice.
    """

    def __init__(self, workspace: Workspace, spacing: float, *, views: int = 1) -> None:
        """Make a grid; spacing: side of a voxel, metres; views: how many make a voxel free.

        A view is one call of along_rays or from_depth. Raise SettingError for a grid that is too
        large.
        """
        if views not in range(1, MOST_VIEWS + 1):
            raise SettingError(f"views is {views}; accepted: a whole number up to {MOST_VIEWS}")
        self.lattice = Lattice(workspace.lower, spacing)
        self.shape = _shape(workspace, spacing)
        self.count = 0
        self._views = int(views)
        voxels = prod(self.shape)
        marks = np.zeros(-(-voxels // _RUN) * _RUN, dtype=np.uint8)  # in the current view
        self._fresh: list[NDArray[np.int64]] = []  # indices of voxels that `new` has not returned
        self._seen = np.zeros(voxels, dtype=np.uint8)  # number of views
        self._grid = MarkedVoxels(
            marks, self.shape, lower=np.array(workspace.lower), spacing=float(spacing)
        )

    def along_rays(self, origin: Any, ends: Any) -> int:
        """Mark, as one view, the segments from origin (3,) or (N, 3) to ends (N, 3), ends too.

        Return the number of voxels that became free.
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
        *,
        world_from_camera: FloatArray,
        mask: BoolArray,
        fraction: float = 0.95,
    ) -> int:
        """Mark, as one view, the rays of the masked pixels up to `fraction` of their depth.

        depth (H, W): metres along z. mask (H, W). Return the number of voxels that became free.
        Raise PointsError for another shape than the camera's, PoseError for a pose that is not
        rigid.
        """
        require_positive("fraction", fraction)
        move = frozen("world_from_camera", world_from_camera, shape=(4, 4), error=PoseError)
        check_rigid("world_from_camera", move[None], tolerance=SENSOR_TOLERANCE)
        mask = camera.image("mask", mask, dtype=bool)
        parts = camera.image("depth", depth), mask, camera.columns, camera.rows
        image = RayImage(*(np.require(part, requirements=("C", "W")) for part in parts))
        pose = tuple(Poses.of(move[None]).numbers[0])
        least = -(-_RAYS_PER_THREAD // camera.width)
        self._mark(mark_image, image, pose, float(fraction), count=camera.height, least=least)
        return self._settle(1)

    def at(self, points: Any, *, poses: FloatArray = _STAY) -> int:
        """Mark the voxels that points (N, 3) are in when moved by each of poses (P, 4, 4).

        These are free whatever the number of views. Return the number of voxels that became free.
        Raise PoseError for poses that are not finite.
        """
        poses = frozen("poses", np.reshape(poses, (-1, 4, 4)), shape=(None, 4, 4), error=PoseError)
        points = _rows("points", points)
        if len(points) == 0 or len(poses) == 0:
            return 0
        least = -(-_POINTS_PER_THREAD // max(len(poses), 1))
        self._mark(mark_points, points, Poses.of(poses).numbers, count=len(points), least=least)
        return self._settle(self._views)

    def new(self) -> FloatArray:
        """Return centres (M, 3) of voxels that became free since the last call, by index."""
        voxels = np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *self._fresh]))
        self._fresh = []
        return self.lattice.centres(np.stack(np.unravel_index(voxels, self.shape), axis=1))

    def forget(self, centres: FloatArray) -> None:
        """Let the voxels with some centres (N, 3) be as if nothing had made them free."""
        voxels = tuple(self.lattice.voxels(centres).T)
        self._seen[np.ravel_multi_index(voxels, self.shape)] = 0
        self.count -= len(centres)

    def _mark(self, kernel: Callable[..., None], *arguments: Any, count: int, least: int) -> None:
        """Run a kernel on pieces of range(count), of at least `least`, on several threads."""

        def run(first: int, last: int, _: None) -> None:
            kernel(self._grid, *arguments, first, last)

        parallel_for(run, count, scratch=lambda: None, least=least)

    def _settle(self, views: int) -> int:
        """Count the marked voxels as seen in `views` more views; how many became free."""
        seen = self._seen
        marks = self._grid.marks.view(np.bool_).reshape(-1, _RUN)
        runs = np.flatnonzero(marks.any(axis=1))
        run, place = np.divmod(np.flatnonzero(marks[runs]), _RUN)
        marks[runs] = False
        marked = runs[run] * _RUN + place
        marked = marked[seen[marked] < self._views]
        seen[marked] = np.minimum(seen[marked].astype(np.int64) + views, self._views)
        fresh = marked[seen[marked] == self._views]
        self._fresh.append(fresh)
        self.count += len(fresh)
        return len(fresh)


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
    """Return points (N, 3), finite or not; one point (3,) is a row."""
    rows = np.asarray(points, dtype=np.float64)
    rows = rows[None] if rows.shape == (3,) else rows
    rows = np.zeros((0, 3)) if rows.size == 0 else rows
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise PointsError(f"{name} has shape {rows.shape}; accepted: (any, 3)")
    return np.require(rows, requirements=("C", "W"))  # one type of array, so one compilation


@compiled
def mark_segments(grid, origins, ends, first, last):
    """Mark the voxels on segments first to last, from origins (1 or N, 3) to ends (N, 3)."""
    for n in range(first, last):
        o = n if len(origins) > 1 else 0
        a = _place(grid, origins[o, 0], origins[o, 1], origins[o, 2])
        b = _place(grid, ends[n, 0], ends[n, 1], ends[n, 2])
        _walk(grid, a, b)


@compiled
def mark_image(grid, image, pose, fraction, first, last):
    """Mark the voxels on the rays of the masked pixels of rows first to last of a RayImage.

    pose: of the camera, world_from_camera. Rays end at `fraction` of their depth.
    """
    a = _place(grid, pose[9], pose[10], pose[11])
    for row in range(first, last):
        for column in range(len(image.columns)):
            if image.mask[row, column]:
                z = fraction * image.depth[row, column]
                x, y, z = moved(pose, image.columns[column] * z, image.rows[row] * z, z)
                _walk(grid, a, _place(grid, x, y, z))


@compiled
def mark_points(grid, points, moves, first, last):
    """Mark the voxels of points (N, 3) first to last, moved by each of the moves (P, 12)."""
    nx, ny, nz = grid.counts
    lower, spacing = grid.lower, grid.spacing
    for n in range(first, last):
        for p in range(len(moves)):
            x, y, z = moved(pose_at(moves, p), points[n, 0], points[n, 1], points[n, 2])
            i, j, k = voxel_of(lower, spacing, x, y, z)
            if 0.0 <= i < nx and 0.0 <= j < ny and 0.0 <= k < nz:
                grid.marks[(int(i) * ny + int(j)) * nz + int(k)] = 1


@leaf
def _place(grid, x, y, z):
    """Return a point in units of voxels: voxel k is from k to k + 1."""
    lower, spacing = grid.lower, grid.spacing
    return (
        (x - lower[0]) / spacing + 0.5,
        (y - lower[1]) / spacing + 0.5,
        (z - lower[2]) / spacing + 0.5,
    )


@inner
def _walk(grid, a, b):
    """Mark the voxels from place a to place b, one after the other (Amanatides and Woo, 1987).

    The voxels of both ends are computed first, so the number of faces crossed along each axis is
    known, and rounding cannot lead out of the grid or past the end. Crossings are not summed up but
    computed from their faces. Two crossings at once lead over an edge, to the voxel across it.
    """
    if not (_near(a) and _near(b)):  # nor for NaN
        return
    ax, ay, az = a
    dx, dy, dz = b[0] - ax, b[1] - ay, b[2] - az
    nx, ny, nz = grid.counts
    enters, leaves = _clipped(ax, dx, nx, 0.0, 1.0)
    enters, leaves = _clipped(ay, dy, ny, enters, leaves)
    enters, leaves = _clipped(az, dz, nz, enters, leaves)
    if enters >= leaves:
        return
    i, far_i = _within(ax + enters * dx, nx), _within(ax + leaves * dx, nx)
    j, far_j = _within(ay + enters * dy, ny), _within(ay + leaves * dy, ny)
    k, far_k = _within(az + enters * dz, nz), _within(az + leaves * dz, nz)
    if leaves == 1.0:  # the end itself, without rounding
        far_i, far_j, far_k = _within(b[0], nx), _within(b[1], ny), _within(b[2], nz)
    step_i, face_i, left_i, inverse_x = _crossings(i, far_i, dx)
    step_j, face_j, left_j, inverse_y = _crossings(j, far_j, dy)
    step_k, face_k, left_k, inverse_z = _crossings(k, far_k, dz)
    at_x = (face_i - ax) * inverse_x if left_i > 0 else inf
    at_y = (face_j - ay) * inverse_y if left_j > 0 else inf
    at_z = (face_k - az) * inverse_z if left_k > 0 else inf
    voxel, last = (i * ny + j) * nz + k, (far_i * ny + far_j) * nz + far_k
    stride_i, stride_j = step_i * ny * nz, step_j * nz
    _mark(grid.marks, voxel)
    while voxel != last:
        at = min(at_x, at_y, at_z)
        if at_x == at:
            voxel += stride_i
            left_i -= 1
            face_i += step_i
            at_x = (face_i - ax) * inverse_x if left_i > 0 else inf
        if at_y == at:
            voxel += stride_j
            left_j -= 1
            face_j += step_j
            at_y = (face_j - ay) * inverse_y if left_j > 0 else inf
        if at_z == at:
            voxel += step_k
            left_k -= 1
            face_k += step_k
            at_z = (face_k - az) * inverse_z if left_k > 0 else inf
        _mark(grid.marks, voxel)


@leaf
def _mark(marks, voxel):
    if marks[voxel] == 0:  # most are marked already, and concurrent writes are slow
        marks[voxel] = 1


@leaf
def _near(place):
    x, y, z = place
    return abs(x) < _FARTHEST and abs(y) < _FARTHEST and abs(z) < _FARTHEST


@leaf
def _clipped(a, d, count, enters, leaves):
    """Return the part of a + t d within one axis of the grid; empty if enters >= leaves."""
    if abs(d) < _SHORTEST:
        return (enters, leaves) if 0.0 <= a < count else (1.0, 0.0)
    low, high = -a / d, (count - a) / d
    return max(enters, min(low, high)), min(leaves, max(low, high))


@leaf
def _within(place, count):
    return min(max(floor(place), 0), count - 1)


@leaf
def _crossings(voxel, last, d):
    """Step along an axis, first face to cross, number of faces to cross, and 1 / d."""
    step = 1 if last > voxel else -1
    face = float(voxel + 1 if last > voxel else voxel)
    inverse = 1.0 / d if abs(d) >= _SHORTEST else 0.0
    return step, face, abs(last - voxel), inverse


def interior_lattice(
    meshes: trimesh.Trimesh | Sequence[trimesh.Trimesh], spacing: float
) -> FloatArray:
    """Return nodes (M, 3) inside one or any of several closed meshes, in their frame, metres.

    Each mesh has its own lattice around the centre of its bounding box, so that thin parts have
    nodes too. No voxel inside a solid is missed if `spacing` is at most the voxel's side / sqrt(3).
    Raise SettingError for a spacing that makes too many nodes.
    """
    import trimesh

    require_positive("spacing", spacing)
    inside = [np.zeros((0, 3))]
    for mesh in [meshes] if isinstance(meshes, trimesh.Trimesh) else meshes:
        lower, upper = np.asarray(mesh.bounds, dtype=np.float64)
        each_side = np.floor(0.5 * (upper - lower) / spacing)
        count = float(np.prod(2.0 * each_side + 1.0))
        if not count <= MOST_NODES:
            raise SettingError(
                f"spacing is {spacing:g} m, which makes {count:.3g} nodes in a solid; accepted: a "
                f"spacing that makes at most {MOST_NODES:_}"
            )
        axes = np.meshgrid(*[np.arange(-n, n + 1.0) * spacing for n in each_side], indexing="ij")
        nodes = 0.5 * (lower + upper) + np.stack(axes, -1).reshape(-1, 3)
        inside.append(nodes[mesh_sdf(mesh, nodes)[0] < -_DEEPEST_ON_SURFACE])
    return np.concatenate(inside)


def poses_between(poses: FloatArray, *, step: float, radius: float) -> FloatArray:
    """Return poses (Q, 4, 4) on the path through poses (P, 4, 4), about one step apart.

    Nothing within `radius` metres of the frame's origin moves by more than `step` metres from one
    pose to the next. Longer moves are interpolated along straight lines and shortest turns; poses
    closer together are thinned out, but the first and the last are kept. Raise PoseError for poses
    that are not rigid, or so far apart that more than a million are needed.
    """
    require_positive("step", step)
    require_positive("radius", radius, zero=True)
    poses = np.array(frozen("poses", poses, shape=(None, 4, 4), error=PoseError))
    if len(poses) == 0:
        return poses
    check_rigid("poses", poses, tolerance=SENSOR_TOLERANCE)
    moves = _motion(poses[:-1], poses[1:], radius=radius)
    needed = len(poses) + float(moves.sum()) / step
    if not needed <= MOST_POSES:
        raise PoseError(
            f"poses move by {moves.sum():.3g} m, which takes {needed:.3g} poses {step:g} m apart; "
            f"accepted: at most {MOST_POSES:_}"
        )
    kept = poses[_thinned(moves, step)]
    steps = _motion(kept[:-1], kept[1:], radius=radius) / step
    pieces = np.maximum(np.ceil(steps - _ROUNDING), 1.0).astype(np.int64)
    start = np.repeat(np.arange(len(pieces)), pieces)
    part = np.arange(len(start)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    path = kept[start]
    between = part > 0  # the given poses stay as they are
    fraction = (part / np.repeat(pieces, pieces))[between]
    path[between] = interpolated(kept[start[between]], kept[start[between] + 1], fraction=fraction)
    return np.concatenate([path, kept[-1:]])


def _motion(first: FloatArray, second: FloatArray, *, radius: float) -> FloatArray:
    """Return how far (N,) a point can move between poses (N, 4, 4): shift plus arc of the turn."""
    shift = second[:, :3, 3] - first[:, :3, 3]
    turn = product(np.swapaxes(first[:, :3, :3], 1, 2), second[:, :3, :3])
    return np.sqrt((shift**2).sum(axis=1)) + radius * rotation_angle(turn)


def _thinned(moves: FloatArray, step: float) -> list[int]:
    """Return indices of P poses, by the P - 1 moves between: each the last within one step."""
    path = np.concatenate([[0.0], np.cumsum(moves)])
    kept = [0]
    last = len(path) - 1
    while kept[-1] < last:
        reached = int(np.searchsorted(path, path[kept[-1]] + step, side="right")) - 1
        kept.append(max(reached, kept[-1] + 1))
    return kept
