"""From what a robot's program says that was perceived to probes: checked, in one form."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from chsel.errors import (
    InputWarning,
    MeshError,
    PointsError,
    PoseError,
    quoted,
    require_instance,
)
from chsel.events import Probe, SensorImage, SessionStarted
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, evenly_spaced, frozen
from chsel.problem.points import (
    FARTHEST_PLACE,
    KnownPoints,
    Workspace,
    away_from,
    check_places,
    distinct_points,
    require_possible,
    same_place,
    unit_normals,
    workspace_around,
    world_known_points,
    world_points,
)
from chsel.problem.poses import apply, inverse, nearest_rigid
from chsel.sensing.depth_camera import DepthLook, PinholeCamera, depth_look, may_be_inside
from chsel.sensing.free_space import FreeGrid, interior_lattice, poses_between

if TYPE_CHECKING:
    import trimesh

_ACROSS = 15.0  # to a diameter: points on the object that a depth image gives
_MOST_WHOLE = 20  # m: of depths in whole numbers
_MOST_SHOWN = 200  # poses of a path, in recordings
_UNIT = 1e-4  # m: of recorded depths, up to 6.5 m; of others a multiple of it
_ROUNDING = 1e-9  # of a number of units
_HAND = "a mesh such as chsel.load_mesh(path)"
_FINEST_DEPTHS = 6.5535  # m: up to which 16 bits hold tenths of a millimetre


class Perception(NamedTuple):
    """Points, a moving hand and a depth image that became known at once; world, metres."""

    touched: KnownPoints  # contacts, with their normals
    free: FloatArray  # (N, 3)
    others: KnownPoints  # occupied points, and known ones that are not contacts
    path: FloatArray  # (P, 4, 4): world_from_hand
    hand: FloatArray  # (M, 3): points inside the hand, in its frame
    swept: FloatArray  # (Q, 4, 4): poses world_from_hand on the path, close together
    look: DepthLook | None
    seen: KnownPoints  # points on the object that the look gives, with their normals
    spacing: float  # of these points, metres
    withdrawn: IntArray  # (W,), ascending: which known points are not of the object after all

    @property
    def touching(self) -> KnownPoints:
        """All points but the free ones and those of the look."""
        return self.touched.merged(self.others)

    def check(self, diameter: float, workspace: Workspace | None) -> list[InputWarning]:
        """Return warnings about places in another unit, and a camera with a swapped centre."""
        camera = np.zeros((0, 3)) if self.look is None else self.look.pose[None, :3, 3]
        places = {
            "the hand's path": self.path[:, :3, 3],
            "world_from_camera": camera,
            "the nearest known point": np.concatenate([self.free, self.touching.all_points()]),
        }
        found: list[InputWarning] = []
        for name, points in places.items():
            found += check_places(name, points, diameter=diameter, workspace=workspace)
        return found if self.look is None else found + self.look.camera.check_centre()


class Prepared(NamedTuple):
    """Input that was checked, and what a session becomes by it."""

    started: SessionStarted  # with the workspace
    grid: FreeGrid
    perception: Perception
    probe: Probe  # but for the points that become free
    image: SensorImage | None
    since: KnownPoints  # on the object, since it was pushed last, without what is withdrawn
    touching: KnownPoints  # without places that were measured before
    seen: FloatArray  # (M, 3): points on the object in the image, without such places
    warnings: list[InputWarning]


class Intake:
    """Turns what a program adds, step by step, into events of a session."""

    diameter: float
    """Of the object, metres, which the density of points on it depends on."""

    def __init__(self, started: SessionStarted, grid: FreeGrid | None, *, moves: float) -> None:
        """Take nothing yet.

        grid: over the workspace; None where that follows from the first points, and `started` has
        any. moves: metres that a touch moves the object at most.
        """
        self.diameter = started.sdf.diameter
        self._started = started
        self._moves = moves
        self._grid = grid  # free space of what was taken
        self._since = KnownPoints()  # on the object, since it was pushed last
        self._seen = np.zeros((0, 3))  # the same of depth images

    def prepare(self, points: KnownPoints, *, step: int, **what: Any) -> Prepared:
        """Check input, with nothing taken yet; arguments as `perceived` takes them.

        points: all that are known before. step: of the probe. Raise ChselError for malformed input,
        and for points that cannot be the object's.
        """
        started = self._started
        spacing = started.free_resolution
        perception = perceived(**what, diameter=self.diameter, spacing=spacing)
        look = perception.look
        since = self._since
        withdrawn = None
        if len(perception.withdrawn):
            withdrawn = perception.withdrawn
            if self._moves:
                raise PointsError(
                    "withdraw is given, and touches may move the object; accepted: moves=0"
                )
            if withdrawn[-1] >= len(points.known):
                raise PointsError(
                    f"withdraw has {withdrawn[-1]}; accepted: numbers of session.points.known, "
                    f"below {len(points.known)}"
                )
            since = since.with_known(~_are_among(since.known, points.known[withdrawn]))
            points = Probe(step, "points", KnownPoints(), withdrawn=withdrawn).added_to(points)
        touching, found = distinct_points(
            perception.touching, since, apart=same_place(self.diameter)
        )
        places = perception.seen.known
        seen = perception.seen.with_known(away_from(places, self._seen, apart=perception.spacing))
        on_object = touching.merged(seen)
        grid = self._grid
        given_workspace = None
        if grid is not None:
            given_workspace = started.workspace
            merged = points.merged(on_object)
            require_possible(merged, started.sdf.diameter, workspace=given_workspace)
        else:
            require_possible(on_object, started.sdf.diameter)
            workspace = workspace_around(_first_places(perception, on_object), started.sdf)
            grid = FreeGrid(workspace, spacing)
            started = replace(started, workspace=workspace)
        outcome = "free"
        if len(perception.touched.known):
            outcome = "contact"
        elif perception.others.count or withdrawn is not None:
            outcome = "points"
        probe = Probe(
            step=step,
            outcome="points" if look is not None else outcome,
            new_points=on_object,
            gripper_path=perception.path[evenly_spaced(len(perception.path), _MOST_SHOWN)],
            contacts=perception.touched.known,
            contact_normals=perception.touched.normals,
            image_points=len(seen.known),
            withdrawn=withdrawn,
        )
        image = None
        if look is not None:
            farthest = farthest_depth(look, started.workspace)
            look = look._replace(ends=np.minimum(look.ends, farthest))
            image = _image(step, look, farthest=farthest)
        return Prepared(
            started=started,
            grid=grid,
            perception=perception._replace(look=look),
            probe=probe,
            image=image,
            since=since,
            touching=touching,
            seen=seen.known,
            warnings=[*found, *perception.check(started.sdf.diameter, given_workspace)],
        )

    def take(self, prepared: Prepared) -> list[SensorImage | Probe]:
        """Let what was prepared become known; return the events that say so."""
        self._started = prepared.started
        grid = prepared.grid
        self._grid = grid
        perception = prepared.perception
        look = perception.look
        grid.at(perception.free)
        grid.at(perception.hand, poses=perception.swept)
        surface = np.zeros((0, 3))
        if look is not None:
            surface = look.surface
            grid.from_depth(
                look.ends, look.camera, world_from_camera=look.pose, mask=look.rays, fraction=1.0
            )
        free = grid.new()
        doubtful = may_be_inside(surface, free, spacing=self._started.free_resolution)
        grid.forget(free[doubtful])  # so that a hand that comes there later makes them free
        known = KnownPoints(free=free[~doubtful]).merged(prepared.probe.new_points)
        probe = replace(prepared.probe, new_points=known)
        self._seen = np.concatenate([self._seen, prepared.seen])
        self._since = prepared.since.merged(prepared.touching)
        if self._moves and probe.push is not None:  # what was known has moved with the object
            self._forget()
        return [probe] if prepared.image is None else [prepared.image, probe]

    def retake(self, started: SessionStarted, probe: Probe, *, before: KnownPoints) -> None:
        """Take a probe that a session before this one has recorded.

        started: its start, with the workspace. before: all points known before the probe.
        """
        self._started = started
        if self._grid is None:
            self._grid = FreeGrid(started.workspace, started.free_resolution)
            self._grid.at(started.initial_points.free)
        self._grid.at(probe.new_points.free)
        self._grid.new()
        if probe.withdrawn is not None:
            gone = before.known[probe.withdrawn]
            self._since = self._since.with_known(~_are_among(self._since.known, gone))
        known = np.arange(len(probe.new_points.known))
        touched = known < len(known) - probe.image_points
        on_object = replace(probe.new_points, free=np.zeros((0, 3)))
        self._since = self._since.merged(on_object.with_known(touched))
        self._seen = np.concatenate([self._seen, on_object.known[~touched]])
        if self._moves and probe.push is not None:
            self._forget()

    def _forget(self) -> None:
        """Forget free space and places on an object that has moved."""
        self._grid = FreeGrid(self._started.workspace, self._started.free_resolution)
        self._seen = np.zeros((0, 3))
        self._since = KnownPoints()


def _numbers(withdraw: Any) -> IntArray:
    """Return the numbers of points (W,) to withdraw, ascending; none for None."""
    if withdraw is None:
        return np.zeros(0, dtype=np.int64)
    given = frozen("withdraw", withdraw, shape=(None,))
    numbers = np.unique(given).astype(np.int64)
    if len(numbers) < len(given) or not np.isin(given, numbers).all() or (numbers < 0).any():
        raise PointsError(
            f"withdraw is {quoted(np.asarray(withdraw).tolist())}; accepted: numbers of points, "
            "each once"
        )
    return numbers


def _are_among(points: FloatArray, some: FloatArray) -> BoolArray:
    """Return which of points (N, 3) are one of others (W, 3)."""
    return np.asarray((points[:, None] == some).all(axis=2).any(axis=1))


def known_points(
    *,
    contacts: Any = None,
    normals: Any = None,
    normal_noise: Any = None,
    free: Any = None,
    occupied: Any = None,
    known: Any = None,
    known_sdf: Any = None,
) -> KnownPoints:
    """Return points of all classes together, contacts first of the known; None means no points.

    Arguments as of `chsel.register`. Raise PointsError for malformed ones.
    """
    touched = touched_points(contacts=contacts, normals=normals, normal_noise=normal_noise)
    others = world_known_points(free=free, occupied=occupied, known=known, known_sdf=known_sdf)
    return touched.merged(others)


def touched_points(
    *,
    contacts: Any = None,
    normals: Any = None,
    normal_noise: Any = None,
    contact: Any = None,
    normal: Any = None,
) -> KnownPoints:
    """Return contacts with their normals, and after them the single one.

    Arguments as of `Session.add`. Raise PointsError for malformed ones.
    """
    if normals is not None and contacts is None:
        raise PointsError("normals have no contacts; accepted: both, or contacts alone")
    if normal is not None and contact is None:
        raise PointsError("normal has no contact; accepted: both, or contact alone")
    if normal_noise is not None and normals is None and normal is None:
        raise PointsError("normal_noise has no normals; accepted: both, or none")
    if normal is not None and normal_noise is not None and np.ndim(normal_noise) > 0:
        raise PointsError("normal_noise is an array beside normal; accepted: one number for all")
    places = world_points("contacts", contacts)
    noise = None if normals is None else normal_noise
    touched = _with_normals(places, name="normals", normals=normals, noise=noise)
    if contact is None:
        return touched
    place = frozen("contact", contact, shape=(3,), most=FARTHEST_PLACE)[None]
    if normal is not None:
        normal = frozen("normal", normal, shape=(3,))[None]
    noise = None if normal is None else normal_noise
    return touched.merged(_with_normals(place, name="normal", normals=normal, noise=noise))


def _with_normals(places: FloatArray, *, name: str, normals: Any, noise: Any) -> KnownPoints:
    """Return contacts (M, 3) with the normals of an argument; None: without."""
    normals, normal_noise = unit_normals(name, normals, noise=noise, count=len(places))
    return KnownPoints(known=places, normals=normals, normal_noise=normal_noise)


def refuse_surface(surface: Any) -> None:
    """Raise PointsError for points by a name that is no longer accepted."""
    if surface is not None:
        raise PointsError("surface was renamed; accepted: contacts=")


def perceived(
    *,
    contacts: Any = None,
    normals: Any = None,
    normal_noise: Any = None,
    free: Any = None,
    occupied: Any = None,
    known: Any = None,
    known_sdf: Any = None,
    hand: Any = None,
    path: Any = None,
    contact: Any = None,
    normal: Any = None,
    depth: Any = None,
    camera: Any = None,
    world_from_camera: Any = None,
    mask: Any = None,
    image_normal_noise: Any = None,
    withdraw: Any = None,
    surface: Any = None,
    diameter: float,
    spacing: float,
) -> Perception:
    """Return the arguments of `Session.add`, checked.

    diameter: of the object, metres. spacing: side of free voxels, metres.
    Raise ChselError for malformed input, see there.
    """
    refuse_surface(surface)
    touched = touched_points(
        contacts=contacts,
        normals=normals,
        normal_noise=normal_noise,
        contact=contact,
        normal=normal,
    )
    given = (contacts, free, occupied, known, path, contact, depth, withdraw)
    if all(each is None for each in given):
        raise PointsError("nothing was added; accepted: points, a path or a depth image")
    if (hand is None) is not (path is None):
        raise PointsError("hand and path belong together; accepted: both or none")
    image = [each is not None for each in (depth, camera, world_from_camera)]
    if any(image) is not all(image) or (mask is not None and depth is None):
        raise PointsError(
            "depth, camera and world_from_camera belong together, with or without mask; "
            "accepted: all of them or none"
        )
    if image_normal_noise is not None and mask is None:
        raise PointsError("image_normal_noise has no mask; accepted: with depth and mask, or none")
    free_points = world_points("free", free)
    others = world_known_points(occupied=occupied, known=known, known_sdf=known_sdf)
    nodes = np.zeros((0, 3))
    poses = swept = np.zeros((0, 4, 4))
    if path is not None:
        import trimesh

        poses = frozen("path", path, shape=(None, 4, 4), error=PoseError, most=FARTHEST_PLACE)
        poses = nearest_rigid("path", poses)
        require_instance("hand", hand, kind=trimesh.Trimesh, accepted=_HAND)
        nodes, swept = swept_by(hand, poses, spacing=spacing)
    look = None
    seen = KnownPoints()
    side = diameter / _ACROSS
    if depth is not None:
        depth = _depths(depth)
        if not isinstance(camera, PinholeCamera):
            height, width = depth.shape
            camera = PinholeCamera.of_matrix(camera, width, height=height)
        mask = None if mask is None else _mask(mask)
        look = depth_look(
            depth,
            camera,
            world_from_camera=world_from_camera,
            mask=mask,
            before=spacing,
            side=side,
            with_normals=image_normal_noise is not None,
        )
        seen = _seen_points(look, image_normal_noise)
    return Perception(
        touched=touched,
        free=free_points,
        others=others,
        path=poses,
        hand=nodes,
        swept=swept,
        look=look,
        seen=seen,
        withdrawn=_numbers(withdraw),
        spacing=side,
    )


def _seen_points(look: DepthLook, normal_noise: Any) -> KnownPoints:
    """Return the points of a look; normal_noise: of its normals, radians, None for no normals."""
    if normal_noise is None:
        return KnownPoints(known=look.surface)
    (noise,) = frozen("image_normal_noise", [normal_noise], shape=(1,))
    if not 0.0 < noise <= math.pi:
        text = "in degrees? " if noise > math.pi else ""
        raise PointsError(
            f"image_normal_noise is {noise:.4g}; {text}accepted: above 0, up to pi, radians"
        )
    known = look.normals.any(axis=1)
    return KnownPoints(
        known=look.surface, normals=look.normals, normal_noise=np.where(known, noise, 0.0)
    )


def swept_by(
    hand: trimesh.Trimesh, path: FloatArray, *, spacing: float
) -> tuple[FloatArray, FloatArray]:
    """Return points (M, 3) inside a hand, and so many poses (P, 4, 4) that these sweep its way.

    path (K, 4, 4): the poses world_from_hand that it went through. spacing: side of free voxels,
    metres. Raise MeshError for a hand without an inside.
    """
    vertices, faces = np.array(hand.vertices, np.float64), np.array(hand.faces, np.int64)
    nodes, radius = _inside_of_hand(vertices.tobytes(), faces.tobytes(), spacing=spacing)
    return nodes, poses_between(path, step=0.5 * spacing, radius=radius)


@lru_cache(maxsize=4)  # as most paths are of one hand
def _inside_of_hand(vertices: bytes, faces: bytes, *, spacing: float) -> tuple[FloatArray, float]:
    """Return points (M, 3) inside a hand, and how far it reaches from its origin, metres.

    vertices, faces: of its mesh, rows of float64 and int64. spacing: side of free voxels, metres.
    Raise MeshError for a hand without an inside.
    """
    import trimesh

    corners = np.frombuffer(vertices).reshape(-1, 3)
    triangles = np.frombuffer(faces, np.int64).reshape(-1, 3)
    bodies = hand_bodies(trimesh.Trimesh(corners, triangles, process=False))
    nodes = interior_lattice(bodies, 0.5 * spacing)
    if len(nodes) == 0:
        raise MeshError("hand has no inside; accepted: a closed mesh, metres")
    corners = np.concatenate([body.vertices for body in bodies])
    nodes.setflags(write=False)
    return nodes, float(np.sqrt((corners**2).sum(axis=1)).max())


def hand_bodies(hand: Any) -> list[trimesh.Trimesh]:
    """Return the bodies of a hand, turned outward. Raise MeshError for a mesh without faces."""
    import trimesh

    require_instance("hand", hand, kind=trimesh.Trimesh, accepted=_HAND)
    if len(hand.faces) == 0:
        raise MeshError("hand has no faces; accepted: a closed mesh, metres")
    vertices = frozen("hand vertices", hand.vertices, shape=(None, 3), error=MeshError)
    merged = trimesh.Trimesh(vertices, hand.faces)  # vertices at one place are one
    bodies = list(merged.split(only_watertight=False)) or [merged]
    for body in bodies:
        if body.is_watertight and body.is_winding_consistent and body.volume < 0.0:
            body.invert()
    return bodies


def farthest_depth(look: DepthLook, workspace: Workspace) -> float:
    """Return the depth (m) beyond which the rays of an image have left the workspace."""
    lower, upper = workspace.bounds
    corners = np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 0, lower, upper)
    deepest = float(apply(inverse(look.pose), corners)[:, 2].max())
    return max(deepest, _FINEST_DEPTHS)


def _depths(given: Any) -> FloatArray:
    """Return a depth image (H, W), metres; NaN where it is masked."""
    if np.ma.isMaskedArray(given):
        given = np.ma.asarray(given, np.float64).filled(np.nan)
    depth = frozen("depth", given, shape=(None, None), finite=False)
    whole = np.asarray(given).dtype.kind in "iu"
    if whole and (depth > _MOST_WHOLE).any() and (depth[depth > 0.0] <= _MOST_WHOLE).any():
        raise PointsError(
            f"depth has whole numbers up to {depth.max():g}: millimetres? accepted: metres"
        )
    return depth


def _mask(given: Any) -> BoolArray:
    """Return flags (H, W) of pixels, from numbers of which one marks those of the object."""
    mask = frozen("mask", given, shape=(None, None))
    values = np.unique(mask[mask != 0.0])
    if len(values) > 1:
        raise PointsError(
            f"mask has {len(values)} values other than 0; accepted: true for the object's pixels"
        )
    return np.asarray(mask != 0.0)


def _first_places(perception: Perception, on_object: KnownPoints) -> KnownPoints:
    """Return what a workspace follows from: points on the object, else where it is not."""
    if on_object.count:
        return on_object
    passed = KnownPoints(free=np.concatenate([perception.free, perception.path[:, :3, 3]]))
    if passed.count == 0:
        raise PointsError(
            "nothing says where the object can be; accepted: chsel.Session(..., "
            "workspace=...), or first points, a path or a mask"
        )
    return passed


def _image(step: int, look: DepthLook, *, farthest: float) -> SensorImage:
    """Return a depth image as recordings have it: without depths beyond the farthest, metres."""
    depth = np.where(look.depth > farthest, 0.0, look.depth)
    unit = _UNIT * np.ceil(max(float(depth.max()) / (65535 * _UNIT) - _ROUNDING, 1.0))
    values = np.rint(depth / unit).astype(np.uint16)
    camera = look.camera
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    return SensorImage(
        step=step,
        sensor="camera",
        kind="depth",
        values=values,
        unit=unit,
        mask=look.rays,
        intrinsics=intrinsics,
        world_from_camera=look.pose,
    )
