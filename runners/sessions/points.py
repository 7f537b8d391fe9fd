"""A source whose known points come from a file."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import (
    ChselError,
    PointsError,
    PointsWarning,
    PoseError,
    SettingError,
    require_positive,
)
from chsel.events import Probe, Start
from chsel.numerics.arrays import FloatArray, IntArray, frozen, read_npz, refuse_special_file
from chsel.problem.points import (
    FREE_RESOLUTION,
    POINT_CLASSES,
    KnownPoints,
    Workspace,
    check_places,
    check_points,
    check_workspace,
    distinct_points,
    same_place,
    workspace_around,
    world_points,
)
from chsel.problem.pose_prior import prior_from_settings
from chsel.problem.poses import nearest_rigid
from chsel.problem.sdf_grid import OBJECT_PADDING
from chsel.problem.streams import LAST_STEP
from runners.objects.loader import ObjectModel
from runners.sessions.source import ObjectOrigin, ProbeSource, SourceKind


@dataclass(frozen=True)
class PointsSettings:
    """A file of known points.

    With the defaults, `chsel.register` has the same bits, but for objects of the paper's trials at
    their size there, see `ObjectModel.resolution`.
    """

    path: str | None = None  # .npz, .csv, .ply, .off, .xyz or .stl
    workspace: tuple[tuple[float, float], ...] | None = None
    """[[x0, x1], [y0, y1], [z0, z1]], metres; None: around the points, padded by the diameter."""
    free_resolution: float = FREE_RESOLUTION  # voxel side of free space, metres
    object_resolution: float | None = None
    """Spacing of the SDF grid, metres; None: by the object, see `ObjectModel.resolution`."""
    object_padding: float = OBJECT_PADDING  # of the SDF grid, metres
    prior: Any = None  # fields of `chsel.PosePrior`; None: nothing is known of the pose
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
        prior_from_settings("prior", self.prior)


class PointsSource(ProbeSource):
    """Replays the steps of a file; a probe's index is the file's step; see `ProbeSource`.

    Raises PointsError for points that cannot be those of the object.
    """

    def __init__(self, settings: PointsSettings, object_model: ObjectModel) -> None:
        assert settings.path is not None
        self._file = read_points(settings.path)
        self._steps = np.unique(self._file.steps).tolist()
        self.free_resolution = settings.free_resolution
        self.world_from_object = self._file.world_from_object
        self.prior = prior_from_settings("session.prior", settings.prior)
        self.initial_points = KnownPoints()
        self.count = len(self._steps)
        self.start = Start(contacts=settings.start_contacts, step=settings.start_probe)
        self.warnings: list[PointsWarning] = []
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

    def probes(self) -> Iterator[Probe]:
        """Yield one probe per step of the file."""
        for step, points in zip(self._steps, self._points, strict=True):
            contacts = self._file.at(step).contacts
            yield Probe(
                step, "points", new_points=points, contacts=contacts, contact_normals=0.0 * contacts
            )

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
_COLUMNS = ["x", "y", "z", "kind", "sdf", "step"]
_ACCEPTED = "x, y, z[, kind[, sdf]][, step], commas between them, decimal points in numbers"


@dataclass(frozen=True, eq=False)
class PointFile:
    """The points of a file in its order, each with its kind, signed distance and step."""

    kinds: np.ndarray  # (N,), of KINDS
    points: FloatArray  # (N, 3), world, metres
    sdf: FloatArray  # (N,), metres; that of known points alone counts
    steps: IntArray  # (N,): at which each becomes known
    world_from_object: FloatArray | None = None  # (4, 4): the true pose, where it is given

    def at(self, step: int) -> KnownPoints:
        """Return all that becomes known at a step; surface points have distance 0."""
        surface, free, occupied, known = (
            np.flatnonzero((self.kinds == kind) & (self.steps == step)) for kind in KINDS
        )
        known = np.concatenate([surface, known])
        points = self.points
        return KnownPoints(
            points[free], points[occupied], known=points[known], known_sdf=self.sdf[known]
        )


def read_points(path: str | Path) -> PointFile:
    """Read .npz, .csv, or the vertices of .ply, .off, .xyz and .stl as surface points.

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
        content = reader(path)
        if len(content.points) == 0:
            raise PointsError("it holds no points; accepted: at least one")
        world_points("points", content.points)  # raises for what is far beyond a robot's reach
        first, last = content.steps.min(), content.steps.max()
        if first < 0 or last > LAST_STEP:
            raise PointsError(f"steps are from {first} to {last}; accepted: 0 to {LAST_STEP}")
    except ChselError as error:
        raise PointsError(f"point file {path}: {error}") from None
    return content


