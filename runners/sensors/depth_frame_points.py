"""What one depth image tells: free space before what was measured, and points on the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion

from chsel.errors import SessionError, SettingError
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import KnownPoints, Lattice, Workspace
from chsel.problem.poses import apply
from chsel.sensing.depth_camera import occlusion_edges, valid_pixels
from chsel.sensing.free_space import FreeGrid
from runners.sensors.depth_frame import DepthFrame
from runners.sensors.rig import CameraRig, Rig

LABEL_MARGIN = 2  # pixels: by so much a label's outline may be off the depth image's
EDGE_REACH = 3  # pixels: many cameras leave a gap of invalid pixels at an edge of depth


@dataclass(frozen=True, eq=False)
class FramePoints:
    """points: free voxels' centres, and surface points. workspace: where the object can be.

    rays (H, W): the pixels whose rays are free. surface (H, W): those on the object. invalid,
    edges: how many pixels told nothing, and how many lie at an edge of depth.
    """

    points: KnownPoints
    workspace: Workspace
    rays: BoolArray
    surface: BoolArray
    invalid: int
    edges: int


def depth_frame_points(
    frame: DepthFrame, rig: Rig, *, free_resolution: float, diameter: float | None = None
) -> FramePoints:
    """The known points of a frame, by the thresholds of the rig's only camera.

    free_resolution: metres. diameter: of the object, metres; without a workspace in the rig, it is
    the bounds of the surface points, padded by this. Raises SettingError for a rig that does not
    fit, SessionError for a frame that tells nothing.
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
    edges = _edges(frame, camera, valid, 1)
    surface = _surface_pixels(frame, camera, valid)
    measured = frame.camera.back_project(frame.depth)
    on_object = apply(frame.world_from_camera, measured[surface])
    workspace = _workspace(rig, on_object, diameter)
    free = _free_voxels(frame, camera, workspace, free_resolution, valid & ~edges)
    return FramePoints(
        points=KnownPoints(
            free=_outside_of(on_object, free, Lattice(workspace.lower, free_resolution)),
            known=one_per_voxel(on_object, rig.surface_resolution),
        ),
        workspace=workspace,
        rays=valid & ~edges,
        surface=surface,
        invalid=int((~valid).sum()),
        edges=int(edges.sum()),
    )


def one_per_voxel(points: FloatArray, side: float) -> FloatArray:
    """Of points (N, 3), those nearest to the centre of their voxel (M, 3), in the given order."""
    lattice = Lattice((0.0, 0.0, 0.0), side)
    voxels = lattice.voxels(points)
    distance = ((points - lattice.centres(voxels)) ** 2).sum(axis=1)
    nearest_first = np.argsort(distance, kind="stable")
    _, first = np.unique(voxels[nearest_first], axis=0, return_index=True)
    return points[np.sort(nearest_first[first])]


def _edges(frame: DepthFrame, camera: CameraRig, valid: BoolArray, reach: int) -> BoolArray:
    if camera.edge is None:
        return np.zeros_like(valid)
    return occlusion_edges(frame.depth, valid, camera.edge, reach=reach)


def _surface_pixels(frame: DepthFrame, camera: CameraRig, valid: BoolArray) -> BoolArray:
    """The object's pixels, but for those at its outline, where others are mixed in."""
    if frame.label is None:
        return np.zeros_like(valid)
    square = np.ones((3, 3), dtype=bool)
    within = binary_erosion(frame.label, square, iterations=LABEL_MARGIN, border_value=1)
    surface = within & valid & ~_edges(frame, camera, valid, EDGE_REACH)
    if not surface.any():
        raise SessionError(
            f"none of the {int(frame.label.sum())} pixels of label tells of the surface: outlines "
            "and edges of depth are left out, and pixels out of range"
        )
    return surface


def _workspace(rig: Rig, on_object: FloatArray, diameter: float | None) -> Workspace:
    if rig.workspace is not None:
        return rig.box()
    if len(on_object) == 0 or diameter is None:
        raise SettingError(
            "workspace is missing, and no label says where the object is; accepted: "
            "[[x0, x1], [y0, y1], [z0, z1]]"
        )
    return Workspace.around(on_object, diameter)


def _free_voxels(
    frame: DepthFrame,
    camera: CameraRig,
    workspace: Workspace,
    free_resolution: float,
    pixels: BoolArray,
) -> FloatArray:
    """Centres (N, 3) of the voxels that rays of pixels passed."""
    grid = FreeGrid(workspace, free_resolution)  # there is one view, whatever the rig asks
    view = (frame.depth, frame.camera, frame.world_from_camera, pixels)
    if camera.rays == "scaled_images":
        grid.scaled_images(*view)
    else:
        grid.from_depth(*view, fraction=camera.fraction)
    return grid.new()


def _outside_of(on_object: FloatArray, free: FloatArray, lattice: Lattice) -> FloatArray:
    """Free centres (N, 3) but for voxels in which the surface was measured."""
    taken = {tuple(voxel) for voxel in lattice.voxels(on_object).tolist()}
    kept = [tuple(voxel) not in taken for voxel in lattice.voxels(free).tolist()]
    return free[np.array(kept, dtype=bool)]
