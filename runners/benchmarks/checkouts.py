"""Two checkouts side by side: the same measurements by the code of each, in turn."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from chsel.errors import ChselError, SettingError
from chsel.numerics.arrays import FloatArray
from runners.published_package.worker_process import WorkerError, WorkerProcess, last_line

ROOT = Path(__file__).resolve().parents[2]
_WORKER = Path(__file__).with_name("checkout_worker.py")
_UNITS = {"ms": 1e3, "s": 1.0, "MB": 1e-6}  # by one second, or by one byte
RATE = "1/min"

Reading = Mapping[str, float]
"""Seconds by "processor" and "wall", or "bytes"."""


class CheckoutError(ChselError):
    """One of the checkouts cannot do a measurement."""


@contextmanager
def checkout(against: str) -> Iterator[Path]:
    """Yield the folder of a checkout: the one named, or a temporary one of a revision."""
    folder = Path(against).expanduser()
    if (folder / "chsel").is_dir():
        yield folder.resolve()
        return
    commit = _git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{against}^{{commit}}")
    if commit is None:
        raise SettingError(
            f"against is {against!r}, which is neither a folder with a checkout nor a revision "
            f"that git knows in {ROOT}; accepted: such as HEAD~1, a tag, or a folder"
        )
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary).resolve() / "checkout"
        if _git("worktree", "add", "--detach", str(folder), commit) is None:
            raise SettingError(f"git cannot check out {against!r} in {folder}")
        try:
            yield folder
        finally:
            _git("worktree", "remove", "--force", str(folder))


def commit_of(folder: Path) -> str:
    """Return the commit of a checkout, and whether files differ from it."""
    return _git("describe", "--always", "--dirty", "--exclude=*", folder=folder) or "no commit"


def _git(*arguments: str, folder: Path = ROOT) -> str | None:
    """Return what a command of git prints, None if it fails or there is no git."""
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=folder, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


@dataclass(frozen=True)
class ComparedRow:
    """One measurement of both checkouts."""

    case: str
    unit: str  # of the numbers
    clock: str  # which of the readings they are
    other: tuple[Reading, ...]  # by the other checkout, in the order of the pairs; may be empty
    this: tuple[Reading, ...]  # by this one; may be empty
    costs: tuple[float, ...] = ()  # of the best pose of a registration: the other's, ours
    missing: str = ""  # why a side has no readings

    def numbers(self, readings: Sequence[Reading]) -> FloatArray:
        """Return readings in the row's unit."""
        taken = np.array([reading[self.clock] for reading in readings])
        return 60.0 / taken if self.unit == RATE else _UNITS[self.unit] * taken

    @property
    def ratios(self) -> FloatArray:
        """Ratios by pair: how many times as fast, or as small, this checkout is."""
        if not (self.other and self.this):
            return np.empty(0)
        ratios = self.numbers(self.other) / self.numbers(self.this)
        return 1.0 / ratios if self.unit == RATE else ratios

    def mapping(self) -> dict[str, Any]:
        """Return the row as the report's file has it."""
        return {**asdict(self), "ratios": self.ratios.tolist()}


@cache
def _core() -> int:
    """Return the core that both processes of a comparison run on, as others may be busier."""
    if not hasattr(os, "sched_getaffinity"):  # macOS
        return 0
    cores = sorted(os.sched_getaffinity(0))
    return cores[os.getpid() % len(cores)]


@dataclass
class Side:
    """One of the two checkouts, with its process."""

    folder: Path
    scratch: Path  # for what its commands write
    worker: WorkerProcess = field(init=False)

    def __post_init__(self) -> None:
        self.scratch.mkdir()
        self.worker = self.start()

    def start(self) -> WorkerProcess:
        """Start a process of this checkout."""
        try:
            worker = WorkerProcess(
                [sys.executable, "-P", str(_WORKER), str(_core())], self.environment
            )
        except WorkerError as error:
            raise CheckoutError(f"the checkout {self.folder} cannot be used: {error}") from None
        if Path(worker.description["chsel"]) != self.folder / "chsel":
            worker.close()
            raise CheckoutError(f"the checkout {self.folder} has no package chsel")
        return worker

    @cached_property
    def environment(self) -> dict[str, str]:
        """Environment of its processes: they have one thread, and import its packages."""
        path = [str(self.folder), *filter(None, [os.environ.get("PYTHONPATH")])]
        threads = {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(path)}
        return {**os.environ, **threads}

    def run(
        self,
        arguments: Sequence[str],
        *,
        folder: Path | None = None,
        variables: Mapping[str, str] | None = None,
    ) -> Reading:
        """Run Python; return what it and its processes took. Raise CheckoutError if it fails.

        folder: to run it in. variables: of its environment.
        """
        begun = time.perf_counter()
        with tempfile.TemporaryFile() as printed:
            process = subprocess.Popen(
                [sys.executable, "-P", *arguments],
                cwd=folder or self.scratch,
                env={**self.environment, **(variables or {})},
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=subprocess.STDOUT,
            )
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            wall = time.perf_counter() - begun
            printed.seek(0)
            if process.returncode:
                raise CheckoutError(last_line(printed.read().decode(errors="replace")))
        return {"processor": usage.ru_utime + usage.ru_stime, "wall": wall}


