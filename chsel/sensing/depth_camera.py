"""Pinhole cameras, reliable pixels of depth images, and regions that belong together."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, hypot, isqrt, sqrt
from typing import Any, NamedTuple

import numpy as np

from chsel.errors import (
    InputWarning,
    PointsError,
    PoseError,
    SettingError,
    quoted,
    require_at_most,
    require_positive,
)
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, frozen
from chsel.problem.points import FARTHEST_PLACE, Lattice
from chsel.problem.poses import apply, nearest_rigid, rotated

MOST_PIXELS = 100_000  # on a side
MOST_FOCUS = 1e6  # pixels: focal lengths, and coordinates of the principal point
_STEEPEST = 4.0  # tangent of the angle between a surface's normal and the ray: 76 degrees
_SPACINGS = 4.0  # random points on a surface are one region up to so many typical distances
_MOST_ASKED = 2000  # points whose nearest neighbours give the typical distance
_JUMP = 0.02  # m: between neighbouring pixels of different surfaces
_REGION_JUMP = 0.01  # share of the depth: the same within a mask
_PART = 0.05  # of the largest region of a mask: smaller ones are left out
_OUTLINE = 2  # pixels by which a mask may be off
_FARTHEST = 20.0  # m: of what a camera sees nearest
_STEP = 0.003  # share of the depth: of a surface, between neighbouring pixels, by its noise
_WINDOW = 0.25  # of the distance between points: from which pixels a normal is
_MOST_REACH = 6  # pixels: of this window
_BENT = 0.35  # radians between the planes of two halves of a window: there is an edge between
_LEAST_AREA = 1e-3  # determinant of the second moments of pixels that are in no line
_MATRIX_ROUNDING = 1e-6  # of the focal length
_OFF_CENTRE = 0.05  # of the longer side: principal points are nearer to the centre


@dataclass(frozen=True)
class PinholeCamera:
    """A camera without distortion; its frame has x right, y down, z forward.

    The centre of the first pixel is at (0, 0). Raises SettingError for impossible values.
    """

    width: int  # of the image, pixels
    height: int
    fx: float  # focal lengths, pixels
    fy: float
    cx: float  # principal point, pixels
    cy: float

    def __post_init__(self) -> None:
        for name, value in (("width", self.width), ("height", self.height)):
            if value not in range(1, MOST_PIXELS + 1):
                raise SettingError(
                    f"camera {name} is {value}; accepted: a whole number from 1 to {MOST_PIXELS:_}"
                )
        require_positive("camera fx", self.fx)
        require_positive("camera fy", self.fy)
        require_at_most("camera fx", self.fx, most=MOST_FOCUS)
        require_at_most("camera fy", self.fy, most=MOST_FOCUS)
        if not (np.abs([self.cx, self.cy]) <= MOST_FOCUS).all():
            raise SettingError(
                f"camera cx, cy are {self.cx}, {self.cy}; accepted: finite numbers up to "
                f"{MOST_FOCUS:_} (pixels)"
            )

    @classmethod
    def of_matrix(cls, matrix: Any, width: int, *, height: int) -> PinholeCamera:
        """Return the camera of a matrix (3, 3). Raise SettingError if it is not a pinhole's."""
        fx, fy, cx, cy = matrix_numbers(matrix)
        return cls(width, height, fx=fx, fy=fy, cx=cx, cy=cy)

    def check_centre(self) -> list[InputWarning]:
        """Return a warning if the principal point is another image's, or cx and cy are swapped.

        That is, outside of the image, or far from its centre and much nearer to it when swapped.
        """
        middle_x, middle_y = 0.5 * (self.width - 1), 0.5 * (self.height - 1)
        away = hypot(self.cx - middle_x, self.cy - middle_y)
        swapped = hypot(self.cy - middle_x, self.cx - middle_y)
        inside = 0.0 <= self.cx <= self.width and 0.0 <= self.cy <= self.height
        off_centre = away > _OFF_CENTRE * max(self.width, self.height)
        if inside and not (off_centre and 2.0 * swapped < away):
            return []
        where = "for" if inside else "outside of"
        text = (
            f"cx, cy are {self.cx:g}, {self.cy:g}, {where} an image of {self.width} x "
            f"{self.height} pixels (width x height); check that they are of this image, not swapped"
        )
        return [InputWarning("principal_point", text)]

    @property
    def columns(self) -> FloatArray:
        """x / z (W,) of what each column sees."""
        return (np.arange(self.width, dtype=np.float64) - self.cx) / self.fx

    @property
    def rows(self) -> FloatArray:
        """y / z (H,) of what each row sees."""
        return (np.arange(self.height, dtype=np.float64) - self.cy) / self.fy

    def directions(self) -> FloatArray:
        """Return where each pixel looks (H, W, 3) in the camera frame, with z = 1."""
        return self.back_project(np.ones((self.height, self.width)))

    def back_project(self, depth: Any) -> FloatArray:
        """Return points (H, W, 3) in the camera frame, metres, of depths (H, W) along z.

        Depths that are not finite give such points. Raise PointsError for another shape.
        """
        depth = self.image("depth", depth)
        with np.errstate(invalid="ignore"):  # 0 times infinity
            x, y = self.columns * depth, self.rows[:, None] * depth
        return np.stack([x, y, depth], axis=-1)

    def image(self, name: str, values: Any, *, dtype: Any = np.float64) -> np.ndarray:
        """Return values (H, W) as an array. Raise PointsError for another shape."""
        values = np.asarray(values, dtype=dtype)
        if values.shape != (self.height, self.width):
            raise PointsError(
                f"{name} has shape {values.shape}; accepted: ({self.height}, {self.width}), as its "
                "camera"
            )
        return values


