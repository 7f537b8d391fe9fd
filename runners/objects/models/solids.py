"""Solids that the models are built of: lofts between superellipses, united, cut and placed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh

MILLIMETRE = 1e-3
AXES = "xyz"


class CrossSection(NamedTuple):
    """A superellipse |u/a|^power + |v/b|^power = 1 across a loft's axis; lengths in millimetres.

    `u` and `v` are its centre, `width` (2a) and `height` (2b) its full extents. A power of 2 is an
    ellipse, 4 a rectangle with round corners, 10 nearly a rectangle. (u, v) are (x, y) across the
    axis z, (y, z) across x, and (z, x) across y.
    """

    at: float
    u: float
    v: float
    width: float
    height: float
    power: float = 2.0


def _ring(section: CrossSection, segments: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(segments) / segments
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)  # (segments, 2)
    unit = np.sign(unit) * np.abs(unit) ** (2 / section.power)
    ring = np.empty((segments, 3))
    ring[:, :2] = [section.u, section.v] + unit * [section.width / 2, section.height / 2]
    ring[:, 2] = section.at
    return ring


def loft(
    sections: Sequence[CrossSection], *, axis: str = "z", segments: int = 32
) -> trimesh.Trimesh:
    """The closed solid through `sections`, which are in rising order of `at` along `axis`; mm."""
    rings = [_ring(section, segments) for section in sections]
    ends = [rings[0].mean(axis=0), rings[-1].mean(axis=0)]
    vertices = np.concatenate([*rings, ends])  # (N, 3) in the order (u, v, axis)
    here = np.arange(segments)
    there = (here + 1) % segments
    first = np.full(segments, len(vertices) - 2)
    last = np.full(segments, len(vertices) - 1)
    top = (len(rings) - 1) * segments
    faces = [
        np.stack([first, there, here], axis=1),
        np.stack([last, top + here, top + there], axis=1),
    ]
    for start in range(0, top, segments):
        a, b = start + here, start + there
        faces.append(np.stack([a, b, b + segments], axis=1))
        faces.append(np.stack([a, b + segments, a + segments], axis=1))
    vertices = np.roll(vertices, AXES.index(axis) + 1, axis=1)
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=False)


def united(solids: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """The union of overlapping solids."""
    return trimesh.boolean.union(list(solids), engine="manifold")


def cut(solid: trimesh.Trimesh, tool: trimesh.Trimesh) -> trimesh.Trimesh:
    """`solid` without what `tool` covers."""
    return trimesh.boolean.difference([solid, tool], engine="manifold")


def placed(solid: trimesh.Trimesh, *, yaw_degrees: float) -> trimesh.Trimesh:
    """`solid`, which is in millimetres, turned about the z axis and scaled to metres."""
    object_from_solid = trimesh.transformations.rotation_matrix(np.radians(yaw_degrees), [0, 0, 1])
    object_from_solid[:3] *= MILLIMETRE
    return solid.copy().apply_transform(object_from_solid)
