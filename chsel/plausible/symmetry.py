"""The rotations that map an object onto itself: poses that differ by one look the same.

They are searched on the surface: first for axes of revolution, then for a finite group.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.plausible.surface_distance import surface_points
from chsel.problem.mesh import mesh_digest
from chsel.problem.object_symmetry import (
    ObjectSymmetry,
    angles_between,
    distinct_turns,
    generated,
)
from chsel.problem.poses import axis_angle, rotation_matrices
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from chsel.problem.surface import has_surface, object_centre

if TYPE_CHECKING:
    import trimesh

_TOLERANCE = 0.0085  # of the diameter
_TESTED = 1000  # points by which a rotation is tested
_POINTS = 20_000  # points that mark the cells of the coarse grid
_CELLS = 48  # of the coarse grid, along each axis
_AT_ONCE = 2000  # rotations
_ON_SURFACE = 1e-6  # of the radius: nearer, the face's normal is the better direction
_DAMPING = 1e-4

_ANGLES = np.arange(1.0, 17.0) * np.pi * (3.0 - np.sqrt(5.0))  # golden: of no n-fold symmetry
_SPREAD = 12_000  # rotations, about 9 degrees apart
_NEIGHBOURS = 16
_COARSE = 0.05  # of the diameter: coarse errors of rotations within 9 degrees of a symmetry
_MOST_CANDIDATES, _MOST_ALIGNED = 400, 50
_SAME = np.deg2rad(10.0)  # between two approximations of one element
_FOUND: dict[str, ObjectSymmetry] = {}  # by digests of meshes


def object_symmetry(mesh: trimesh.Trimesh) -> ObjectSymmetry:
    """Return the symmetries of a mesh, within the tolerance of `RotatedSurface`.

    The centre is the surface's centroid, which every symmetry maps to itself, and which open meshes
    have, too. A pure function of vertices and faces; results are kept.
    """
    key = mesh_digest(mesh)
    if key not in _FOUND:
        surface = RotatedSurface(mesh)
        axes = _axes_of_revolution(surface) if surface.radius > 0.0 else np.zeros((0, 3))
        if len(axes) > 1:
            symmetry = ObjectSymmetry(surface.centre, sphere=True)
        elif len(axes) == 1:
            half_turn = _half_turn_across(surface, axes[0])
            symmetry = ObjectSymmetry(surface.centre, half_turn, axis=axes[0])
        elif surface.radius > 0.0:
            symmetry = ObjectSymmetry(surface.centre, _finite_group(surface))
        else:
            symmetry = ObjectSymmetry(surface.centre)
        _FOUND[key] = symmetry
    return _FOUND[key]


def symmetry_of(sdf: SdfGrid, mesh: trimesh.Trimesh) -> ObjectSymmetry:
    """Return the symmetries that are declared of a grid's object, else those of its mesh."""
    return object_symmetry(mesh) if sdf.symmetry is None else sdf.symmetry


def grid_symmetry(sdf: SdfGrid) -> ObjectSymmetry:
    """Return the declared ones of an object without a mesh, else the identity about its centre."""
    if sdf.symmetry is not None:
        return sdf.symmetry
    return ObjectSymmetry(object_centre(sdf) if has_surface(sdf) else sdf.bounds.mean(axis=0))


