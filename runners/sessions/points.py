"""A source whose known points come from a file."""

from __future__ import annotations

import csv
import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import (
    ChselError,
    PointsError,
    PointsWarning,
    PoseError,
    SettingError,
    require_choice,
    require_positive,
)
from chsel.events import Probe, Start
from chsel.numerics.arrays import FloatArray, IntArray, frozen, read_npz, refuse_special_file
from chsel.problem.mesh import load_mesh
from chsel.problem.points import (
    FREE_RESOLUTION,
    NEAR_UNIT,
    NORMAL_NOISE,
    POINT_CLASSES,
    KnownPoints,
    Workspace,
    check_places,
    check_points,
    check_workspace,
    distinct_points,
    same_place,
    unit_normals,
    workspace_around,
    world_points,
)
from chsel.problem.pose_prior import prior_from_settings
from chsel.problem.poses import nearest_rigid
from chsel.problem.sdf_grid import OBJECT_PADDING
from chsel.problem.streams import LAST_STEP
from chsel.sensing.free_space import FreeGrid
from chsel.sensing.trajectory import TRAJECTORIES, read_trajectory
from chsel.session.perception import swept_by
from runners.objects.loader import ObjectModel
from runners.sessions.source import ObjectOrigin, ProbeSource, SourceKind
from runners.sessions.touch_arrays import TOUCH_ARRAYS, touched_in

NORMALS = ("none", "file")


@dataclass(frozen=True)
class PointsSettings:
    """A file of known points.

    With the defaults, `chsel.register` has the same bits, but for objects of the paper's trials at
    their size there, see `ObjectModel.resolution`.
    """

    path: str | None = None  # .npz, .csv, .ply, .pcd, .off, .xyz or .stl
    workspace: tuple[tuple[float, float], ...] | None = None
    """[[x0, x1], [y0, y1], [z0, z1]], metres; None: around the points, padded by the diameter."""
    free_resolution: float = FREE_RESOLUTION  # voxel side of free space, metres
    object_resolution: float | None = None
    """Spacing of the SDF grid, metres; None: by the object, see `ObjectModel.resolution`."""
    object_padding: float = OBJECT_PADDING  # of the SDF grid, metres
    prior: Any = None  # fields of `chsel.PosePrior`; None: nothing is known of the pose
    start_contacts: int = 0  # a registration needs so many contacts
    start_probe: int = 0  # and this index of the probe
    normals: str = "none"
    """NORMALS: "file" reads the normals of the file, "none" leaves them out."""
    normal_noise: float = NORMAL_NOISE
    """Root mean square angle by which they are off where the file does not say, radians."""
    trajectory: str | None = None
    """A file of the poses that the hand went through, whose way is free from the first step on."""
    trajectory_kind: str | None = None  # of chsel.sensing.trajectory.TRAJECTORIES
    hand: str | None = None  # its mesh, in its own frame, metres

    def __post_init__(self) -> None:
        require_choice("normals", self.normals, accepted=NORMALS)
        require_positive("normal_noise", self.normal_noise)
        if self.normal_noise > math.pi:
            text = "in degrees? accepted: above 0, up to pi, radians"
            raise SettingError(f"normal_noise is {self.normal_noise:g}; {text}")
        require_positive("free_resolution", self.free_resolution)
        if not self.path:
            raise SettingError("path is missing; pass session.path=FILE, a file of known points")
        if self.workspace is not None and [len(pair) for pair in self.workspace] != [2, 2, 2]:
            raise SettingError(
                f"workspace is {self.workspace}; accepted: [[x0, x1], [y0, y1], [z0, z1]]"
            )
        prior_from_settings("prior", self.prior)
        of_hand = [self.trajectory, self.trajectory_kind, self.hand]
        if None in of_hand and of_hand != [None] * 3:
            raise SettingError(
                f"trajectory, trajectory_kind and hand are {of_hand}; accepted: all of them, with "
                f"a kind of {', '.join(TRAJECTORIES)}, or none"
            )


