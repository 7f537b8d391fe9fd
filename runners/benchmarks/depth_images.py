"""What free space from a depth image takes: by exact traversal, and by scaled images."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import Lattice, Workspace
from chsel.problem.poses import axis_angle, compose
from chsel.sensing.depth_camera import PinholeCamera, occlusion_edges, valid_pixels
from chsel.sensing.free_space import SCALES, FreeGrid
from runners.benchmarks.registrations import Scope
from runners.benchmarks.timing import Row, cores, in_turn, milliseconds

WORKSPACE = Workspace((0.7, -0.2, 0.31), (1.1, 0.2, 0.6))  # the paper's cabinet
SPACING = 0.01
CAMERA = PinholeCamera(640, 480, 600.0, 600.0, 319.5, 239.5)
_DOWN = 0.54  # radians by which the camera looks down
_LOOKING_ALONG_X = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_TILTED = axis_angle(np.array([0.0, 1.0, 0.0]), _DOWN) @ _LOOKING_ALONG_X
POSE = compose(_TILTED, np.array([0.35, 0.0, 0.75]))
_BALL, _RADIUS = np.array([0.9, 0.0, 0.39]), 0.08
_FAR = 5.0


def depth_images(scope: Scope) -> Iterator[Row]:
    """One image in turn by each way; how many voxels each finds; what checking its pixels takes."""
    depth = scene()
    mask = valid_pixels(depth, nearest=0.2, furthest=_FAR)
    grids = {name: FreeGrid(WORKSPACE, SPACING) for name in ("traversal", "scaled")}
    traversal = partial(grids["traversal"].from_depth, depth, CAMERA, POSE, mask)
    scaled = partial(grids["scaled"].scaled_images, depth, CAMERA, POSE, mask)
    numpy_grid = np.zeros(grids["scaled"].shape, dtype=bool)
    cases = {
        "traversal, 1": partial(milliseconds, traversal, 1),
        f"traversal, all {cores()}": partial(milliseconds, traversal, cores()),
        "scaled images, 1": partial(milliseconds, scaled, 1),
        "scaled images, numpy": partial(milliseconds, partial(_scaled, depth, mask, numpy_grid), 1),
        "valid pixels and edges": partial(milliseconds, partial(_checked, depth), 1),
    }
    for name, samples in in_turn(scope.repeats, cases).items():
        yield Row("depth image, threads", name, "", "ms", samples)
    found = {name: grid.count for name, grid in grids.items()} | {"numpy": int(numpy_grid.sum())}
    for name, count in found.items():
        yield Row("depth image, free", name, "", "voxels", (float(count),))


def scene() -> FloatArray:
    """Depths (480, 640) of a ball on the workspace's floor in front of its far side."""
    ways = CAMERA.directions() @ POSE[:3, :3].T
    eye = POSE[:3, 3]
    with np.errstate(divide="ignore"):
        floor = (WORKSPACE.lower[2] - eye[2]) / ways[..., 2]
        wall = (WORKSPACE.upper[0] - eye[0]) / ways[..., 0]
    a, b = (ways**2).sum(axis=-1), ways @ (_BALL - eye)
    rest = b**2 - a * ((_BALL - eye) @ (_BALL - eye) - _RADIUS**2)
    ball = np.where(rest > 0.0, (b - np.sqrt(np.maximum(rest, 0.0))) / a, _FAR)
    return np.min([np.where(d > 0.0, d, _FAR) for d in (floor, wall, ball)], axis=0)


def _scaled(depth: FloatArray, mask: BoolArray, free: BoolArray) -> None:
    """Mark free (nx, ny, nz) as scaled images do, in plain numpy."""
    lattice = Lattice(WORKSPACE.lower, SPACING)
    for scale in SCALES:
        points = CAMERA.back_project(scale * depth)[mask] @ POSE[:3, :3].T + POSE[:3, 3]
        voxels = lattice.voxels(points)
        inside = ((voxels >= 0) & (voxels < free.shape)).all(axis=1)
        free[tuple(voxels[inside].T)] = True


def _checked(depth: FloatArray) -> BoolArray:
    valid = valid_pixels(depth, nearest=0.2, furthest=_FAR)
    return valid & ~occlusion_edges(depth, valid, 0.05)