def _read_npz(path: Path) -> PointFile:
    accepted = [*KINDS, "known_sdf", *(f"{kind}_step" for kind in KINDS), "world_from_object"]
    arrays = read_npz(path, accepted=accepted, error=PointsError)
    given = [kind for kind in KINDS if kind in arrays]
    if not given:
        raise PointsError(f"no array of points; accepted: at least one of {', '.join(KINDS)}")
    if ("known" in arrays) != ("known_sdf" in arrays):
        raise PointsError("known and known_sdf stand only together")
    pose = arrays.get("world_from_object")
    if pose is not None:
        pose = frozen("world_from_object", pose, shape=(4, 4), error=PoseError)
        pose = nearest_rigid("world_from_object", pose[None])[0]
    parts = [_npz_part(kind, arrays) for kind in given]
    kinds, points, sdf, steps = (np.concatenate(column) for column in zip(*parts, strict=True))
    return PointFile(kinds, points, sdf=sdf, steps=steps, world_from_object=pose)


def _npz_part(kind: str, arrays: dict[str, Any]) -> tuple[np.ndarray, ...]:
    """Return kinds, points, signed distances and steps of one array of points."""
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
    return np.full(len(points), kind), points, sdf, steps.astype(np.int64)


def _read_csv(path: Path) -> PointFile:
    import pandas as pd

    try:
        with warnings.catch_warnings(action="error", category=pd.errors.ParserWarning):
            table = pd.read_csv(path, dtype=object, skipinitialspace=True, index_col=False)
    except (ValueError, pd.errors.ParserWarning) as error:
        raise PointsError(_wrong_length(path) or _unreadable(".csv", error)) from None
    table.columns = table.columns.str.strip()
    with_kind = "kind" in table
    if not set("xyz") <= set(table) <= set(_COLUMNS) or ("sdf" in table and not with_kind):
        raise PointsError(f"its columns are {', '.join(table.columns)}; accepted: {_ACCEPTED}")
    if not with_kind:
        table["kind"] = "surface"
    table = table.reindex(columns=_COLUMNS)
    kinds = table.pop("kind").astype(str).str.strip().to_numpy()
    known = kinds == "known"
    given = table["sdf"].notna().to_numpy()
    table = table.fillna({"sdf": 0.0, "step": 0.0})
    try:
        numbers = table.to_numpy(float)
    except ValueError:
        raise PointsError(_not_a_number(table)) from None
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
    return PointFile(kinds, points, sdf=sdf, steps=steps.astype(np.int64))


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


def _read_surface(path: Path) -> PointFile:
    """Return every vertex of a mesh or point cloud as a surface point, each place once."""
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    try:
        loaded = trimesh.load(str(path), file_type=kind, process=False)
        geometries = list(getattr(loaded, "geometry", {"": loaded}).values())
        vertices = np.concatenate([_vertices(geometry) for geometry in geometries])
    except Exception as error:  # readers of foreign formats raise anything
        raise PointsError(_unreadable(f".{kind}", error)) from None
    points = frozen("surface", vertices, shape=(None, 3))
    nothing = np.zeros(len(points), dtype=np.int64)
    return PointFile(
        np.full(len(points), "surface"), points, sdf=nothing.astype(float), steps=nothing
    )


def _vertices(geometry: Any) -> FloatArray:
    """Return all vertices (V, 3); of those of a mesh's faces, one for each place."""
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
    **dict.fromkeys((".ply", ".off", ".xyz", ".stl"), _read_surface),
}
