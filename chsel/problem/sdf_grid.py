"""Signed distance to an object: exact from a mesh, and sampled on a grid."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from chsel.errors import MeshError, MeshWarning, SdfError, quoted, require_choice, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray, ShapesShown, digest, frozen
from chsel.problem.mesh import mesh_digest
from chsel.problem.object_symmetry import ObjectSymmetry

if TYPE_CHECKING:
    import trimesh


LOOKUPS = ("nearest", "trilinear")
OUTSIDE = ("surface_point", "bounding_box")
OBJECT_PADDING = 0.05  # around the object, metres
MAX_NODES = 50_000_000
DEFAULT_NODES = 2_000_000  # at most, where the caller chooses no resolution; 64 MB
FINEST, COARSEST = 1e-6, 1e3  # spacing of nodes, metres, so that rounding merges no nodes
FARTHEST = 1e6  # coordinates of the first node, metres
_MOST_KEPT = 4  # grids
_kept: dict[tuple[str, float | None, float], SdfGrid] = {}  # those made last, in this order
Derived = TypeVar("Derived")
_NODES_PER_EXTENT = 20  # of the default grid, over the object's smallest extent
_DEFAULT_SPACING = 0.01  # of its nodes, at most, metres
_NODES_ACROSS = 3  # in a wall that the grid resolves
_LEAST_PADDING = 1.5  # spacings: nodes are half a spacing beside a flat side, not on it
_WALL_RAYS = 2000  # that measure walls, from points all over the surface
_WALL_SHARE = 0.05  # of the surface on thin walls that is worth a warning
_PART_NODES = 250_000  # least number of nodes that are sampled at once
_PART_FACES = 5  # faces per node of a part: preparing 1.3 million costs as much as 65 000 nodes
_WHOLE = 1e-6  # relative; from whole winding numbers the distance has its rounding by libigl
_ON_SURFACE = 1e-12  # metres; nearer to the surface, winding numbers are rounding errors
_NORMAL_RANGE = 1e-3  # metres; nearer to the surface, the face normal is the better gradient


def mesh_sdf(mesh: trimesh.Trimesh, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return exact signed distance (N,) in metres and its unit gradient (N, 3) at points (N, 3).

    Negative inside, which is where the winding number is above one half. It also holds for open
    meshes, where the one used is approximate, and for scans with folds, where pseudonormals fail.
    Within 1 mm of the surface the gradient is the normal of the closest face (CHSEL, Sec. IV-B;
    there by ray casting, which is not reproducible).
    """
    return _mesh_sdf(mesh, points)[:2]


