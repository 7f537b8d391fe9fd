"""Faults of sensors and models, put into the probes of simulated sessions, and their levels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from chsel.errors import SettingError
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import FreeVoxels, Workspace
from chsel.problem.poses import apply, axis_angle, inverse, rotated, rotation_vector
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.settings import Check, CheckedSettings, between
from chsel.problem.streams import Purpose, StreamKey, normals, uniforms

if TYPE_CHECKING:
    import trimesh

_NEAREST = 0.02  # m: foreign contacts are no nearer to the contact that they come with
_OFF = 0.01  # m: nor to the object
_TRIES = 64  # places that are looked at for a foreign contact
_NEIGHBOURS = np.array([step for step in np.ndindex(3, 3, 3) if step != (1, 1, 1)]) - 1  # (26, 3)
# Random streams of a step; those of the session are of step 0.
_OF_SESSION, _OF_NOISE, _OF_FOREIGN, _OF_FREE, _OF_TILT, _OF_NORMALS, _OF_WRONG = range(7)
_OF_NORMAL_FAULTS = ("normal_noise", "normal_wrong", "normal_tilt")


def number_between(low: float, high: float, *, unit: str = "") -> Check:
    """Return the check of a number from `low` to `high`."""

    def check(name: str, value: Any) -> None:
        if not low <= value <= high:
            raise SettingError(f"{name} is {value}; accepted: {low:g} to {high:g}{unit}")

    return check


@dataclass(frozen=True)
class FaultSettings(CheckedSettings):
    """Faults of what a source reports; by default none.

    Contacts get foreign ones beside them, are shifted by the camera's bias, get noise, and are
    rounded, in this order. Normals get noise, some are replaced, and all are tilted. The path of
    the hand and its true contacts do not depend on these.
    """

    # m: standard deviation of contacts along each axis, so along the normal, too.
    contact_noise: Annotated[float, between(0.0, 0.1)] = 0.0
    # m: contacts are rounded to whole multiples of this in the world; 0: they are not.
    quantisation: Annotated[float, between(0.0, 0.1)] = 0.0
    # Share of all reported contacts that are not on the object, which come with true ones.
    foreign_contacts: Annotated[float, number_between(0.0, 0.5)] = 0.0
    # m: greatest distance between a foreign contact and the true one that it comes with.
    foreign_reach: Annotated[float, between(_NEAREST, 1.0)] = 0.1
    # Share of the voxels reported free among those inside the object, beside swept ones, not deeper
    # than free_reach.
    free_error: Annotated[float, number_between(0.0, 1.0)] = 0.0
    # Sides of a free voxel: greatest depth in the object of the centre of a wrong one.
    free_reach: Annotated[float, number_between(0.0, 2.0)] = 1.0
    # m: by which all contacts are shifted against free space, in one direction for the session.
    camera_bias: Annotated[float, between(0.0, 0.1)] = 0.0
    # Size of the registered mesh by that of the probed one, about the centre of its bounding box.
    mesh_scale: Annotated[float, number_between(0.5, 2.0)] = 1.0
    # Radians: contacts are reported with normals, and this as the root mean square of their angle
    # to the true ones, whatever it is. None: without normals.
    normals: Annotated[float | None, number_between(0.001, math.pi, unit=" radians")] = None
    # Radians: the true root mean square of that angle.
    normal_noise: Annotated[float, number_between(0.0, 1.0, unit=" radians")] = 0.0
    # Share of true contacts whose normal has any direction.
    normal_wrong: Annotated[float, number_between(0.0, 1.0)] = 0.0
    # Radians: by which all normals are turned, about one axis of the world for the session.
    normal_tilt: Annotated[float, number_between(0.0, math.pi, unit=" radians")] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        faulty = [name for name in _OF_NORMAL_FAULTS if getattr(self, name) != 0.0]
        if self.normals is None and faulty:
            raise SettingError(
                f"{faulty[0]} is {getattr(self, faulty[0])}, and contacts have no normals; "
                "accepted with it: normals, the noise stated of them, such as 0.25 radians"
            )


def _with_normals(degrees: float, **others: float) -> FaultSettings:
    """Return faults with normals off by so much, which is stated unless others have `normals`."""
    noise = math.radians(degrees)
    return FaultSettings(**{"normals": noise, "normal_noise": noise, **others})


CLEAN = "clean"
OWN_LEVEL = "own"
"""Name of faults that are none of the levels."""
LEVELS: Mapping[str, FaultSettings] = {
    CLEAN: FaultSettings(),
    "noise_1mm": FaultSettings(contact_noise=0.001),
    "noise_3mm": FaultSettings(contact_noise=0.003),
    "noise_7mm": FaultSettings(contact_noise=0.007),
    "quantised_5mm": FaultSettings(quantisation=0.005),
    "foreign_10": FaultSettings(foreign_contacts=0.1),
    "foreign_20": FaultSettings(foreign_contacts=0.2),
    "free_wrong": FaultSettings(free_error=0.1),
    "camera_5mm": FaultSettings(camera_bias=0.005),
    "mesh_2pct": FaultSettings(mesh_scale=1.02),
    "mixed": FaultSettings(
        contact_noise=0.003,
        foreign_contacts=0.1,
        free_error=0.05,
        camera_bias=0.002,
        mesh_scale=1.01,
    ),
    "normals_10deg": _with_normals(10.0),
    "normals_10deg_noise_3mm": _with_normals(10.0, contact_noise=0.003),
    "normals_10deg_foreign_10": _with_normals(10.0, foreign_contacts=0.1),
    "normals_20deg": _with_normals(20.0),
    "normals_20deg_as_5deg": _with_normals(20.0, normals=math.radians(5.0)),
    "normals_tilt_15deg": _with_normals(10.0, normal_tilt=math.radians(15.0)),
    "normals_wrong_30": _with_normals(10.0, normal_wrong=0.3),
}
"""Named faults, which `session/faults=NAME` and evaluations choose."""
LEVELS_OF_POINTS = tuple(name for name, level in LEVELS.items() if level.normals is None)
"""Levels without normals, which `all` names in evaluations."""


def level_name(faults: FaultSettings) -> str:
    """Return the name of the level with these settings, else OWN_LEVEL."""
    return next((name for name, level in LEVELS.items() if level == faults), OWN_LEVEL)


def probed_mesh(mesh: trimesh.Trimesh, faults: FaultSettings) -> trimesh.Trimesh:
    """Return the mesh that is probed where `mesh` is registered, in the same frame, metres.

    The centre of the bounding box stays, so that both have one true pose.
    """
    if faults.mesh_scale == 1.0:
        return mesh
    centre = np.asarray(mesh.bounds).mean(axis=0)
    probed = mesh.copy()
    probed.vertices = centre + (np.asarray(mesh.vertices) - centre) / faults.mesh_scale
    return probed


class Faults:
    """Makes what a session reports of what its hand has met; depends on the seed alone."""

    def __init__(
        self,
        settings: FaultSettings,
        mesh: trimesh.Trimesh,
        *,
        world_from_object: FloatArray,
        free: FreeVoxels,
        workspace: Workspace,
        seed: int,
    ) -> None:
        """Make the faults of a session.

        mesh: the probed one, metres, at world_from_object (4, 4). free: of the session.
        """
        self._settings = settings
        self._mesh = mesh
        self._seed = seed
        self.object_from_world = inverse(world_from_object)  # changes where pushes move it
        self._free, self._workspace = free, workspace
        stream = StreamKey(seed, 0).stream(Purpose.FAULTS, _OF_SESSION)
        self._bias = settings.camera_bias * _directions(stream, 1)[0]  # (3,), world
        self._phase = float(uniforms(stream, 0.0, upper=1.0, shape=1)[0])
        stream = StreamKey(seed, 0).stream(Purpose.FAULTS, _OF_TILT)
        self._tilt = axis_angle(_directions(stream, 1)[0], settings.normal_tilt)
        self._wrong_phase = float(uniforms(stream, 0.0, upper=1.0, shape=1)[0])
        self._true = self._foreign = 0  # numbers of contacts so far
        self._drawn: set[bytes] = set()  # voxels inside the object that had their chance

    def reported(
        self, step: int, contacts: FloatArray, *, normals_out: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return contacts (C', 3) and normals (C', 3) reported of true ones (C, 3); true first."""
        places, others = self._foreign_contacts(step, contacts)
        contacts = np.concatenate([contacts, places]) + self._bias
        noise = normals(self._stream(step, _OF_NOISE), contacts.shape)
        contacts = contacts + self._settings.contact_noise * noise
        side = self._settings.quantisation
        if side > 0.0:
            contacts = np.rint(contacts / side) * side
        if self._settings.normals is not None:
            normals_out = rotated(self._tilt, self._noisy_normals(step, normals_out))
            others = rotated(self._tilt, others)
        return contacts, np.concatenate([normals_out, others])

    def _noisy_normals(self, step: int, true: FloatArray) -> FloatArray:
        """Return normals (C, 3) of the last true contacts with noise, some of any direction."""
        drawn = normals(self._stream(step, _OF_NORMALS), true.shape)
        across = drawn - (drawn * true).sum(axis=1, keepdims=True) * true
        turns = self._settings.normal_noise / math.sqrt(2.0) * across  # (C, 3), rotation vectors
        found = rotated(rotation_vector(turns), true)
        numbers = self._true - len(true) + np.arange(len(true) + 1)
        wrong_so_far = np.floor(numbers * self._settings.normal_wrong + self._wrong_phase)
        anywhere = _directions(self._stream(step, _OF_WRONG), len(true))
        return np.where(np.diff(wrong_so_far)[:, None] > 0.0, anywhere, found)

    def wrongly_free(self, step: int, swept: FloatArray) -> FloatArray:
        """Return centres (N', 3) of voxels in the object reported free beside swept ones (N, 3).

        Each voxel has one chance in a session, when the first one beside it is swept.
        """
        if self._settings.free_error == 0.0 or len(swept) == 0:
            return np.zeros((0, 3))
        lattice = self._free.lattice
        swept = swept[self._in_bounds(swept, margin=2.0 * lattice.spacing)]
        beside = lattice.voxels(swept)[:, None] + _NEIGHBOURS
        voxels = np.unique(beside.reshape(-1, 3), axis=0)
        voxels = voxels[self._in_bounds(lattice.centres(voxels))]
        depth = -self._distance(lattice.centres(voxels))
        voxels = voxels[(depth > 0.0) & (depth <= self._settings.free_reach * lattice.spacing)]
        new = np.array([voxel.tobytes() not in self._drawn for voxel in voxels], dtype=bool)
        voxels = voxels[new]
        self._drawn.update(voxel.tobytes() for voxel in voxels)
        chance = uniforms(self._stream(step, _OF_FREE), 0.0, upper=1.0, shape=len(voxels))
        return self._free.add(lattice.centres(voxels[chance < self._settings.free_error]))

    def _foreign_contacts(self, step: int, contacts: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return contacts (K, 3) off the object, with normals (K, 3) in any direction.

        Their share is kept over the session, not drawn for every contact. Where no place fits, the
        contact comes with the next true one.
        """
        share = self._settings.foreign_contacts
        stream = self._stream(step, _OF_FOREIGN)
        found: list[FloatArray] = []
        for contact in contacts:
            self._true += 1
            while self._foreign < int(self._true * share / (1.0 - share) + self._phase):
                place = self._place_beside(contact, stream)
                if place is None:
                    break
                self._foreign += 1
                found.append(place)
        return np.array(found).reshape(-1, 3), _directions(stream, len(found))

    def _place_beside(self, contact: FloatArray, stream: np.random.Generator) -> FloatArray | None:
        """Return a point (3,) off the object in no voxel reported free; None if none was found."""
        away = uniforms(stream, _NEAREST, upper=self._settings.foreign_reach, shape=(_TRIES, 1))
        places = contact + away * _directions(stream, _TRIES)
        lower, upper = self._workspace.bounds
        fitting = ((places >= lower) & (places <= upper)).all(axis=1) & ~self._free.holds(places)
        fitting &= self._distance(places) >= _OFF
        return places[np.argmax(fitting)] if fitting.any() else None

    def _in_bounds(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        """Return which points (N, 3) are in the probed mesh's bounding box, padded by a margin."""
        in_object = apply(self.object_from_world, points)
        (lower, upper) = self._mesh.bounds
        inside: BoolArray = (in_object >= lower - margin).all(axis=1)
        inside &= (in_object <= upper + margin).all(axis=1)
        return inside

    def _distance(self, points: FloatArray) -> FloatArray:
        """Return signed distance (N,) of points (N, 3) in the world to the probed mesh, metres."""
        return mesh_sdf(self._mesh, apply(self.object_from_world, points))[0]

    def _stream(self, step: int, index: int) -> np.random.Generator:
        return StreamKey(self._seed, step).stream(Purpose.FAULTS, index)


def _directions(stream: np.random.Generator, count: int) -> FloatArray:
    """Return unit vectors (count, 3), uniform over directions."""
    drawn = normals(stream, (count, 3))
    return drawn / np.sqrt((drawn**2).sum(axis=1, keepdims=True))