class PointsSource(ProbeSource):
    """Replays the steps of a file; a probe's index is the file's step; see `ProbeSource`.

    Raises PointsError for points that cannot be those of the object.
    """

    def __init__(self, settings: PointsSettings, object_model: ObjectModel) -> None:
        assert settings.path is not None
        noise = settings.normal_noise if settings.normals == "file" else None
        self._file = read_points(settings.path, normal_noise=noise)
        self._steps = np.unique(self._file.steps).tolist()
        self.free_resolution = settings.free_resolution
        self.world_from_object = self._file.world_from_object
        self.prior = prior_from_settings("session.prior", settings.prior)
        self.initial_points = KnownPoints()
        self.count = len(self._steps)
        self.start = Start(contacts=settings.start_contacts, step=settings.start_probe)
        self.warnings: list[PointsWarning] = []
        if self._file.has_unread_normals:
            text = f"point file {settings.path} has normals, which are not used; session.normals="
            self.warnings.append(PointsWarning("normals_unused", f"{text}file uses them"))
        self._points: list[KnownPoints] = []  # of each step
        every = KnownPoints()
        diameter = object_model.diameter
        for step in self._steps:
            points, repeated = distinct_points(
                self._file.at(step), every, apart=same_place(diameter)
            )
            every = every.merged(points)
            self._points.append(points)
            self.warnings += repeated
        given = None
        if settings.workspace is not None:
            (x0, x1), (y0, y1), (z0, z1) = settings.workspace
            given = Workspace((x0, y0, z0), (x1, y1, z1))
        try:  # before any work; warnings are given when the points become known
            check_points(every, diameter, free_resolution=self.free_resolution, workspace=given)
            if given is not None:
                self.warnings += check_workspace(given, diameter)
        except PointsError as error:
            raise PointsError(f"point file {settings.path}: {error}") from None
        self.warnings += check_places(
            "the nearest point", every.all_points(), diameter=diameter, workspace=given
        )
        self.workspace = given or workspace_around(every, object_model.grid(settings))
        self._points[0] = self._points[0].merged(KnownPoints(free=self._swept(settings)))

    def probes(self) -> Iterator[Probe]:
        """Yield one probe per step of the file."""
        for step, points in zip(self._steps, self._points, strict=True):
            found = self._file.at(step)
            found = found.with_known(found.sdf == 0.0)
            yield Probe(
                step,
                "points",
                new_points=points,
                contacts=found.known,
                contact_normals=found.normals,
            )

    def _swept(self, settings: PointsSettings) -> FloatArray:
        """Return the centres (F, 3) of the voxels that the hand went through, world, metres."""
        if settings.trajectory is None or settings.hand is None:
            return np.zeros((0, 3))
        _, poses = read_trajectory(settings.trajectory, settings.trajectory_kind or "")
        hand = load_mesh(settings.hand)
        nodes, swept = swept_by(hand, poses, spacing=self.free_resolution)
        grid = FreeGrid(self.workspace, self.free_resolution)
        grid.at(nodes, poses=swept)
        free = grid.new()
        if len(free) == 0:
            text = f"trajectory {settings.trajectory} misses the workspace around the points"
            self.warnings.append(PointsWarning("trajectory", f"{text}; check its frame and unit"))
        return free

    def close(self) -> None:
        """Release nothing, as nothing is held open."""


def open_points(  # noqa: PLR0917
    settings: PointsSettings, object_model: ObjectModel | None, seed: int
) -> PointsSource:
    """Open the source of a file, whatever the seed. Raise PointsError for unusable points."""
    assert object_model is not None
    return PointsSource(settings, object_model)


POINTS = SourceKind(PointsSettings, open_points, object=ObjectOrigin.REAL)


KINDS = ("surface", *POINT_CLASSES)
_WITH_NORMALS = ("surface", "known")
_OF_NORMALS = ("normal", "normal_noise")  # behind these in names of arrays
_COLUMNS = ["x", "y", "z", "kind", "sdf", "step"]
_NORMAL = ["nx", "ny", "nz"]
_PLACE = ("x", "y", "z")
_PCD_NORMAL = ("normal_x", "normal_y", "normal_z")
_ORIGIN = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # place and quaternion w, x, y, z of a PCD's sensor
_ACCEPTED = (
    "x, y, z[, kind[, sdf]][, step][, nx, ny, nz[, normal_noise]], commas between them, decimal "
    "points in numbers"
)