def _mesh_sdf(
    mesh: trimesh.Trimesh, points: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return `mesh_sdf`, and flags (N,) of points inside of the surface of a closed mesh twice."""
    import igl

    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
    queries = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    if len(queries) == 0:
        return np.zeros(0), np.zeros((0, 3)), np.zeros(0, dtype=bool)
    closed = bool(mesh.is_watertight)
    # The exact winding number takes a hundred times as long for meshes of many holes.
    kind = igl.SIGNED_DISTANCE_TYPE_WINDING_NUMBER if closed else igl.SIGNED_DISTANCE_TYPE_UNSIGNED
    weighted, face, closest = igl.signed_distance(queries, vertices, faces, sign_type=kind)[:3]
    inside = weighted < 0.0 if closed else igl.fast_winding_number(vertices, faces, queries) > 0.5
    away = np.where(inside[:, None], closest - queries, queries - closest)
    distance = np.sqrt((away**2).sum(axis=1))
    # Of a closed mesh it is the distance times 1 - 2 w, with a winding number w of 0 or 1.
    signed = np.where(
        np.abs(np.abs(weighted) - distance) <= _WHOLE * distance + closed * _ON_SURFACE,
        np.where(inside, -1.0, 1.0) * np.abs(weighted),
        np.where(inside, -1.0, 1.0) * distance,
    )
    near = distance < _NORMAL_RANGE
    gradient = away / np.where(near, 1.0, distance)[:, None]
    a, b, c = (vertices[faces[face[near], i]] for i in range(3))
    normal = np.cross(b - a, c - a)  # from positions: normals in a mesh file may differ
    length = np.sqrt((normal**2).sum(axis=1, keepdims=True))
    gradient[near] = normal / np.maximum(length, 1e-300)
    return signed, gradient, closed & (weighted < -2.0 * distance - _ON_SURFACE)


@dataclass(frozen=True, eq=False, repr=False)
class SdfGrid(ShapesShown):
    """Signed distances and their gradients at the nodes of a regular grid in the object frame.

    Raises SdfError if a shape is wrong, a value is not finite, or a node of the border is inside.
    """

    origin: FloatArray  # (3,): first node, metres
    resolution: float  # node spacing, metres
    values: FloatArray  # (nx, ny, nz): signed distance in metres, negative inside
    gradients: FloatArray  # (nx, ny, nz, 3): unit gradients
    # Of the object, as declared; None: the rotations that map its surface to itself.
    symmetry: ObjectSymmetry | None = None

    def __post_init__(self) -> None:
        require_positive("SDF resolution", self.resolution)
        _check_resolution(self.resolution)
        values = frozen("SDF values", self.values, shape=(None, None, None), error=SdfError)
        if min(values.shape) < 2:
            raise SdfError(f"SDF values have shape {values.shape}; accepted: at least 2 per axis")
        gradients = frozen(
            "SDF gradients", self.gradients, shape=(*values.shape, 3), error=SdfError
        )
        faces = [np.take(values, end, axis=axis) for axis in range(3) for end in (0, -1)]
        if min(float(face.min()) for face in faces) <= 0.0:
            raise SdfError(
                "the border of the SDF grid touches the object; accepted: a grid padded so that "
                "every node of its border is outside"
            )
        origin = frozen("SDF origin", self.origin, shape=(3,), error=SdfError)
        if np.abs(origin).max() > FARTHEST:
            raise SdfError(f"SDF origin is {origin.tolist()}; accepted: up to {FARTHEST:g} (m)")
        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "gradients", gradients)

    @classmethod
    def from_mesh(
        cls,
        mesh: trimesh.Trimesh,
        resolution: float | None = None,
        *,
        padding: float = OBJECT_PADDING,
        progress: Callable[[int, int], None] | None = None,
    ) -> SdfGrid:
        """Sample the exact signed distance of a mesh, metres, over its padded bounding box.

        Values are rounded to 32 bits (nanometres), which halves the size in recordings.
        resolution: metres; None: a twentieth of the smallest extent, at most 1 cm, or what keeps
        the grid at 2 million nodes. The padding of a thin object then shrinks, so that three nodes
        are across it. A MeshWarning says what was chosen, and another which walls are thinner.
        progress: called before each part of a large grid with the number of nodes done and of all
        nodes; it changes no bit.
        """
        import trimesh

        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            accepted = "a Trimesh with faces, such as chsel.load_mesh(path)"
            raise MeshError(f"mesh is {quoted(mesh)}; accepted: {accepted}")
        require_positive("SDF padding", padding)
        if resolution is None:
            resolution, padding = _default_spacing(mesh, padding)
        require_positive("SDF resolution", resolution)
        _check_resolution(resolution)
        shape = _shape(mesh, resolution, padding=padding)
        if math.prod(shape) > MAX_NODES:
            raise SdfError(
                f"an SDF of resolution {resolution:g} m needs {math.prod(shape):.3g} nodes; "
                f"accepted: at most {MAX_NODES:.0e}, so a coarser resolution"
            )
        _warn_of_thin_walls(mesh, resolution)
        origin = np.asarray(mesh.bounds, dtype=np.float64)[0] - padding
        values = np.empty(math.prod(shape))
        gradients = np.empty((math.prod(shape), 3))
        overlaps = 0
        size = max(_PART_NODES, len(mesh.faces) // _PART_FACES)  # prepares the mesh for each part
        for first in range(0, len(values), size):
            if progress is not None:
                progress(first, len(values))
            part = slice(first, min(first + size, len(values)))
            nodes = np.stack(np.unravel_index(np.arange(part.start, part.stop), shape), axis=1)
            signed, gradient, twice = _mesh_sdf(mesh, origin + nodes * resolution)
            values[part], gradients[part] = _rounded(signed), _rounded(gradient)
            overlaps += int(twice.sum())
        if overlaps > 0:
            text = (
                f"faces of the mesh pass through one another: {overlaps} nodes of its SDF grid are "
                "inside twice, where the distance is that to the nearest face, also to those inside"
            )
            warnings.warn(MeshWarning("self_overlap", text), stacklevel=2)
        return cls(
            origin, resolution, values=values.reshape(shape), gradients=gradients.reshape(*shape, 3)
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes per axis."""
        nx, ny, nz = self.values.shape
        return nx, ny, nz

    @property
    def bounds(self) -> FloatArray:
        """First and last node (2, 3)."""
        span = (np.array(self.shape) - 1) * self.resolution
        return np.stack([self.origin, self.origin + span])

    @cached_property
    def diameter(self) -> float:
        """Diagonal in metres of the box around the object."""
        inside = np.argwhere(self.values < self.resolution) * self.resolution
        return float(np.sqrt((np.ptp(inside, axis=0) ** 2).sum())) if len(inside) else 0.0

    @property
    def has_inside(self) -> bool:
        """Whether a node is as deep in the object as nodes are apart, as one of three in a wall is.

        Depths in thinner walls are as wrong as they are large, and free points say next to nothing.
        """
        return bool(-self.values.min() >= (1.0 - 1e-6) * self.resolution)

    @cached_property
    def surface_error(self) -> float:
        """Root mean square of interpolated distances at points of the surface, metres.

        The points are those nearest to the nodes beside the surface, exact as the values are.
        """
        beside = 0.5 * math.sqrt(3.0) * self.resolution  # a surface point has a node so near
        nodes = np.argwhere(np.abs(self.values) < beside)
        i, j, k = nodes.T
        away = self.values[i, j, k][:, None] * self.gradients[i, j, k]
        distances = self.at(self.origin + nodes * self.resolution - away, lookup="trilinear")[0]
        return math.sqrt(float(np.cumsum(distances**2)[-1]) / len(nodes)) if len(nodes) else 0.0

    @cached_property
    def digest(self) -> str:
        """Digest of the grid."""
        own = digest(self.origin, np.array(self.resolution), self.values, self.gradients)
        if self.symmetry is None:
            return own
        return digest(np.frombuffer((own + self.symmetry.digest).encode(), dtype=np.uint8))

    @cached_property
    def table(self) -> FloatArray:
        """Value and gradient (nodes, 4) of all nodes."""
        return np.concatenate([self.values[..., None], self.gradients], axis=-1).reshape(-1, 4)

    def derived(self, key: Hashable, make: Callable[[], Derived]) -> Derived:
        """Return the value of `make()`, kept under a key for as long as the grid lives."""
        if key not in self._derived:
            self._derived[key] = make()
        value: Derived = self._derived[key]
        return value

    @cached_property
    def _derived(self) -> dict[Hashable, Any]:
        return {}

    def active_cells(self, level: float, lookup: str) -> BoolArray:
        """Return whether cells (nx, ny, nz) read any value below `level`.

        A cell is that around a node for lookup "nearest", and beyond a node for "trilinear".
        """
        below: BoolArray = self.values < level
        if lookup == "trilinear":
            padded = np.pad(below, ((0, 1), (0, 1), (0, 1)))
            nx, ny, nz = self.shape
            corners = [
                padded[i : i + nx, j : j + ny, k : k + nz] for i, j, k in np.ndindex(2, 2, 2)
            ]
            below = np.logical_or.reduce(corners)
        return below

    def at(
        self, points: FloatArray, *, lookup: str = "nearest", outside: str = "surface_point"
    ) -> tuple[FloatArray, FloatArray]:
        """Return signed distance (P,) and gradient (P, 3) at object-frame points (P, 3).

        lookup "nearest" takes the nearest node, ties to even (CHSEL, Sec. IV-B); "trilinear"
        interpolates values and gradients. Outside of the grid, "surface_point" returns the
        distance to the surface point closest to the grid's nearest point, an upper bound;
        "bounding_box" returns the distance to the grid's box.
        """
        require_choice("lookup", lookup, accepted=LOOKUPS)
        require_choice("outside", outside, accepted=OUTSIDE)
        points = np.asarray(points, dtype=np.float64)
        first, last = self.bounds
        clamped = np.fmin(np.fmax(points, first), last)
        cell = (clamped - first) * (1.0 / self.resolution)
        if lookup == "nearest":
            rows = self._rows(np.rint(cell))
        else:
            base = self.lowest_nodes(cell)
            fraction = cell - base
            rows = np.zeros((len(cell), 4))
            sides = (1.0 - fraction, fraction)
            for corner in np.ndindex(2, 2, 2):
                i, j, k = corner
                weight = sides[i][:, 0] * sides[j][:, 1] * sides[k][:, 2]
                rows = rows + weight[:, None] * self._rows(base + np.array(corner))
        value = rows[:, 0].copy()
        gradient = rows[:, 1:].copy()
        beyond = (clamped != points).any(axis=1)
        if beyond.any():
            away = points[beyond] - clamped[beyond]
            if outside == "surface_point":
                unit = gradient[beyond] / _lengths(gradient[beyond])
                away = away + value[beyond, None] * unit
            distance = _lengths(away)
            value[beyond] = distance[:, 0]
            gradient[beyond] = away / distance
        return value, gradient

    def lowest_nodes(self, coordinates: FloatArray) -> FloatArray:
        """Return the lowest nodes (P, 3) of the cells that hold grid coordinates (P, 3)."""
        lowest: FloatArray = np.minimum(np.floor(coordinates), np.array(self.shape) - 2.0)
        return lowest

    def _rows(self, nodes: FloatArray) -> FloatArray:
        """Return value and gradient (P, 4) of nodes (P, 3)."""
        return self.table[np.ravel_multi_index(tuple(nodes.astype(np.int64).T), self.shape)]


def _lengths(vectors: FloatArray) -> FloatArray:
    """Return lengths (P, 1) of vectors (P, 3), at least 1e-12, summed in the order of axes."""
    squares = vectors * vectors
    sums = (squares[:, 0:1] + squares[:, 1:2]) + squares[:, 2:3]
    lengths: FloatArray = np.maximum(np.sqrt(sums), 1e-12)
    return lengths


def _default_spacing(mesh: trimesh.Trimesh, padding: float) -> tuple[float, float]:
    """Return spacing and padding, metres, of a grid of at most DEFAULT_NODES nodes."""
    extents = np.asarray(mesh.extents, dtype=np.float64)
    thickness = float(extents.min())
    if not min(thickness, float(mesh.area)) > 0.0:
        raise MeshError("mesh is flat; accepted: a solid, with three extents above 0")
    spacing = usual = min(_DEFAULT_SPACING, thickness / _NODES_PER_EXTENT)
    if mesh.is_watertight:  # the mean one, also of a plate that is not along the axes
        thickness = min(thickness, 2.0 * abs(float(mesh.volume)) / float(mesh.area))
    coarsest = thickness / _NODES_ACROSS
    while math.prod(_shape(mesh, spacing, padding=padding)) > DEFAULT_NODES:
        if spacing < coarsest:
            spacing = min(1.01 * spacing, coarsest)
        elif padding > _LEAST_PADDING * spacing:
            padding = max(0.9 * padding, _LEAST_PADDING * spacing)
        else:
            spacing *= 1.01
            padding = _LEAST_PADDING * spacing
    if spacing > usual:
        size = " x ".join(f"{1e3 * extent:.3g}" for extent in extents)
        lost = " (thinner parts may be missing)" if spacing > coarsest else ""
        text = (
            f"the SDF grid of an object of {size} mm has nodes {1e3 * spacing:.3g} mm apart{lost} "
            f"and a padding of {1e3 * padding:.3g} mm: {1e3 * usual:.3g} mm would take more than "
            f"{DEFAULT_NODES / 1e6:g} million nodes; choose another by resolution"
        )
        warnings.warn(MeshWarning("coarse_grid", text), stacklevel=3)
    return spacing, padding


def _warn_of_thin_walls(mesh: trimesh.Trimesh, resolution: float) -> None:
    """Warn if much of a mesh's surface is on walls in which a grid has less than three nodes."""
    walls = wall_thicknesses(mesh, _NODES_ACROSS * resolution)
    thin = np.isfinite(walls)
    if thin.mean() < _WALL_SHARE:
        return
    share = f"{thin.mean():.0%}"
    typical = f"{1e3 * np.median(walls[thin]):.3g} mm"
    text = (
        f"{share} of the object's surface is on walls of {typical} (median), in which the SDF grid "
        f"has less than {_NODES_ACROSS} nodes: they are {1e3 * resolution:.3g} mm apart, and poses "
        "may be wrong; choose a finer one by resolution"
    )
    warnings.warn(MeshWarning("thin_walls", text), stacklevel=3)


def wall_thicknesses(mesh: trimesh.Trimesh, below: float) -> FloatArray:
    """Return thickness in metres of the object behind points (S,) all over its surface.

    It is measured straight into the object, and infinite where it is not less than `below`, or the
    way does not end outside of the object, such as where its parts overlap.
    """
    import igl
    import trimesh

    points, on = trimesh.sample.sample_surface(mesh, _WALL_RAYS, seed=0)
    inwards = -np.asarray(mesh.face_normals)[on]
    step = 1e-5 * float(np.linalg.norm(mesh.extents))  # to either side of a face
    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
    tree = igl.AABB()
    tree.init(vertices, faces)
    hit, way, _ = tree.intersect_ray_first(vertices, faces, points + step * inwards, inwards)
    thicknesses = np.where(hit >= 0, way + step, np.inf)
    thin = np.flatnonzero(thicknesses < below - step)
    beyond = points[thin] + (thicknesses[thin] + step)[:, None] * inwards[thin]
    thicknesses[thin[mesh_sdf(mesh, beyond)[0] <= 0.0]] = np.inf
    return np.where(thicknesses < below - step, thicknesses, np.inf)


def _shape(mesh: trimesh.Trimesh, resolution: float, *, padding: float) -> tuple[int, ...]:
    """Return nodes per axis of the grid of a mesh."""
    lower, upper = np.asarray(mesh.bounds, dtype=np.float64)
    span = upper + padding - (lower - padding)
    return tuple(int(n) + 2 for n in np.floor(span / resolution))


def _check_resolution(resolution: float) -> None:
    if not FINEST <= resolution <= COARSEST:
        raise SdfError(f"SDF resolution is {resolution}; accepted: {FINEST:g} to {COARSEST:g} (m)")


def _rounded(values: FloatArray) -> FloatArray:
    return values.astype(np.float32).astype(np.float64) + 0.0  # without negative zeros


def object_grid(
    mesh: trimesh.Trimesh,
    resolution: float | None = None,
    *,
    padding: float = OBJECT_PADDING,
    progress: Callable[[int, int], None] | None = None,
) -> SdfGrid:
    """Return the grid of a clean mesh by `SdfGrid.from_mesh`, kept for later calls."""
    key = mesh_digest(mesh), resolution, padding
    grid = _kept.get(key)
    if grid is None:
        grid = SdfGrid.from_mesh(mesh, resolution, padding=padding, progress=progress)
        if grid.values.size <= DEFAULT_NODES:
            _kept[key] = grid
        for oldest in list(_kept)[:-_MOST_KEPT]:
            _kept.pop(oldest, None)
    return grid
