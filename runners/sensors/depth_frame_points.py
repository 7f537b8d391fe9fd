"""Known points of one depth image: free space before what was measured, the object's surface."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from chsel.errors import SessionError, SettingError
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import KnownPoints, Lattice, Workspace
from chsel.problem.poses import apply
from chsel.sensing.depth_camera import depth_regions, main_regions, valid_pixels
from chsel.sensing.free_space import FreeGrid
from runners.sensors.depth_camera import edge_pixels, mark_rays, ray_ends
from runners.sensors.depth_frame import DepthFrame
from runners.sensors.rig import Rig
from runners.sensors.session_report import Counts

LABEL_MARGIN = 2  # pixels: by so much a label's outline may be off the depth image's


@dataclass(frozen=True, eq=False)
class FramePoints:
    """What follows from a frame, and how many of its pixels do not count."""

    points: KnownPoints  # free voxels' centres, and surface points; metres, world
    workspace: Workspace  # where the object can be
    rays: BoolArray  # (H, W), pixels whose rays are free
    surface: BoolArray  # (H, W), pixels on the object
    counts: Counts  # of the whole image
    labelled: Counts | None  # of the pixels of the object's label, if there is one


def depth_frame_points(
    frame: DepthFrame, rig: Rig, *, free_resolution: float, diameter: float | None = None
) -> FramePoints:
    """The known points of a frame, by the thresholds of the rig's only camera.

    free_resolution: metres. diameter: of the object, metres; without a workspace in the rig, it is
    the bounds of the surface points, padded by this. Raises SettingError for a rig that does not
    fit, SessionError for a frame without a usable pixel.
    """
    if len(rig.cameras) != 1:
        raise SettingError(f"rig {rig.name} has {len(rig.cameras)} cameras; accepted: 1, a frame's")
    (camera,) = rig.cameras
    nearest, furthest = camera.range
    valid = valid_pixels(frame.depth, nearest=nearest, furthest=furthest)
    if not valid.any():
        typical = float(np.median(frame.depth[np.isfinite(frame.depth) & (frame.depth > 0.0)]))
        raise SessionError(
            f"no pixel of depth lies in the range of camera {camera.name}, {nearest:g} m to "
            f"{furthest:g} m; its median is {typical:.4g} m: check depth_scale"
        )
    edges = edge_pixels(camera, frame.depth, valid)
    measured = frame.camera.back_project(frame.depth)
    counts = Counts(images=1, used=1, pixels=valid.size, invalid=int((~valid).sum()))
    counts.edges = int(edges.sum())
    rays = valid & ~edges
    surface, labelled = np.zeros_like(valid), None
    if frame.label is not None:
        surface, labelled = _surface_pixels(frame.label, valid, edges)
        surface = _connected(frame, rig, surface, measured, diameter, labelled)
        rays &= surface | ~frame.label
        counts.outline, counts.far = labelled.outline, labelled.far
    ends, small = ray_ends(frame.depth, valid, rays, frame.camera, rig.gate)
    counts.small = small + (0 if labelled is None else labelled.small)
    on_object = apply(frame.world_from_camera, measured[surface])
    workspace = _workspace(rig, on_object, diameter)
    grid = FreeGrid(workspace, free_resolution)  # there is one view, whatever the rig asks
    mark_rays(grid, camera, ends, frame.camera, frame.world_from_camera, rays)
    points = KnownPoints(
        free=_outside_of(on_object, grid.new(), free_resolution),
        known=one_per_voxel(on_object, rig.surface_resolution),
    )
    counts.contacts, counts.free = len(points.known), len(points.free)
    return FramePoints(points, workspace, rays, surface, counts, labelled)


def one_per_voxel(points: FloatArray, side: float) -> FloatArray:
    """Of points (N, 3), those nearest to the centre of their voxel (M, 3), in the given order."""
    lattice = Lattice((0.0, 0.0, 0.0), side)
    voxels = lattice.voxels(points)
    distance = ((points - lattice.centres(voxels)) ** 2).sum(axis=1)
    nearest_first = np.argsort(distance, kind="stable")
    _, first = np.unique(voxels[nearest_first], axis=0, return_index=True)
    return points[np.sort(nearest_first[first])]


def _surface_pixels(
    label: BoolArray, valid: BoolArray, edges: BoolArray
) -> tuple[BoolArray, Counts]:
    """The object's pixels (H, W) but for those at its outline, where others are mixed in."""
    square = np.ones((3, 3), dtype=bool)
    within = binary_erosion(label, square, iterations=LABEL_MARGIN, border_value=1)
    surface = within & valid & ~edges
    if not surface.any():
        raise SessionError(
            f"none of the {int(label.sum())} pixels of label is of the surface: outlines "
            "and edges of depth are left out, and pixels out of range"
        )
    counted = Counts(images=1, used=1, pixels=int(label.sum()))
    counted.invalid = int((label & ~valid).sum())
    counted.edges = int((label & edges).sum())
    counted.outline = int((label & valid & ~edges & ~within).sum())
    return surface, counted


def _connected(
    frame: DepthFrame,
    rig: Rig,
    surface: BoolArray,
    measured: FloatArray,
    diameter: float | None,
    labelled: Counts,
) -> BoolArray:
    """Surface pixels (H, W) in regions that can be the object's, the others counted by reason."""
    regions = depth_regions(frame.depth, surface, frame.camera, rig.gate.jump)
    found = main_regions(
        regions[surface], part=rig.gate.part, points=measured[surface], diameter=diameter
    )
    labelled.small, labelled.far = found.small, found.far
    connected = surface.copy()
    connected[surface] = found.kept
    return connected


def _workspace(rig: Rig, on_object: FloatArray, diameter: float | None) -> Workspace:
    if rig.workspace is not None:
        return rig.box()
    if len(on_object) == 0 or diameter is None:
        raise SettingError(
            "workspace is missing, and no label says where the object is; accepted: "
            "[[x0, x1], [y0, y1], [z0, z1]]"
        )
    return Workspace.around(on_object, diameter)


def _outside_of(on_object: FloatArray, free: FloatArray, spacing: float) -> FloatArray:
    """Free centres (N, 3) but for those that a measured surface point can lie behind.

    A ray that passes a voxel passes its centre at up to half the voxel's diagonal, so that nearer
    to the surface than this a centre may be inside the object.
    """
    if len(on_object) == 0 or len(free) == 0:
        return free
    margin = sqrt(0.75) * spacing
    nearest = cKDTree(on_object).query(free, distance_upper_bound=margin)[0]
    return free[~(nearest <= margin)]
