"""What a robot perceived, as its program says it: checked, and brought into one form."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from chsel.errors import InputWarning, MeshError, PointsError, PoseError, require_instance
from chsel.numerics.arrays import BoolArray, FloatArray, frozen
from chsel.problem.points import (
    FARTHEST_PLACE,
    KnownPoints,
    Workspace,
    check_places,
    world_known_points,
    world_points,
)
from chsel.problem.poses import apply, inverse, nearest_rigid
from chsel.sensing.depth_camera import DepthLook, PinholeCamera, depth_look
from chsel.sensing.free_space import interior_lattice, poses_between

if TYPE_CHECKING:
    import trimesh

_ACROSS = 15.0  # to a diameter: points on the object that a depth image gives
_MOST_WHOLE = 20  # m: of depths in whole numbers
_FINEST_DEPTHS = 6.5535  # m: up to which 16 bits hold tenths of a millimetre


class Perception(NamedTuple):
    """What became known at once, in the world, metres."""

    contacts: FloatArray  # (C, 3)
    free: FloatArray  # (N, 3)
    others: KnownPoints  # occupied points, and known ones that are not contacts
    path: FloatArray  # (P, 4, 4): world_from_hand
    hand: FloatArray  # (M, 3): points inside the hand, in its frame
    swept: FloatArray  # (Q, 4, 4): poses world_from_hand on the path, close together
    look: DepthLook | None
    spacing: float  # of points that the look gives, metres

    @property
    def touching(self) -> KnownPoints:
        """All points but the free ones and those of the look."""
        return KnownPoints(known=self.contacts).merged(self.others)

    def check(self, diameter: float, workspace: Workspace | None) -> list[InputWarning]:
        """Warnings about places in another unit, and about a camera with a swapped centre."""
        camera = np.zeros((0, 3)) if self.look is None else self.look.pose[None, :3, 3]
        places = {
            "the hand's path": self.path[:, :3, 3],
            "world_from_camera": camera,
            "the nearest known point": np.concatenate([self.free, self.touching.all_points()]),
        }
        found: list[InputWarning] = []
        for name, points in places.items():
            found += check_places(name, points, diameter, workspace)
        return found if self.look is None else found + self.look.camera.check_centre()


def perceived(
    *,
    contacts: Any = None,
    free: Any = None,
    occupied: Any = None,
    known: Any = None,
    known_sdf: Any = None,
    hand: Any = None,
    path: Any = None,
    contact: Any = None,
    depth: Any = None,
    camera: Any = None,
    world_from_camera: Any = None,
    mask: Any = None,
    diameter: float,
    spacing: float,
) -> Perception:
    """The arguments of `Session.add`, checked. diameter: of the object; spacing: of free voxels.

    Raises ChselError for malformed input, see there.
    """
    if all(each is None for each in (contacts, free, occupied, known, path, contact, depth)):
        raise PointsError("nothing was added; accepted: points, a path or a depth image")
    if (hand is None) is not (path is None):
        raise PointsError("hand and path belong together; accepted: both or none")
    image = [each is not None for each in (depth, camera, world_from_camera)]
    if any(image) is not all(image) or (mask is not None and depth is None):
        raise PointsError(
            "depth, camera and world_from_camera belong together, with or without mask; "
            "accepted: all of them or none"
        )
    contacts = world_points("contacts", contacts)
    if contact is not None:
        contact = frozen("contact", contact, (3,), most=FARTHEST_PLACE)
        contacts = np.concatenate([contacts, contact[None]])
    others = world_known_points(occupied=occupied, known=known, known_sdf=known_sdf)
    nodes = np.zeros((0, 3))
    poses = swept = np.zeros((0, 4, 4))
    if path is not None:
        poses = frozen("path", path, (None, 4, 4), error=PoseError, most=FARTHEST_PLACE)
        poses = nearest_rigid("path", poses)
        bodies = hand_bodies(hand)
        nodes = interior_lattice(bodies, 0.5 * spacing)
        if len(nodes) == 0:
            raise MeshError("hand has no inside; accepted: a closed mesh, metres")
        corners = np.concatenate([body.vertices for body in bodies])
        radius = float(np.sqrt((corners**2).sum(axis=1)).max())
        swept = poses_between(poses, step=0.5 * spacing, radius=radius)
    look = None
    side = diameter / _ACROSS
    if depth is not None:
        depth = _depths(depth)
        if not isinstance(camera, PinholeCamera):
            height, width = depth.shape
            camera = PinholeCamera.of_matrix(camera, width, height)
        mask = None if mask is None else _mask(mask)
        look = depth_look(depth, camera, world_from_camera, mask, before=spacing, side=side)
    return Perception(
        contacts=contacts,
        free=world_points("free", free),
        others=others,
        path=poses,
        hand=nodes,
        swept=swept,
        look=look,
        spacing=side,
    )


def hand_bodies(hand: Any) -> list[trimesh.Trimesh]:
    """The bodies of a hand, turned outward. Raises MeshError for a mesh without faces."""
    import trimesh

    require_instance("hand", hand, trimesh.Trimesh, "a mesh such as chsel.load_mesh(path)")
    if len(hand.faces) == 0:
        raise MeshError("hand has no faces; accepted: a closed mesh, metres")
    vertices = frozen("hand vertices", hand.vertices, (None, 3), error=MeshError)
    merged = trimesh.Trimesh(vertices, hand.faces)  # vertices at one place are one
    bodies = list(merged.split(only_watertight=False)) or [merged]
    for body in bodies:
        if body.is_watertight and body.is_winding_consistent and body.volume < 0.0:
            body.invert()
    return bodies


def farthest_depth(look: DepthLook, workspace: Workspace) -> float:
    """Up to which depth (m) an image matters: beyond, its rays have left the workspace."""
    lower, upper = workspace.bounds
    corners = np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 0, lower, upper)
    deepest = float(apply(inverse(look.pose), corners)[:, 2].max())
    return max(deepest, _FINEST_DEPTHS)


def _depths(given: Any) -> FloatArray:
    """A depth image (H, W), metres; NaN where it is masked."""
    if np.ma.isMaskedArray(given):
        given = np.ma.asarray(given, np.float64).filled(np.nan)
    depth = frozen("depth", given, (None, None), finite=False)
    whole = np.asarray(given).dtype.kind in "iu"
    if whole and (depth > _MOST_WHOLE).any() and (depth[depth > 0.0] <= _MOST_WHOLE).any():
        raise PointsError(
            f"depth has whole numbers up to {depth.max():g}: millimetres? accepted: metres"
        )
    return depth


def _mask(given: Any) -> BoolArray:
    """Flags (H, W) of pixels; from numbers, of which one says that a pixel is the object's."""
    mask = frozen("mask", given, (None, None))
    values = np.unique(mask[mask != 0.0])
    if len(values) > 1:
        raise PointsError(
            f"mask has {len(values)} values other than 0; accepted: true for the object's pixels"
        )
    return np.asarray(mask != 0.0)
