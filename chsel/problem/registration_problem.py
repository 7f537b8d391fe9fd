"""Who may watch a registration. Watching changes no bit of its result."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from chsel.errors import PoseError, SettingError, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, digest, frozen
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import check_rigid
from chsel.problem.sdf_grid import COARSEST, FINEST, SdfGrid
from chsel.problem.streams import StreamKey


@dataclass(frozen=True, eq=False)
class RegistrationProblem:
    """Everything that determines the outcome of one registration, and nothing else.

    sdf: signed distance grid of the object, in its frame.
    points: the known points, in the world.
    initial_set: E_0 (B, 4, 4), object_from_world.
    low_cost_set: E_l (L, 4, 4), object_from_world; may be empty.
    workspace: where the object can be.
    free_resolution: side in metres of the voxels into which free points were merged.
    key: of the random streams.
    """

    sdf: SdfGrid
    points: KnownPoints
    initial_set: FloatArray
    workspace: Workspace
    free_resolution: float
    key: StreamKey
    low_cost_set: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))

    def __post_init__(self) -> None:
        require_positive("free_resolution", self.free_resolution)
        if not FINEST <= self.free_resolution <= COARSEST:
            raise SettingError(
                f"free_resolution is {self.free_resolution}; "
                f"accepted: {FINEST:g} to {COARSEST:g} (m)"
            )
        for name in ("initial_set", "low_cost_set"):
            poses = frozen(name, getattr(self, name), (None, 4, 4), error=PoseError)
            check_rigid(name, poses)
            object.__setattr__(self, name, poses)
        if len(self.initial_set) == 0:
            raise PoseError("initial_set is empty; accepted: at least one pose")
        if self.points.count == 0:
            raise SettingError("there is no known point; accepted: at least one of any class")

    @cached_property
    def digest(self) -> str:
        """Digest of the whole problem."""
        parts = [self.sdf.digest, self.points.digest, digest(self.initial_set, self.low_cost_set)]
        numbers = np.array([*self.workspace.lower, *self.workspace.upper, self.free_resolution])
        key = np.array([self.key.seed, self.key.step], dtype=np.uint64)
        text = np.frombuffer("".join(parts).encode(), dtype=np.uint8)
        return digest(text, numbers, key)


@dataclass(frozen=True, eq=False)
class ArchiveSnapshot:
    """The occupied cells of a quality-diversity archive at one moment.

    shape (k,): cells per measure. lower, upper (k,): the range of each measure.
    cells (C,): index of each occupied cell, row-major, last measure fastest.
    solutions (C, d): raw search vectors. objectives (C,): minus the cost. measures (C, k).
    measure_names (k,): what the axes are, with units. iteration: quality-diversity iterations done.
    """

    iteration: int
    refinement: int
    measure_names: tuple[str, ...]
    shape: tuple[int, ...]
    lower: FloatArray
    upper: FloatArray
    cells: IntArray
    solutions: FloatArray
    objectives: FloatArray
    measures: FloatArray

    @property
    def coverage(self) -> float:
        """Fraction of the cells that are occupied."""
        return len(self.cells) / int(np.prod(self.shape))

    @property
    def qd_score(self) -> float:
        """Sum over occupied cells of (objective + 100), per cell of the archive."""
        return float((self.objectives + 100.0).sum() / np.prod(self.shape))

    @cached_property
    def digest(self) -> str:
        """Digest of the snapshot."""
        return digest(self.cells, self.solutions, self.objectives, self.measures)


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """The result of one registration: B poses, best first.

    object_from_world (B, 4, 4). cost (B,): the relaxed cost of exactly these poses, ascending.
    duplicate (B,): True for a pose that repeats an earlier one. cell (B,): the archive cell that
    it came from, -1 for none. elites (L, 4, 4): object_from_world of all solutions kept, from
    which the next E_l follows. archive: the last snapshot, if the method keeps an archive.
    """

    object_from_world: FloatArray
    cost: FloatArray
    duplicate: BoolArray
    cell: IntArray
    elites: FloatArray
    archive: ArchiveSnapshot | None = None

    @property
    def distinct(self) -> int:
        """How many of the poses are not repetitions."""
        return int((~self.duplicate).sum())

    @cached_property
    def digest(self) -> str:
        """Digest of poses, costs, flags and elites."""
        parts = (self.object_from_world, self.cost, self.duplicate, self.cell, self.elites)
        return digest(*parts)


class Observer(Protocol):
    """Receives what happens within a registration; the arrays it gets are not its own to change."""

    snapshot_interval: int
    """Quality-diversity iterations between archive snapshots; 0 for the first and last alone."""

    def progress(self, stage: str, iteration: int, total: int) -> None:
        """A stage has finished `iteration` of `total` iterations."""

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        """State of a stage at its start and after blocks of iterations: vectors, costs (B,).

        vectors (B, d): of the search; of a quality-diversity search, all that its archive holds.
        """

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        """The archive at this moment."""


class NullObserver:
    """Watches nothing."""

    snapshot_interval = 0

    def progress(self, stage: str, iteration: int, total: int) -> None:
        """Ignore it."""

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        """Ignore it."""

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        """Ignore it."""
