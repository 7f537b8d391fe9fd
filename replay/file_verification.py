"""Verifies whole files, in several processes if wanted."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

from chsel.errors import ChselError, RecordingError
from chsel.numerics.threads import threads
from replay.mcap.reader import read_recording
from replay.verification import DIFFERS, EQUAL, Verdict, verify


@dataclass
class FileVerdict:
    """What verifying one file showed; `unusable` says why it could not be done.

    digest: of the recording, "" before format version 3.
    seconds: from reading the file to its last verdict, summed over processes.
    """

    path: Path
    verdicts: list[Verdict] = field(default_factory=list)
    unusable: str = ""
    digest: str = ""
    seconds: float = 0.0

    @property
    def status(self) -> int:
        """0 if all steps are equal, 1 if one differs, 2 if the file cannot be used."""
        if self.unusable:
            return 2
        return int(any(verdict.outcome == DIFFERS for verdict in self.verdicts))

    @property
    def equal(self) -> int:
        """How many steps are equal."""
        return sum(verdict.outcome == EQUAL for verdict in self.verdicts)


def recordings_in(paths: Sequence[str | Path]) -> list[Path]:
    """The files named, and for each folder the recordings in it and below, by name."""
    found: list[Path] = []
    for path in map(Path, paths):
        inside = sorted(path.rglob("*.mcap")) if path.is_dir() else [path]
        if not inside:
            raise RecordingError(f"folder {path} has no recordings; accepted: files *.mcap in it")
        found += inside
    return found


def verified_files(
    paths: Sequence[Path], steps: Sequence[int] | None = None, *, jobs: int = 1
) -> Iterator[FileVerdict]:
    """Verdicts on files, in their order, on as many processes as `jobs`; a thread in each."""
    if jobs == 1:
        for path in paths:
            with threads(1):
                yield _verified_part(path, steps, 0, 1)
        return
    parts = -(-jobs // max(len(paths), 1))
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        waiting: dict[int, list[Future[FileVerdict]]] = defaultdict(list)
        for index, path in enumerate(paths):
            for part in range(parts):
                waiting[index].append(pool.submit(_in_process, path, steps, part, parts))
        for futures in waiting.values():
            yield _joined([future.result() for future in futures])


def _in_process(path: Path, steps: Sequence[int] | None, part: int, parts: int) -> FileVerdict:
    with threads(1):
        return _verified_part(path, steps, part, parts)


def _verified_part(path: Path, steps: Sequence[int] | None, part: int, parts: int) -> FileVerdict:
    """Verdicts on one of several equal parts of the steps."""
    begun, verdict = time.perf_counter(), FileVerdict(path)
    try:
        recording = read_recording(path)
        verdict.digest = recording.digest
        wanted = recording.checked_steps(steps)
        first, last = (len(wanted) * part // parts, len(wanted) * (part + 1) // parts)
        if not any(recording.has_result(step) for step in wanted):
            raise RecordingError(
                f"recording {path} has no registration with a result to verify; accepted: a "
                "recording of at least one"
            )
        verdict.verdicts = list(verify(recording, wanted[first:last]))
    except (ChselError, OSError, MemoryError) as error:
        verdict.unusable = str(error) or f"recording {path} does not fit into memory"
    verdict.seconds = time.perf_counter() - begun
    return verdict


def _joined(parts: Sequence[FileVerdict]) -> FileVerdict:
    verdicts = [verdict for part in parts for verdict in part.verdicts]
    unusable = next((part.unusable for part in parts if part.unusable), "")
    seconds = sum(part.seconds for part in parts)
    return FileVerdict(parts[0].path, verdicts, unusable, parts[0].digest, seconds)
