"""Worker processes of which each is known by what it does, and may die."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any

from runners.evaluation.plan import Plan, Task
from runners.evaluation.work import ONE_THREAD, Outcome, work

Job = Callable[[Connection, Plan], None]
_SPAWN = multiprocessing.get_context("spawn")
_PATIENCE = 5.0  # seconds in which a process that has closed its connection ends


@dataclass(eq=False)
class Worker:
    """A process, and the unit that it does at present."""

    process: Any
    connection: Connection
    unit: Task | None = None


@dataclass(frozen=True)
class Died:
    """A worker ended in the middle of a unit; code: its exit code, negative for a signal."""

    code: int | None


@dataclass
class Pool:
    """So many workers, each started when it gets its first unit. job: what they run."""

    plan: Plan
    size: int
    job: Job = work
    _workers: list[Worker] = field(default_factory=list)

    @property
    def running(self) -> list[Task]:
        """The units that are being done."""
        return [worker.unit for worker in self._workers if worker.unit is not None]

    @property
    def free(self) -> bool:
        """Whether another unit can be given."""
        return len(self.running) < self.size

    def give(self, unit: Task) -> None:
        """Let a worker do a unit."""
        idle = [worker for worker in self._workers if worker.unit is None]
        worker = idle[0] if idle else self._start()
        worker.unit = unit
        try:
            worker.connection.send(unit)
        except OSError:  # it has died; `ended` tells
            return

    def ended(self, seconds: float) -> Iterator[tuple[Task, Outcome | Died]]:
        """What has ended, after at most so many seconds of waiting for any."""
        busy = [worker for worker in self._workers if worker.unit is not None]
        ready = wait([worker.connection for worker in busy], seconds)
        for worker in busy:
            if worker.connection not in ready:
                continue
            unit, worker.unit = worker.unit, None
            assert unit is not None
            try:
                outcome = worker.connection.recv()
            except (EOFError, OSError):
                worker.process.join(_PATIENCE)
                outcome = Died(worker.process.exitcode)
                self._remove(worker)
            yield unit, outcome

    def close(self) -> None:
        """End all workers at once, whatever they do."""
        for worker in list(self._workers):
            self._remove(worker)

    def _start(self) -> Worker:
        ours, theirs = _SPAWN.Pipe()
        # Daemons: they end with this process, whatever becomes of it.
        process = _SPAWN.Process(target=self.job, args=(theirs, self.plan), daemon=True)
        os.environ.update(ONE_THREAD)
        process.start()
        theirs.close()
        worker = Worker(process, ours)
        self._workers.append(worker)
        return worker

    def _remove(self, worker: Worker) -> None:
        self._workers.remove(worker)
        worker.process.kill()
        worker.process.join()
        worker.connection.close()