def matrix_numbers(
    matrix: Any, *, skew: float = _MATRIX_ROUNDING
) -> tuple[float, float, float, float]:
    """Return fx, fy, cx and cy, pixels, of a camera's matrix (3, 3).

    skew: the largest that is left out, of the focal length. Raise SettingError for a matrix that is
    not a pinhole camera's.
    """
    matrix = frozen("camera", matrix, shape=(3, 3), error=SettingError)
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    off = np.abs(matrix - np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))
    most = np.full((3, 3), _MATRIX_ROUNDING)
    most[0, 1] = skew
    if (off > most * max(abs(fx), 1.0)).any():
        raise SettingError(
            f"camera is {quoted(matrix.tolist())}, not a pinhole camera's matrix; accepted: "
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] by rows, pixels"
        )
    return fx, fy, cx, cy


def valid_pixels(depth: FloatArray, *, nearest: float, furthest: float) -> BoolArray:
    """Return whether pixels (H, W) have a depth from nearest to furthest, metres.

    Cameras mark pixels without a measurement by 0, NaN, infinity or a negative number.
    """
    depth = np.asarray(depth)
    return np.isfinite(depth) & (depth > 0.0) & (depth >= nearest) & (depth <= furthest)


def occlusion_edges(
    depth: FloatArray, valid: BoolArray, *, jump: float, reach: int = 1
) -> BoolArray:
    """Return pixels (H, W) that differ by more than `jump` metres from one of their neighbours.

    On both sides of the jump, as either may be wrong. depth (H, W): metres. valid (H, W): pixels
    that count, all finite. reach: the distance in pixels, along rows and columns, up to which a
    pixel is a neighbour; 2 also finds jumps across one invalid pixel.
    """
    depth = np.where(valid, np.asarray(depth, np.float64), 0.0)
    nearest = _least_around(np.where(valid, depth, np.inf), reach)
    furthest = -_least_around(np.where(valid, -depth, np.inf), reach)
    return valid & ((furthest - depth > jump) | (depth - nearest > jump))


def _least_around(image: FloatArray, reach: int) -> FloatArray:
    """Return the least (H, W) of the pixels up to `reach` from each, along rows and columns."""
    from scipy.ndimage import minimum_filter  # which takes long to import

    return minimum_filter(image, 2 * reach + 1, mode="constant", cval=np.inf)


class MainRegions(NamedTuple):
    """The measurements that belong together, and how many were left out by which reason."""

    kept: BoolArray  # (N,)
    small: int  # measurements in regions that are too small
    far: int  # measurements in regions that are too far from the largest


def depth_regions(
    depth: FloatArray, counts: BoolArray, *, camera: PinholeCamera, jump: float
) -> IntArray:
    """Return the region (H, W) of each pixel of a depth image, from 1; 0 where none counts.

    Pixels that share a side are connected unless their depths, metres along z, jump: differ by
    more than `jump` times the depth, besides what a surface steeply inclined to the ray explains.
    counts (H, W): pixels with a depth above 0.
    """
    from scipy.ndimage import label  # which takes long to import

    depth = np.where(counts, np.asarray(depth, dtype=np.float64), 0.0)
    height, width = depth.shape
    cells = np.zeros((2 * height - 1, 2 * width - 1), dtype=bool)  # pixels, and links between them
    cells[::2, ::2] = counts
    cells[::2, 1::2] = _linked(depth[:, 1:], depth[:, :-1], share=jump + _STEEPEST / camera.fx)
    cells[1::2, ::2] = _linked(depth[1:], depth[:-1], share=jump + _STEEPEST / camera.fy)
    return np.asarray(label(cells)[0][::2, ::2])