@dataclass(frozen=True, eq=False)
class PointFile:
    """The points of a file in its order, each with its kind, signed distance and step."""

    kinds: np.ndarray  # (N,), of KINDS
    points: FloatArray  # (N, 3), world, metres
    sdf: FloatArray  # (N,), metres; that of known points alone counts
    steps: IntArray  # (N,): at which each becomes known
    normals: FloatArray  # (N, 3), unit, out of the object, world; 0 where none is known or read
    normal_noise: FloatArray  # (N,), root mean square angle, radians; 0 where there is no normal
    has_unread_normals: bool = False
    world_from_object: FloatArray | None = None  # (4, 4): the true pose, where it is given

    def at(self, step: int) -> KnownPoints:
        """Return all that becomes known at a step; surface points have distance 0."""
        surface, free, occupied, known = (
            np.flatnonzero((self.kinds == kind) & (self.steps == step)) for kind in KINDS
        )
        known = np.concatenate([surface, known])
        points = self.points
        return KnownPoints(
            points[free],
            points[occupied],
            known=points[known],
            known_sdf=self.sdf[known],
            normals=self.normals[known],
            normal_noise=self.normal_noise[known],
        )


def read_points(path: str | Path, *, normal_noise: float | None = None) -> PointFile:
    """Read .npz, .csv, or the points of .ply, .pcd, .off, .xyz and .stl as surface points.

    normal_noise: of normals about which the file does not say it, radians; None: read no normals.
    Raise PointsError, which names the file and the array or row, for anything malformed.
    """
    path = Path(path).expanduser()
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise PointsError(
            f"point file {path} has the suffix {path.suffix!r}; accepted: {', '.join(_READERS)}"
        )
    if not path.is_file():
        raise PointsError(f"point file {path} does not exist; accepted: a file")
    refuse_special_file(f"point file {path}", path, error=PointsError)
    try:
        content = reader(path, normal_noise)
        if normal_noise is not None and not content.normal_noise.any():
            raise PointsError("it has no normals; accepted: session.normals=none")
        if len(content.points) == 0:
            raise PointsError("it holds no points; accepted: at least one")
        world_points("points", content.points)  # raises for what is far beyond a robot's reach
        first, last = content.steps.min(), content.steps.max()
        if first < 0 or last > LAST_STEP:
            raise PointsError(f"steps are from {first} to {last}; accepted: 0 to {LAST_STEP}")
    except ChselError as error:
        raise PointsError(f"point file {path}: {error}") from None
    return content


def _read_npz(path: Path, normal_noise: float | None) -> PointFile:
    of_normals = [f"{kind}_{name}" for kind in _WITH_NORMALS for name in _OF_NORMALS]
    accepted = [*KINDS, "known_sdf", *(f"{kind}_step" for kind in KINDS), "world_from_object"]
    accepted += [*of_normals, *TOUCH_ARRAYS]
    arrays = read_npz(path, accepted=accepted, error=PointsError)
    given = [kind for kind in KINDS if kind in arrays]
    has_touches = any(name in arrays for name in TOUCH_ARRAYS)
    if not given and not has_touches:
        names = f"{', '.join(KINDS)}, {TOUCH_ARRAYS[0]}"
        raise PointsError(f"no array of points; accepted: at least one of {names}")
    if ("known" in arrays) != ("known_sdf" in arrays):
        raise PointsError("known and known_sdf stand only together")
    pose = arrays.get("world_from_object")
    if pose is not None:
        pose = frozen("world_from_object", pose, shape=(4, 4), error=PoseError)
        pose = nearest_rigid("world_from_object", pose[None])[0]
    for kind, name in product(_WITH_NORMALS, _OF_NORMALS):
        if f"{kind}_{name}" in arrays and kind not in given:
            raise PointsError(f"{kind}_{name} has no {kind}; accepted: both, or none")
    parts = [_npz_part(kind, arrays, normal_noise=normal_noise) for kind in given]
    if has_touches:
        parts.append(_touch_part(arrays, normal_noise=normal_noise))
    columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    kinds, points, sdf, steps, normals, noise = columns
    return PointFile(
        kinds,
        points,
        sdf=sdf,
        steps=steps,
        normals=normals,
        normal_noise=noise,
        has_unread_normals=normal_noise is None
        and (has_touches or any(name in arrays for name in of_normals)),
        world_from_object=pose,
    )


