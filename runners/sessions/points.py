"""A session whose known points come from a file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from chsel.errors import PointsError, SettingError, require_positive
from chsel.problem.defaults import FREE_RESOLUTION, workspace_around
from chsel.problem.points import FreeVoxels, KnownPoints, Lattice, Workspace, check_points
from chsel.problem.sdf_grid import OBJECT_PADDING
from replay.events import Probe
from runners.objects.loader import ObjectModel
from runners.sessions.point_files import read_points
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
