"""Which rotations map a surface onto itself: about an axis of revolution, or finitely many."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from chsel.arrays import FloatArray, IntArray
from chsel.evaluation.rotated_surface import RotatedSurface
from chsel.evaluation.rotation_group import distinct, generated, is_among
from chsel.pose import axis_angle
from chsel.quaternions import rotations

_ANGLES = np.arange(1.0, 17.0) * np.pi * (3.0 - np.sqrt(5.0))  # golden: of no n-fold symmetry
_SPREAD = 12_000  # rotations, about 9 degrees apart
_NEIGHBOURS = 16
_COARSE = 0.05  # of the diameter: coarse errors of rotations within 9 degrees of a symmetry
_MOST_CANDIDATES, _MOST_ALIGNED = 400, 50


def axes_of_revolution(surface: RotatedSurface) -> FloatArray:
    """Unit axes (A, 3) about which every rotation matches: none, one, or two of a sphere's.

    Candidates are the axes of inertia and those of slippage. The normals of a surface of revolution
    meet its axis: rotations about u move points p within the surface where n . (u x p) = 0 (Gelfand
    and Guibas, 2004, "Shape segmentation using local slippage analysis"). Slippage finds the axis
    where moments of inertia are equal by chance, inertia where the normals of a scan are noise.
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
    """Of rotations about an axis; few points are enough to see a large one."""
    turns = axis_angle(np.tile(axis, (len(_ANGLES), 1)), _ANGLES)
    error = surface.errors(turns, count=100).max()
    return float(error if error > 2.0 else surface.errors(turns).max())


def half_turn_across(surface: RotatedSurface, axis: FloatArray) -> FloatArray:
    """The identity, and a half turn that swaps the ends of an axis if it matches (1 or 2, 3, 3)."""
    across = np.linalg.svd(axis[None])[2][1]  # unit, at a right angle to the axis
    turns = np.array([np.eye(3), 2.0 * np.outer(across, across) - np.eye(3)])
    return turns[surface.errors(turns) <= 1.0]


def finite_group(surface: RotatedSurface) -> FloatArray:
    """The symmetries (S, 3, 3) of a surface without an axis of revolution, the identity first.

    Of rotations spread over SO(3), those that match better than their neighbours on a coarse grid
    are aligned with the surface. Each, the best first, joins the group if all products match.
    """
    spread, neighbours = _spread()
    coarse = surface.coarse_errors(spread)
    least = np.flatnonzero((coarse <= coarse[neighbours].min(axis=1)) & (coarse <= _COARSE))
    least = least[np.argsort(coarse[least], kind="stable")][:_MOST_CANDIDATES]
    turns = surface.aligned(spread[least], steps=4, count=64)
    turns = distinct(_best_first(turns, surface.errors(turns, count=200), 3.0), _MOST_ALIGNED)
    turns = surface.aligned(turns, steps=12, count=500)
    group = np.eye(3)[None]
    for turn in _best_first(turns, surface.errors(turns), 1.0):
        larger = None if is_among(turn, group) else generated(np.array([*group, turn]))
        if larger is not None and surface.errors(larger).max() <= 1.0:
            group = larger
    improved = generated(surface.aligned(group, steps=12, count=500))
    return group if improved is None else improved


def _best_first(turns: FloatArray, errors: FloatArray, most: float) -> FloatArray:
    """Rotations (T, 3, 3) with errors (T,) of at most so much, in the order of the errors."""
    order = np.argsort(errors, kind="stable")
    return turns[order[errors[order] <= most]]


@cache
def _spread() -> tuple[FloatArray, IntArray]:
    """Rotations (N, 3, 3) spread evenly, and the indices (N, K) of each and its neighbours.

    Alexa, 2022, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)".
    """
    place = np.arange(_SPREAD) + 0.5
    inner, outer = np.sqrt(place / _SPREAD), np.sqrt(1.0 - place / _SPREAD)
    first, second = 2.0 * np.pi * place / np.sqrt(2.0), 2.0 * np.pi * place / 1.533751168755204288
    quaternion = np.array(
        [
            inner * np.sin(first),
            inner * np.cos(first),
            outer * np.sin(second),
            outer * np.cos(second),
        ]
    ).T
    _, index = cKDTree(np.concatenate([quaternion, -quaternion])).query(quaternion, k=_NEIGHBOURS)
    return rotations(quaternion), index % _SPREAD