def _touch_part(arrays: dict[str, Any], *, normal_noise: float | None) -> tuple[np.ndarray, ...]:
    """Return kinds, points, distances, steps, normals and their noise of touch images."""
    points, normals, steps = touched_in(arrays)
    known = normals.any(axis=1)
    if normal_noise is None:
        normals, known = np.zeros_like(normals), np.zeros_like(known)
    noise = np.where(known, normal_noise or 0.0, 0.0)
    return np.full(len(points), "surface"), points, np.zeros(len(points)), steps, normals, noise


def _npz_part(
    kind: str, arrays: dict[str, Any], *, normal_noise: float | None
) -> tuple[np.ndarray, ...]:
    """Return kinds, points, distances, steps, normals and their noise of one array of points."""
    points = frozen(kind, arrays[kind], shape=(None, 3))
    nothing = np.zeros(len(points), dtype=np.int64)
    sdf = frozen(
        "known_sdf", arrays["known_sdf"] if kind == "known" else nothing, shape=nothing.shape
    )
    steps = np.asarray(arrays.get(f"{kind}_step", nothing))
    if not np.issubdtype(steps.dtype, np.integer) or steps.shape != nothing.shape:
        raise PointsError(
            f"{kind}_step has type {steps.dtype} and shape {steps.shape}; accepted: integers, "
            f"shape {nothing.shape}"
        )
    given = noise = None
    if normal_noise is not None:
        given, noise = (arrays.get(f"{kind}_{name}") for name in _OF_NORMALS)
    if given is not None and noise is None:
        noise = normal_noise
    normals, noise = unit_normals(f"{kind}_normal", given, noise=noise, count=len(points))
    return np.full(len(points), kind), points, sdf, steps.astype(np.int64), normals, noise


def _read_csv(path: Path, normal_noise: float | None) -> PointFile:
    import pandas as pd

    try:
        with warnings.catch_warnings(action="error", category=pd.errors.ParserWarning):
            table = pd.read_csv(path, dtype=object, skipinitialspace=True, index_col=False)
    except (ValueError, pd.errors.ParserWarning) as error:
        raise PointsError(_wrong_length(path) or _unreadable(".csv", error)) from None
    table.columns = table.columns.str.strip()
    with_kind = "kind" in table
    of_normals = set(table) & {*_NORMAL, "normal_noise"}
    if (
        not set("xyz") <= set(table) - of_normals <= set(_COLUMNS)
        or ("sdf" in table and not with_kind)
        or (of_normals and not of_normals >= set(_NORMAL))
    ):
        raise PointsError(f"its columns are {', '.join(table.columns)}; accepted: {_ACCEPTED}")
    if not with_kind:
        table["kind"] = "surface"
    directions = table.reindex(columns=[*_NORMAL, "normal_noise"])
    table = table.reindex(columns=_COLUMNS)
    kinds = table.pop("kind").astype(str).str.strip().to_numpy()
    known = kinds == "known"
    given = table["sdf"].notna().to_numpy()
    table = table.fillna({"sdf": 0.0, "step": 0.0})
    numbers = _numbers(table)
    points = numbers[:, :3]
    sdf = numbers[:, 3]
    steps = numbers[:, 4]
    for wrong, what in (
        (~np.isin(kinds, KINDS), f"kind is none of {', '.join(KINDS)}"),
        (~np.isfinite(numbers).all(axis=1), "one of x, y, z, sdf and step is not a finite number"),
        (known & ~given, "a known point needs an sdf"),
        (~known & (sdf != 0.0), "a point that is not known has an sdf"),
        (steps % 1.0 != 0.0, "step is not an integer"),
    ):
        if wrong.any():
            raise PointsError(f"row {np.argmax(wrong) + 1}: {what}")
    if not with_kind:
        text = f"point file {path} has no column kind: its points are read as points on the object"
        warnings.warn(PointsWarning("kind", text), stacklevel=2)
    if normal_noise is None:
        directions[:] = np.nan
    normals, noise = _csv_normals(directions, normal_noise, kinds=kinds)
    return PointFile(
        kinds,
        points,
        sdf=sdf,
        steps=steps.astype(np.int64),
        normals=normals,
        normal_noise=noise,
        has_unread_normals=normal_noise is None and bool(of_normals),
    )


