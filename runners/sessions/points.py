"""A session whose known points come from a file."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError, PointsError, PoseError, SettingError, require_positive
from chsel.numerics.arrays import FloatArray, IntArray, frozen
from chsel.problem.defaults import FREE_RESOLUTION, workspace_around
from chsel.problem.file_checks import read_npz, refuse_special_file
from chsel.problem.points import FreeVoxels, KnownPoints, Lattice, Workspace, check_points
from chsel.problem.poses import nearest_rigid
from chsel.problem.sdf_grid import OBJECT_PADDING
from chsel.problem.streams import LAST_STEP
from replay.events import Probe
from runners.objects.loader import ObjectModel
from runners.sessions.session import Progress, unwatched


@dataclass(frozen=True)
class PointsSettings:
    """A file of known points. With the defaults, `chsel.register` has the same bits."""

    path: str | None = None  # .npz, .csv, .ply, .off, .xyz or .stl
    workspace: tuple[tuple[float, float], ...] | None = None
    """[[x0, x1], [y0, y1], [z0, z1]], metres; None: around the points, padded by the diameter."""
    free_resolution: float = FREE_RESOLUTION  # voxel side of free space, metres
    merge_free: bool = False  # keep one free point a voxel, at its centre
    object_resolution: float | None = None  # of the SDF grid, metres; None: that of `object_grid`
    object_padding: float = OBJECT_PADDING  # of the SDF grid, metres
    start_contacts: int = 0  # a registration needs so many contacts
    start_probe: int = 0  # and this index of the probe

    def __post_init__(self) -> None:
        require_positive("free_resolution", self.free_resolution)
        if not self.path:
            raise SettingError("path is missing; pass session.path=FILE, a file of known points")
        if self.workspace is not None and [len(pair) for pair in self.workspace] != [2, 2, 2]:
            raise SettingError(
                f"workspace is {self.workspace}; accepted: [[x0, x1], [y0, y1], [z0, z1]]"
            )


class PointsSession:
    """Replays the steps of a file; a probe's index is the file's step.

    Raises PointsError for points that cannot be those of the object.
    """

    def __init__(
        self, settings: PointsSettings, object_model: ObjectModel, progress: Progress = unwatched
    ) -> None:
        """progress: gets that of the SDF grid, whose diameter pads the workspace."""
        assert settings.path is not None
        self._file = read_points(settings.path)
        self._steps = self._file.steps
        self._merge = settings.merge_free
        self.free_resolution = settings.free_resolution
        self.world_from_object = self._file.world_from_object
        self.initial_points = KnownPoints()
        self.count = len(self._steps)
        every = KnownPoints.joined([self._file.at(step) for step in self._steps])
        given = _given_workspace(settings)
        try:  # before any work; warnings are given when the points become known
            check_points(every, object_model.diameter, self.free_resolution, given)
        except PointsError as error:
            raise PointsError(f"point file {settings.path}: {error}") from None
        self.workspace = given or workspace_around(every, object_model.grid(settings, progress))

    def probes(self) -> Iterator[Probe]:
        """One probe per step of the file."""
        voxels = FreeVoxels(Lattice(self.workspace.lower, self.free_resolution))
        for step in self._steps:
            points = self._file.at(step)
            if self._merge:
                points = KnownPoints(
                    voxels.add(points.free), points.occupied, points.known, points.sdf
                )
            contacts = points.contacts
            yield Probe(step, "points", points, contacts=contacts, contact_normals=0.0 * contacts)

    def close(self) -> None:
        """Nothing is held open."""


def _given_workspace(settings: PointsSettings) -> Workspace | None:
    if settings.workspace is None:
        return None
    (x0, x1), (y0, y1), (z0, z1) = settings.workspace
    return Workspace((x0, y0, z0), (x1, y1, z1))


KINDS = ("surface", "free", "occupied", "known")
_LONGEST_TEXT = 60  # characters that an error quotes of a file
_COLUMNS = ("x", "y", "z", "kind", "sdf", "step")


@dataclass(frozen=True, eq=False)
class PointClass:
    """Points (N, 3) of one kind, their signed distances (N,), and the steps (N,) they come at."""

    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    sdf: FloatArray = field(default_factory=lambda: np.zeros(0))
    steps: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def at(self, step: int) -> PointClass:
        """Those that become known at a step, in the order of the file."""
        order, steps = self._by_step
        first, last = np.searchsorted(steps, (step, step + 1))
        now = order[first:last]
        return PointClass(self.points[now], self.sdf[now], self.steps[now])

    @cached_property
    def _by_step(self) -> tuple[IntArray, IntArray]:
        """The points (N,) in the order of their steps, and these steps (N,)."""
        order = np.argsort(self.steps, kind="stable")
        return order, self.steps[order]


@dataclass(frozen=True, eq=False)
class PointFile:
    """What a file holds: a class for each of KINDS, and the true pose (4, 4) where it is given."""

    classes: dict[str, PointClass]
    world_from_object: FloatArray | None = None

    @property
    def steps(self) -> list[int]:
        """The steps at which anything becomes known, ascending."""
        every = np.concatenate([group.steps for group in self.classes.values()])
        return [int(step) for step in np.unique(every)]

    def at(self, step: int) -> KnownPoints:
        """All that becomes known at a step; surface points are known points of distance 0."""
        now = {kind: self.classes[kind].at(step) for kind in KINDS}
        return KnownPoints(
            free=now["free"].points,
            occupied=now["occupied"].points,
            known=np.concatenate([now["surface"].points, now["known"].points]),
            known_sdf=np.concatenate([now["surface"].sdf, now["known"].sdf]),
        )


def read_points(path: str | Path) -> PointFile:
    """Read .npz, .csv, or the vertices of .ply, .off, .xyz and .stl as surface points.

    Raises PointsError, which names the file and the array or line, for anything malformed.
    """
    path = Path(path).expanduser()
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise PointsError(
            f"point file {path} has the suffix {path.suffix!r}; accepted: {', '.join(_READERS)}"
        )
    refuse_special_file(f"point file {path}", path, PointsError)
    if not path.is_file():
        raise PointsError(f"point file {path} does not exist; accepted: a file")
    try:
        content = reader(path)
    except ChselError as error:
        raise PointsError(f"point file {path}: {error}") from None
    if not content.steps:
        raise PointsError(f"point file {path} holds no points; accepted: at least one")
    return content


def _read_npz(path: Path) -> PointFile:
    accepted = [*KINDS, "known_sdf", *(f"{kind}_step" for kind in KINDS), "world_from_object"]
    arrays = read_npz(path, accepted=accepted, error=PointsError)
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise PointsError(f"{name} has type {array.dtype}; accepted: numbers")
    if not any(kind in arrays for kind in KINDS):
        raise PointsError(f"no array of points; accepted: at least one of {', '.join(KINDS)}")
    if ("known" in arrays) != ("known_sdf" in arrays):
        raise PointsError("known and known_sdf stand only together")
    classes = {kind: _npz_class(kind, arrays) for kind in KINDS}
    return PointFile(classes, _npz_pose(arrays))


def _npz_class(kind: str, arrays: dict[str, Any]) -> PointClass:
    if kind not in arrays:
        return PointClass()
    points = frozen(kind, arrays[kind], (None, 3))
    sdf = arrays["known_sdf"] if kind == "known" else np.zeros(len(points))
    name = f"{kind}_step"
    steps = np.asarray(arrays.get(name, np.zeros(len(points), dtype=np.int64)))
    if not np.issubdtype(steps.dtype, np.integer) or steps.shape != (len(points),):
        raise PointsError(
            f"{name} has type {steps.dtype} and shape {steps.shape}; accepted: integers, shape "
            f"({len(points)},)"
        )
    refused = (steps < 0) | (steps > LAST_STEP)
    if refused.any():
        row = int(np.argmax(refused))
        raise PointsError(f"{name}[{row}] is {steps[row]}; accepted: 0 to {LAST_STEP}")
    return PointClass(points, frozen("known_sdf", sdf, (len(points),)), steps.astype(np.int64))


def _npz_pose(arrays: dict[str, Any]) -> FloatArray | None:
    if "world_from_object" not in arrays:
        return None
    pose = frozen("world_from_object", arrays["world_from_object"], (4, 4), error=PoseError)
    return nearest_rigid("world_from_object", pose[None])[0]


def _read_csv(path: Path) -> PointFile:
    columns: dict[str, tuple[list[Any], list[Any], list[Any]]] = {k: ([], [], []) for k in KINDS}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            header = [name.strip() for name in reader.fieldnames or []]
            reader.fieldnames = header
            named = set(header)
            if not {"x", "y", "z", "kind"} <= named <= set(_COLUMNS) or len(named) < len(header):
                raise PointsError(
                    f"line 1 is {','.join(header)[:_LONGEST_TEXT]!r}; accepted: the header "
                    "x,y,z,kind[,sdf][,step], each column once"
                )
            for row in reader:
                try:
                    kind, *values = _csv_row(row)
                except ValueError as error:
                    raise PointsError(f"line {reader.line_num}: {error}") from None
                for column, value in zip(columns[kind], values, strict=True):
                    column.append(value)
    except (UnicodeDecodeError, csv.Error) as error:
        raise PointsError(f"not a readable .csv file ({error})") from None
    return PointFile(
        {
            kind: PointClass(
                frozen("points", np.reshape(points, (-1, 3)), (None, 3)),
                np.array(sdf, dtype=np.float64),
                np.array(steps, dtype=np.int64),
            )
            for kind, (points, sdf, steps) in columns.items()
        }
    )


def _csv_row(row: dict[Any, Any]) -> tuple[str, list[float], float, int]:
    """Kind, point, signed distance and step of a row; ValueError for what is wrong."""
    if None in row or None in row.values():
        raise ValueError("it has another number of fields than the header")
    kind = row["kind"].strip()
    if kind not in KINDS:
        raise ValueError(f"kind is {kind[:_LONGEST_TEXT]!r}; accepted: {', '.join(KINDS)}")
    given = row.get("sdf", "").strip()
    sdf = _number(given or "0", "sdf")
    if not given and kind == "known":
        raise ValueError("a known point needs an sdf")
    if given and (kind in ("free", "occupied") or (kind == "surface" and sdf != 0.0)):
        raise ValueError(f"a {kind} point has sdf {sdf:g}; accepted: nothing")
    step = _number(row.get("step", "").strip() or "0", "step")
    if step != int(step) or not 0 <= step <= LAST_STEP:
        raise ValueError(f"step is {step:.20g}; accepted: an integer from 0 to {LAST_STEP}")
    return kind, [_number(row[axis], axis) for axis in "xyz"], sdf, int(step)


def _number(text: str, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} is {text[:_LONGEST_TEXT]!r}; accepted: a finite number")
    return value


def _read_surface(path: Path) -> PointFile:
    """Every vertex of a mesh or point cloud is a surface point, those at one place together one."""
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    try:
        loaded = trimesh.load(str(path), file_type=kind, process=False)
        geometries = list(getattr(loaded, "geometry", {"": loaded}).values())
        vertices = np.concatenate([_vertices(geometry) for geometry in geometries])
    except Exception as error:  # readers of foreign formats raise anything
        reason = " ".join(str(error).split()) or type(error).__name__
        raise PointsError(f"not a readable .{kind} file ({reason[:200]})") from None
    points = frozen("surface", vertices, (None, 3))
    nothing = {kind: PointClass() for kind in KINDS}
    steps = np.zeros(len(points), dtype=np.int64)
    return PointFile({**nothing, "surface": PointClass(points, np.zeros(len(points)), steps)})


def _vertices(geometry: Any) -> FloatArray:
    """All vertices (V, 3); of those of a mesh's faces, one for each place."""
    import trimesh

    vertices = np.asarray(geometry.vertices, dtype=np.float64).reshape(-1, 3)
    if not isinstance(geometry, trimesh.Trimesh) or not np.isfinite(vertices).all():
        return vertices
    beside = vertices[~geometry.referenced_vertices]
    geometry.process()
    return np.concatenate([np.asarray(geometry.vertices).reshape(-1, 3), beside])


_READERS: dict[str, Callable[[Path], PointFile]] = {
    ".npz": _read_npz,
    ".csv": _read_csv,
    ".ply": _read_surface,
    ".off": _read_surface,
    ".xyz": _read_surface,
    ".stl": _read_surface,
}