class Answer(NamedTuple):
    """The outcome of one measurement on one side."""

    parts: Mapping[str, Reading]  # by name; "" is all of it
    poses: Any = None  # of a registration, (B, 4, 4)


def asked(side: Side, task: str, **arguments: Any) -> Answer:
    """Return the answer of a side's process to a task of the worker."""
    answer = side.worker.ask(task, **arguments)
    return Answer(answer["parts"], answer.get("poses"))


def ran(side: Side, command: Sequence[str]) -> Answer:
    """Return the time of a command of Python."""
    return Answer({"": side.run(command)})


class Comparison:
    """Both checkouts, and how often each measurement is taken."""

    def __init__(self, other: Path, scratch: Path, *, repeats: int) -> None:
        """Start a process of each. scratch: a folder for what they read and write."""
        self.scratch = scratch
        self.repeats = repeats
        self.sides = {"other": Side(other, scratch / "other")}
        try:
            self.sides["this"] = Side(ROOT, scratch / "this")
        except CheckoutError:
            self.close()
            raise

    def close(self) -> None:
        """End the processes."""
        for side in self.sides.values():
            side.worker.close()

    def __enter__(self) -> Comparison:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def rows(
        self,
        case: str,
        measure: Callable[[Side], Answer],
        *,
        unit: str = "ms",
        clock: str = "processor",
        seldom: bool = False,
        warm: bool = True,
        cost: Callable[[Any], float] | None = None,
    ) -> Iterator[ComparedRow]:
        """Yield a row for each part of a measurement that both checkouts take in turn.

        In pairs, of which every second begins with this checkout. A part without readings of
        `clock` is shown in bytes, or in seconds of the processor. seldom: a third as many pairs.
        warm: measure once before, which does not count. cost: of the poses of a registration.
        """
        pairs = max(1, self.repeats // 3) if seldom else self.repeats
        answers: dict[str, list[Answer]] = {name: [] for name in self.sides}
        failed: dict[str, str] = {}
        for turn in range(-1 if warm else 0, pairs):
            for name in sorted(self.sides, reverse=turn % 2 == 0):
                if name in failed:
                    continue
                try:
                    answer = measure(self.sides[name])
                except (ChselError, OSError, LookupError) as error:
                    failed[name] = str(error)
                    answers[name].clear()
                else:
                    answers[name] += [answer] if turn >= 0 else []
        costs = [cost(taken[-1].poses) for taken in answers.values() if taken and cost]
        parts = {
            part: reading
            for taken in answers.values()
            for a in taken
            for part, reading in a.parts.items()
        }
        for part, reading in (parts or {"": {clock: 0.0}}).items():
            kind = clock if clock in reading else next(iter(reading))
            readings = {
                name: tuple(a.parts[part] for a in taken if part in a.parts)
                for name, taken in answers.items()
            }
            yield ComparedRow(
                ", ".join(filter(None, [case, part])),
                unit if kind == clock else {"bytes": "MB", "processor": "s"}[kind],
                clock=kind,
                **readings,
                costs=tuple(costs) if len(costs) == len(self.sides) else (),
                missing="; ".join(f"{name}: {why}" for name, why in failed.items()),
            )


@contextmanager
def comparison(against: str, repeats: int) -> Iterator[Comparison]:
    """Yield the comparison with a revision or a folder; all that it makes is removed at the end."""
    with ExitStack() as stack:
        folder = stack.enter_context(checkout(against))
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        yield stack.enter_context(Comparison(folder, scratch, repeats=repeats))