def _csv_normals(
    table: Any, normal_noise: float | None, *, kinds: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Return normals (N, 3) and their noise (N,) of columns nx, ny, nz and normal_noise.

    Empty cells: no normal, or a noise of normal_noise, radians. Raise PointsError, which names the
    row, for a malformed one.
    """
    given = table.notna().to_numpy()
    default = NORMAL_NOISE if normal_noise is None else normal_noise
    numbers = _numbers(table.fillna(dict.fromkeys(_NORMAL, 0.0) | {"normal_noise": default}))
    normals, noise = numbers[:, :3], numbers[:, 3]
    known = (normals != 0.0).any(axis=1)
    length = np.sqrt((normals**2).sum(axis=1))
    with_normals = np.isin(kinds, _WITH_NORMALS)
    bad_noise = (noise < 0.0) | (noise > math.pi) | (known & (noise == 0.0))
    for wrong, what in (
        (~np.isfinite(numbers).all(axis=1), "one of nx, ny, nz and normal_noise is not finite"),
        (given[:, :3].any(axis=1) & ~given[:, :3].all(axis=1), "one of nx, ny, nz is missing"),
        (known & (np.abs(length - 1.0) > NEAR_UNIT), "nx, ny, nz is no unit vector"),
        (known & ~with_normals, f"a normal, but kind is none of {', '.join(_WITH_NORMALS)}"),
        (bad_noise, "normal_noise is not above 0, up to pi, radians"),
    ):
        if wrong.any():
            raise PointsError(f"row {np.argmax(wrong) + 1}: {what}")
    return unit_normals("normals", normals, noise=noise, count=len(normals))


def _numbers(table: Any) -> FloatArray:
    """Return the numbers of a table; raise PointsError for the first value that is none."""
    try:
        return np.asarray(table.to_numpy(float))
    except ValueError:
        raise PointsError(_not_a_number(table)) from None


def _wrong_length(path: Path) -> str:
    """Return which row of a .csv file has more values than columns; "" if none has."""
    with suppress(ValueError, csv.Error), path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.reader(file)
        columns = len(next(rows, ()))
        for number, row in enumerate(rows, 1):
            if len(row) > columns:
                what = f"row {number} has {len(row)} values for {columns} columns"
                return f"{what}; accepted: {_ACCEPTED}"
    return ""


def _not_a_number(table: Any) -> str:
    """Return the first value of a table that is not a number."""
    for row, values in enumerate(table.itertuples(index=False), 1):
        for name, value in zip(table.columns, values, strict=True):
            try:
                float(value)
            except ValueError:
                return f"row {row}: {name} is {str(value)!r}; accepted: a number such as 0.125"
    raise AssertionError("all are numbers")


def _unreadable(suffix: str, error: Exception) -> str:
    """Return what a reader of a foreign format says, on one line."""
    reason = " ".join(str(error).split()) or type(error).__name__
    return f"not a readable {suffix} file ({reason[:200]})"


def _read_surface(path: Path, normal_noise: float | None) -> PointFile:
    """Return every vertex of a mesh or point cloud as a surface point, each place once.

    Normals are those of the vertices of a .ply file alone.
    """
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    directions = None
    try:
        loaded = trimesh.load(str(path), file_type=kind, process=False)
        geometries = list(getattr(loaded, "geometry", {"": loaded}).values())
        if kind == "ply":
            directions = _ply_normals(geometries[0])
        if directions is None or normal_noise is None:
            vertices = np.concatenate([_vertices(geometry) for geometry in geometries])
        else:
            vertices = np.asarray(geometries[0].vertices, dtype=np.float64).reshape(-1, 3)
    except Exception as error:  # readers of foreign formats raise anything
        raise PointsError(_unreadable(f".{kind}", error)) from None
    return _surface(vertices, directions, normal_noise=normal_noise)


def _surface(
    vertices: FloatArray, directions: FloatArray | None, *, normal_noise: float | None
) -> PointFile:
    """Return surface points (N, 3) and their normals (N, 3), each place once if these are read."""
    points = frozen("surface", vertices, shape=(None, 3))
    unread = normal_noise is None and directions is not None
    normals, noise = unit_normals("normals", None, noise=None, count=len(points))
    if directions is not None and normal_noise is not None:
        normals, noise = unit_normals("normals", directions, noise=normal_noise, count=len(points))
        first = np.sort(np.unique(points, axis=0, return_index=True)[1])
        points, normals, noise = points[first], normals[first], noise[first]
    nothing = np.zeros(len(points), dtype=np.int64)
    return PointFile(
        np.full(len(points), "surface"),
        points,
        sdf=nothing.astype(float),
        steps=nothing,
        normals=normals,
        normal_noise=noise,
        has_unread_normals=unread,
    )


def _read_pcd(path: Path, normal_noise: float | None) -> PointFile:
    """Return the points of a PCD file as surface points, but those that are not finite."""
    from pypcd4 import PointCloud  # of the extra "files"

    try:
        cloud = PointCloud.from_path(path)
        found = {name: cloud.numpy((name,))[:, 0].astype(np.float64) for name in cloud.fields}
        viewpoint = tuple(cloud.metadata.viewpoint)
    except Exception as error:  # readers of foreign formats raise anything
        raise PointsError(_unreadable(".pcd", error)) from None
    if not set(_PLACE) <= set(found):
        raise PointsError(f"its fields are {', '.join(found)}; accepted: x, y and z among them")
    if viewpoint != _ORIGIN:
        shown = " ".join(f"{number:g}" for number in viewpoint)
        raise PointsError(
            f"its VIEWPOINT is {shown}, and whether its points are in the frame of that sensor is "
            "not said; accepted: points in the world, with VIEWPOINT 0 0 0 1 0 0 0"
        )
    points = np.stack([found[name] for name in _PLACE], axis=1)
    measured = np.isfinite(points).all(axis=1)  # others are pixels without a measurement
    directions = None
    if set(_PCD_NORMAL) <= set(found):
        directions = np.stack([found[name][measured] for name in _PCD_NORMAL], axis=1)
        directions[~np.isfinite(directions).all(axis=1)] = 0.0
    return _surface(points[measured], directions, normal_noise=normal_noise)


def _ply_normals(geometry: Any) -> FloatArray | None:
    """Return the normals (V, 3) that a .ply file states of its vertices; None if it has none."""
    data = geometry.metadata["_ply_raw"]["vertex"]["data"]
    names = data if isinstance(data, dict) else data.dtype.names
    if not set(_NORMAL) <= set(names):
        return None
    return np.stack([np.asarray(data[name], np.float64).reshape(-1) for name in _NORMAL], axis=1)


def _vertices(geometry: Any) -> FloatArray:
    """Return all vertices (V, 3); of those of a mesh's faces, one for each place."""
    import trimesh

    vertices = np.asarray(geometry.vertices, dtype=np.float64).reshape(-1, 3)
    if not isinstance(geometry, trimesh.Trimesh) or not np.isfinite(vertices).all():
        return vertices
    beside = vertices[~geometry.referenced_vertices]
    geometry.process()
    return np.concatenate([np.asarray(geometry.vertices).reshape(-1, 3), beside])


_READERS: dict[str, Callable[[Path, float | None], PointFile]] = {
    ".npz": _read_npz,
    ".csv": _read_csv,
    ".pcd": _read_pcd,
    **dict.fromkeys((".ply", ".off", ".xyz", ".stl"), _read_surface),
}