def point_regions(points: FloatArray, gap: float) -> IntArray:
    """Return the region (N,) of each of points (N, 3), finite, metres; from 1.

    Points up to `gap` metres apart are connected, or up to four times the typical distance between
    neighbours where that is more. Points more than 3.5 times as far apart are not.
    """
    from scipy.sparse import csr_array  # which takes long to import
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return np.ones(len(points), dtype=np.int64)
    asked = points[:: -(-len(points) // _MOST_ASKED)]
    spacing = float(np.median(cKDTree(points).query(asked, k=2)[0][:, 1]))
    side = max(gap, _SPACINGS * spacing)
    voxels, of_point = np.unique(
        np.floor((points - points.min(axis=0)) / side), axis=0, return_inverse=True
    )
    pairs = cKDTree(voxels).query_pairs(1.5, p=np.inf, output_type="ndarray")
    links = csr_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(voxels), len(voxels)))
    regions = connected_components(links, directed=False)[1]
    return regions[of_point.reshape(-1)].astype(np.int64) + 1


def main_regions(
    regions: IntArray,
    *,
    part: float,
    points: FloatArray | None = None,
    diameter: float | None = None,
) -> MainRegions:
    """Keep the largest region of measurements, and others that can belong to the same object.

    regions (N,): the region of each measurement, from 1. A region is left out if it has fewer than
    `part` times the measurements of the largest. points (N, 3) and the object's diameter, metres:
    it is also left out if its mean is further from that of the largest than the diameter, as no two
    means of points on one object are.
    """
    if len(regions) == 0:
        return MainRegions(np.zeros(0, dtype=bool), 0, far=0)
    sizes = np.bincount(regions)
    sizes[0] = 0
    largest = int(np.argmax(sizes))
    small = sizes < part * sizes[largest]
    far = np.zeros_like(small)
    if points is not None and diameter is not None:
        sums = np.stack([np.bincount(regions, weights=axis) for axis in points.T], axis=1)
        means = sums / np.maximum(sizes, 1)[:, None]
        far = ~small & (((means - means[largest]) ** 2).sum(axis=1) > diameter**2)
    kept: BoolArray = ~(small | far)[regions]
    return MainRegions(kept, int(sizes[small].sum()), far=int(sizes[far].sum()))


def small_regions(regions: IntArray, least: int) -> BoolArray:
    """Return pixels (H, W) in regions of fewer than `least` pixels."""
    small = np.bincount(regions.reshape(-1)) < least
    small[0] = False
    return np.asarray(small[regions])