class RotatedSurface:
    """The surface of a mesh about its centroid, at unit radius.

    A rotation matches if the root mean square distance from the surface, of points of it that are
    rotated, is at most 0.85 % of the diameter, which is twice the distance from the centroid to the
    farthest vertex: scans of objects that are symmetric by design have up to 0.66 %, a tapered can
    turned upside down has 1.14 %.
    """

    centre: FloatArray  # (3,), the surface's centroid in the frame of the mesh, m
    radius: float  # from the centroid to the farthest vertex, m; 0 for a mesh without an area
    corners: FloatArray  # (F, 3, 3), of each face
    normals: FloatArray  # (F, 3), unit
    areas: FloatArray  # (F,), shares of the total

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        """Set centre and radius alone for a mesh without an area."""
        import igl
        import trimesh

        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces)
        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.sqrt((normals**2).sum(axis=1))  # twice the areas of faces
        self.centre = corners.reshape(-1, 3).mean(axis=0)
        self.radius = 0.0
        if not areas.sum() > 0.0:
            return
        self.centre = (areas[:, None] * corners.mean(axis=1)).sum(axis=0) / areas.sum()
        self.radius = float(np.sqrt(((corners - self.centre) ** 2).sum(axis=-1)).max())
        self.corners = (corners - self.centre) / self.radius
        self.normals = normals / np.maximum(areas, 1e-300)[:, None]
        self.areas = areas / areas.sum()
        self._vertices = np.ascontiguousarray((vertices - self.centre) / self.radius)
        self._faces = np.ascontiguousarray(faces, dtype=np.int64)
        unit = trimesh.Trimesh(self._vertices, self._faces, process=False)
        self._points = surface_points(unit, _POINTS, key=StreamKey(0, 0))  # (P, 3)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def errors(self, turns: FloatArray, count: int = _TESTED) -> FloatArray:
        """Return RMS distances (T,) under rotations (T, 3, 3), in units of the tolerance."""
        _, squared, _, _ = self._closest(turns, count)
        return np.sqrt(squared.mean(axis=1)) / (2.0 * _TOLERANCE)

    def aligned(self, turns: FloatArray, *, steps: int, count: int) -> FloatArray:
        """Return rotations (T, 3, 3) moved to the nearest one that matches the surface best.

        It takes Gauss-Newton steps on the distances of rotated points from the surface.
        """
        for _ in range(steps):
            moved, squared, face, closest = self._closest(turns, count)
            distance = np.sqrt(squared)
            on_surface = (distance < _ON_SURFACE)[..., None]
            apart = moved - closest
            outward = apart / np.where(on_surface, 1.0, distance[..., None])
            direction = np.where(on_surface, self.normals[face], outward)
            distance = (apart * direction).sum(axis=-1)  # with a sign where the surface is crossed
            slope = np.cross(moved, direction)
            hessian = np.einsum("tni,tnj->tij", slope, slope) / count + _DAMPING * np.eye(3)
            gradient = np.einsum("tni,tn->ti", slope, distance) / count
            half = -0.5 * np.linalg.solve(hessian, gradient[..., None])[..., 0]
            quaternion = np.concatenate([half, np.ones((len(half), 1))], axis=1)
            quaternion /= np.sqrt((quaternion**2).sum(axis=1, keepdims=True))
            turns = rotation_matrices(quaternion) @ turns
        return turns

    def coarse_errors(self, turns: FloatArray, count: int = 128) -> FloatArray:
        """Return mean distances (T,) of rotated points from the surface by a grid, in diameters."""
        from scipy.ndimage import distance_transform_edt

        empty = np.ones((_CELLS, _CELLS, _CELLS), dtype=bool)
        empty[_cells(self._points)] = False
        distance = distance_transform_edt(empty) / _CELLS
        means = np.empty(len(turns))
        for first in range(0, len(turns), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            moved = np.einsum("tij,nj->tni", turns[some], self._points[:count])
            means[some] = distance[_cells(moved)].mean(axis=1)
        return means

    def _closest(
        self, turns: FloatArray, count: int
    ) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
        """Return rotated points (T, count, 3), squared distances, and nearest faces and points."""
        moved = np.einsum("tij,nj->tni", turns, self._points[:count])
        squared, face, closest = self._tree.squared_distance(
            self._vertices, self._faces, moved.reshape(-1, 3)
        )
        each = moved.shape[:2]
        return moved, squared.reshape(each), face.reshape(each), closest.reshape(moved.shape)


def _cells(points: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return indices of the cells in which points (..., 3) of the unit ball are."""
    index = np.clip(((points + 1.0) * (_CELLS / 2)).astype(np.int64), 0, _CELLS - 1)
    return index[..., 0], index[..., 1], index[..., 2]


def _axes_of_revolution(surface: RotatedSurface) -> FloatArray:
    """Return unit axes (A, 3) about which every rotation matches: none, one, or two of a sphere's.

    Candidates are the axes of inertia, which bear noise of normals, and those of slippage, which
    bear equal moments: rotations about u move points p within the surface where n . (u x p) = 0
    (Gelfand and Guibas, 2004).
    """
    middles = (surface.corners + np.roll(surface.corners, 1, axis=1)) / 2.0  # exact for squares
    slips = np.cross(middles, surface.normals[:, None])
    moments = [np.einsum("f,fki,fkj->ij", surface.areas, v, v) for v in (slips, middles)]
    axes = np.concatenate([np.linalg.eigh(moment)[1].T for moment in moments])
    errors = np.array([_largest_error_about(surface, axis) for axis in axes])
    best = axes[errors.argmin()]
    if errors.min() > 1.0:
        return np.zeros((0, 3))
    across = (np.abs(axes @ best) < 0.5) & (errors <= 1.0)
    return np.concatenate([best[None], axes[across][:1]])


def _largest_error_about(surface: RotatedSurface, axis: FloatArray) -> float:
    """Return the largest error of rotations about an axis; few points are enough to see it."""
    turns = axis_angle(np.tile(axis, (len(_ANGLES), 1)), _ANGLES)
    error = surface.errors(turns, count=100).max()
    return float(error if error > 2.0 else surface.errors(turns).max())


def _half_turn_across(surface: RotatedSurface, axis: FloatArray) -> FloatArray:
    """Return the identity, and a half turn that swaps the axis's ends if it matches."""
    across = np.linalg.svd(axis[None])[2][1]  # unit, at a right angle to the axis
    turns = np.array([np.eye(3), 2.0 * np.outer(across, across) - np.eye(3)])
    return turns[surface.errors(turns) <= 1.0]


def _finite_group(surface: RotatedSurface) -> FloatArray:
    """Return the symmetries (S, 3, 3) of a surface that is none of revolution, identity first.

    Rotations that match better than their neighbours on a coarse grid are aligned with the surface.
    Each, the best first, joins the group if all products match.
    """
    spread, neighbours = _spread()
    coarse = surface.coarse_errors(spread)
    least = np.flatnonzero((coarse <= coarse[neighbours].min(axis=1)) & (coarse <= _COARSE))
    least = least[np.argsort(coarse[least], kind="stable")][:_MOST_CANDIDATES]
    turns = surface.aligned(spread[least], steps=4, count=64)
    turns = _best_first(turns, surface.errors(turns, count=200), most=3.0)
    turns = distinct_turns(turns, _MOST_ALIGNED, same=_SAME)
    turns = surface.aligned(turns, steps=12, count=500)
    group = np.eye(3)[None]
    for turn in _best_first(turns, surface.errors(turns), most=1.0):
        if angles_between(turn[None], group).min() > _SAME:
            larger = generated(np.array([*group, turn]), same=_SAME)
            if larger is not None and surface.errors(larger).max() <= 1.0:
                group = larger
    improved = generated(surface.aligned(group, steps=12, count=500), same=_SAME)
    return group if improved is None else improved


def _best_first(turns: FloatArray, errors: FloatArray, *, most: float) -> FloatArray:
    """Return rotations (T, 3, 3) with errors (T,) of at most so much, the best first."""
    order = np.argsort(errors, kind="stable")
    return turns[order[errors[order] <= most]]


@cache
def _spread() -> tuple[FloatArray, IntArray]:
    """Return rotations (N, 3, 3) spread evenly, and the indices (N, K) of each and its neighbours.

    Alexa, 2022, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)".
    """
    from scipy.spatial import cKDTree

    at = np.arange(_SPREAD) + 0.5
    inner = np.sqrt(at / _SPREAD)
    outer = np.sqrt(1.0 - at / _SPREAD)
    first = 2.0 * np.pi * at / np.sqrt(2.0)
    second = 2.0 * np.pi * at / 1.533751168755204288
    pairs = [(inner, np.sin(first)), (inner, np.cos(first))]
    pairs += [(outer, np.sin(second)), (outer, np.cos(second))]
    quaternion = np.array([radius * share for radius, share in pairs]).T
    _, index = cKDTree(np.concatenate([quaternion, -quaternion])).query(quaternion, k=_NEIGHBOURS)
    return rotation_matrices(quaternion), index % _SPREAD
