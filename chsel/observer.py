"""Who may watch a registration. Watching changes no bit of its result."""

from __future__ import annotations

from typing import Protocol

from chsel.arrays import FloatArray
from chsel.problem import ArchiveSnapshot


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