def speckle_free(
    depth: FloatArray, valid: BoolArray, *, regions: IntArray, least: int
) -> tuple[FloatArray, int]:
    """Return depths (H, W) up to which rays are free, and how many pixels are in small regions.

    Pixels in regions of fewer than `least` pixels have the least depth of all valid ones (H, W)
    around them, so far that some are not of their region: if those are right, no ray is too long.
    """
    speckles = small_regions(regions, least)
    depth = np.asarray(depth, np.float64)
    around = _least_around(np.where(valid, depth, np.inf), isqrt(least) // 2 + 2)
    return np.where(speckles, around, depth), int(speckles.sum())


def _linked(one: FloatArray, other: FloatArray, *, share: float) -> BoolArray:
    """Return whether pairs of depths are connected; none is with 0."""
    nearer = np.minimum(one, other)
    return (nearer > 0.0) & (np.abs(one - other) <= share * nearer)


class DepthLook(NamedTuple):
    """Free rays and surface points of a depth image."""

    camera: PinholeCamera
    pose: FloatArray  # (4, 4), world_from_camera
    depth: FloatArray  # (H, W), metres, 0 where there is none
    ends: FloatArray  # (H, W), metres: depths up to which rays are free
    rays: BoolArray  # (H, W): pixels whose rays count
    surface: FloatArray  # (M, 3): points on the object, world
    normals: FloatArray  # (M, 3): unit, world; 0 where one is not known, or none was asked for


def depth_look(
    depth: Any,
    camera: PinholeCamera,
    *,
    world_from_camera: Any,
    mask: Any = None,
    before: float,
    side: float,
    with_normals: bool = False,
) -> DepthLook:
    """Return the free rays of a depth image, and points of what a mask (H, W) says is the object.

    before: metres that rays end before what they see. side: of voxels of which each gives one point
    at most, metres. with_normals: see `pixel_normals`. Pixels beside jumps of depth, at the mask's
    outline and in its small regions are left out. Raise PointsError for an image without a depth,
    or a mask without a pixel left.
    """
    from scipy.ndimage import binary_erosion  # which takes long to import

    pose = frozen(
        "world_from_camera", world_from_camera, shape=(4, 4), error=PoseError, most=FARTHEST_PLACE
    )
    pose = nearest_rigid("world_from_camera", pose[None])[0]
    valid = valid_pixels(camera.image("depth", depth), nearest=0.0, furthest=np.inf)
    if not valid.any():
        raise PointsError("depth has no measurement; accepted: metres above 0")
    if (nearest := float(depth[valid].min())) > _FARTHEST:
        raise PointsError(f"the nearest depth is {nearest:g} m: millimetres? accepted: metres")
    depth = np.where(valid, depth, 0.0)
    rays = valid & ~occlusion_edges(depth, valid, jump=_JUMP)
    surface = normals = np.zeros((0, 3))
    if mask is not None:
        mask = camera.image("mask", mask, dtype=bool)
        within = binary_erosion(mask, np.ones((3, 3)), iterations=_OUTLINE, border_value=1)
        on_object = within & rays
        regions = depth_regions(depth, on_object, camera=camera, jump=_REGION_JUMP)
        on_object[on_object] = main_regions(regions[on_object], part=_PART).kept
        if not on_object.any():
            raise PointsError(
                f"none of the {int(mask.sum())} pixels of mask is on a surface; accepted: a mask "
                "with pixels of a measured depth, inside of its outline"
            )
        if (away := float(np.median(depth[on_object]))) > _FARTHEST:
            raise PointsError(
                f"what mask shows is {away:g} m away: millimetres, or a mask beside the object? "
                "accepted: metres"
            )
        surface = apply(pose, camera.back_project(depth)[on_object])
        chosen = first_in_voxels(surface, side)
        surface = surface[chosen]
        normals = np.zeros_like(surface)
        if with_normals:
            pixels = np.argwhere(on_object)[chosen]
            reach = _WINDOW * side * min(camera.fx, camera.fy) / away
            reach = int(np.clip(np.rint(reach), 1, _MOST_REACH))
            found = pixel_normals(depth, on_object, pixels=pixels, camera=camera, reach=reach)
            normals = rotated(pose[:3, :3], found)
        rays &= on_object | ~mask
    return DepthLook(
        camera,
        pose,
        depth=depth,
        ends=np.maximum(depth - before, 0.0),
        rays=rays,
        surface=surface,
        normals=normals,
    )


def pixel_normals(
    depth: FloatArray, counts: BoolArray, *, pixels: IntArray, camera: PinholeCamera, reach: int
) -> FloatArray:
    """Return normals (M, 3) of what pixels (M, 2), rows and columns, see, towards the camera.

    Unit vectors in the camera frame, of the planes nearest to the inverse depths around each pixel,
    as these are linear in rows and columns on a plane. depth (H, W): metres. counts (H, W): pixels
    that can be used, with a depth above 0. reach: pixels used on each side, those that no jump of
    depth separates from the middle. A normal is 0 where these are fewer than half of all, and where
    the planes of two opposite halves differ, as at an edge.
    """
    steps = np.arange(-reach, reach + 1)
    down, right = (each.reshape(-1, 1) for each in np.meshgrid(steps, steps, indexing="ij"))
    rows = pixels[:, 0] + down
    columns = pixels[:, 1] + right
    inside = (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    rows = np.clip(rows, 0, camera.height - 1)
    columns = np.clip(columns, 0, camera.width - 1)
    there = depth[rows, columns]
    used = _joined(there, inside & counts[rows, columns], camera=camera, reach=reach)
    inverse_depth = 1.0 / np.where(used, there, 1.0)
    whole, *halves = (
        _plane_normals(
            used & part,
            down=down,
            right=right,
            inverse_depth=inverse_depth,
            pixels=pixels,
            camera=camera,
        )
        for part in (True, down <= 0, down >= 0, right <= 0, right >= 0)
    )
    straight = 2 * used.sum(axis=0) > len(used)
    for one, other in (halves[:2], halves[2:]):
        known = one.any(axis=1) & other.any(axis=1)
        straight &= ~known | ((one * other).sum(axis=1) >= cos(_BENT))
    return np.where(straight[:, None], whole, 0.0)


def _joined(
    there: FloatArray, counts: BoolArray, *, camera: PinholeCamera, reach: int
) -> BoolArray:
    """Return which pixels of windows (K, M) are joined to the middle by pixels of one surface."""
    side = 2 * reach + 1
    used = np.zeros_like(counts)
    middle = np.array([reach, reach])
    for at in sorted(np.ndindex(side, side), key=lambda at: np.abs(at - middle).max()):
        step = np.sign(at - middle)  # away from the middle
        before = np.ravel_multi_index(at - step, (side, side))
        n = np.ravel_multi_index(at, (side, side))
        if n == before:
            used[n] = counts[n]
            continue
        share = _STEP + _STEEPEST * max(abs(step[1]) / camera.fx, abs(step[0]) / camera.fy)
        used[n] = counts[n] & used[before] & _linked(there[n], there[before], share=share)
    return used


def _plane_normals(
    used: BoolArray,
    *,
    down: IntArray,
    right: IntArray,
    inverse_depth: FloatArray,
    pixels: IntArray,
    camera: PinholeCamera,
) -> FloatArray:
    """Return normals (M, 3) of planes through used pixels of windows (K, M), 0 for a line."""
    weights = used / np.maximum(used.sum(axis=0), 1)

    def mean(values: Any) -> FloatArray:
        return np.asarray((weights * values).sum(axis=0))

    x = mean(right)
    y = mean(down)
    q = mean(inverse_depth)
    xx = mean((right - x) ** 2)
    yy = mean((down - y) ** 2)
    xy = mean((right - x) * (down - y))
    xq = mean((right - x) * (inverse_depth - q))
    yq = mean((down - y) * (inverse_depth - q))
    area = xx * yy - xy * xy
    is_plane = area > _LEAST_AREA
    area = np.where(is_plane, area, 1.0)
    per_column = (yy * xq - xy * yq) / area
    per_row = (xx * yq - xy * xq) / area
    # Inverse depth is linear in rays (u, v, 1) with a normal's components as coefficients.
    rows, columns = pixels.T
    at_axis = q - per_column * (x + columns - camera.cx) - per_row * (y + rows - camera.cy)
    normals = -np.stack([camera.fx * per_column, camera.fy * per_row, at_axis], axis=1)
    lengths = np.sqrt((normals**2).sum(axis=1))
    is_plane &= lengths > 0.0
    lengths = np.where(is_plane, lengths, 1.0)
    return np.where(is_plane[:, None], normals / lengths[:, None], 0.0)


def one_per_voxel(points: FloatArray, side: float) -> FloatArray:
    """Return those of points (N, 3) nearest to the centre of their voxel (M, 3), in their order."""
    return points[first_in_voxels(points, side)]


def first_in_voxels(points: FloatArray, side: float) -> IntArray:
    """Return indices (M,) of points (N, 3) nearest to the centre of their voxel, ascending."""
    lattice = Lattice((0.0, 0.0, 0.0), side)
    voxels = lattice.voxels(points)
    distance = ((points - lattice.centres(voxels)) ** 2).sum(axis=1)
    nearest_first = np.argsort(distance, kind="stable")
    _, first = np.unique(voxels[nearest_first], axis=0, return_index=True)
    return np.sort(nearest_first[first])


def outside_of(on_object: FloatArray, free: FloatArray, *, spacing: float) -> FloatArray:
    """Return free centres (N, 3) but for those that a measured surface point can lie behind.

    A ray that passes a voxel passes its centre at up to half the voxel's diagonal, so that nearer
    to the surface than this a centre may be inside the object.
    """
    return free[~may_be_inside(on_object, free, spacing=spacing)]


def may_be_inside(on_object: FloatArray, free: FloatArray, *, spacing: float) -> BoolArray:
    """Return which of free centres (N, 3) a measured surface point can lie behind."""
    if len(on_object) == 0 or len(free) == 0:
        return np.zeros(len(free), dtype=np.bool_)
    from scipy.spatial import cKDTree  # which takes long to import

    margin = sqrt(0.75) * spacing
    nearest = cKDTree(on_object).query(free, distance_upper_bound=margin)[0]
    return np.asarray(nearest <= margin)
