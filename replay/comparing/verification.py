"""Whether the code as it stands gives the recorded bits, and if not, where it first differs."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from chsel.errors import ChselError, RecordingError
from chsel.numerics.threads import threads
from replay.comparing.differences import result_differences
from replay.comparing.recomputation import Recomputed, recomputed, result_in
from replay.environment import environment_differences
from replay.mcap.reader import Recording, read_recording

EQUAL = "equal"
DIFFERS = "differs"
NO_RESULT = "no result"


@dataclass(frozen=True)
class Verdict:
    """How a recorded registration or decision compares with the one computed now."""

    step: int  # of the registration, or that the decision follows
    name: str  # of the method or policy
    is_decision: bool  # else a registration
    outcome: str  # "equal", "differs", or "no result" where the recorded registration did not end
    stage: str = ""  # the first that differs
    before: int = 0  # how many recorded stages before it are equal
    differences: tuple[str, ...] = ()  # of the recorded numbers, line by line
    largest_ulps: int = 0  # over all of them
    environment: tuple[str, ...] = ()  # what of it is not as recorded

    @classmethod
    def of(cls, found: Recomputed, environment: tuple[str, ...]) -> Verdict:
        """Return the verdict on what was recomputed."""
        about = cls(found.step, found.name, is_decision=found.is_decision, outcome=EQUAL)
        has_no_result = not found.is_decision and result_in(found.recorded) is None
        if found.recorded and has_no_result:
            return replace(about, outcome=NO_RESULT)
        compared = result_differences(found.recorded, found.computed)
        if not compared.stage:
            return replace(about, before=compared.before)
        ended = [f"now it ends: {found.failure}"] if found.failure else []
        return replace(
            about,
            outcome=DIFFERS,
            stage=compared.stage,
            before=compared.before,
            differences=(*compared.lines, *ended),
            largest_ulps=compared.largest_ulps,
            environment=environment,
        )

    @property
    def label(self) -> str:
        """Subject of the verdict: "step 3, chsel", or "decision after step 3, information"."""
        return f"{'decision after ' * self.is_decision}step {self.step}, {self.name}"

    def report(self) -> str:
        """Return the verdict for people; several lines if it is "differs"."""
        if self.outcome != DIFFERS:
            return f"{self.label}: {self.outcome}"
        stages = "values" if self.is_decision else "stages"
        lines = [
            f"{self.label}: differs",
            f"first difference: {self.stage} ({self.before} recorded {stages} before it are equal)",
            *self.differences,
            f"largest difference: {self.largest_ulps} ulp",
            "environment: " + ("; ".join(self.environment) or "the same as recorded"),
        ]
        return "\n  ".join(lines)


def verify(recording: Recording, steps: Sequence[int] | None = None) -> Iterator[Verdict]:
    """Yield verdicts on steps of a recording, in their order: on registrations and decisions.

    steps: None for all that pose a problem or are followed by a decision. The belief of a decision
    is compared where the registration before it is run again. Raises RecordingError if the
    recording does not have the settings of its method or policy, or lacks a step.
    """
    decided = set(recording.decision_steps)
    recording.checked_steps([step for step in steps or () if step not in decided])
    environment = environment_differences(recording.start)
    for event in recomputed(recording, steps):
        if isinstance(event, Recomputed):
            yield Verdict.of(event, environment)


@dataclass
class FileVerdict:
    """The verdicts on one file."""

    path: Path
    verdicts: list[Verdict] = field(default_factory=list)  # in the order of the recording
    unusable: str = ""  # why the file could not be verified
    digest: str = ""  # of the file
    seconds: float = 0.0  # from reading the file to its last verdict

    @property
    def status(self) -> int:
        """0 if all steps are equal, 1 if one differs, 2 if the file cannot be used."""
        if self.unusable:
            return 2
        return int(any(verdict.outcome == DIFFERS for verdict in self.verdicts))

    def compared(self, *, decisions: bool) -> list[Verdict]:
        """Return the verdicts on registrations with a result, or on decisions."""
        asked = [verdict for verdict in self.verdicts if verdict.is_decision == decisions]
        return [verdict for verdict in asked if verdict.outcome != NO_RESULT]


def recordings_in(paths: Sequence[str | Path]) -> list[Path]:
    """Return the files named, and for each folder the recordings in it and below, by name."""
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
    """Yield verdicts on files, in their order, on `jobs` processes of a thread each."""
    verified = partial(_verified, steps=steps)
    if jobs == 1:
        yield from map(verified, paths)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(verified, paths)


def _verified(path: Path, steps: Sequence[int] | None) -> FileVerdict:
    begun = time.perf_counter()
    file = FileVerdict(path)
    try:
        recording = read_recording(path)
        file.digest = recording.digest
        with threads(1):
            file.verdicts = list(verify(recording, steps))
        if all(verdict.outcome == NO_RESULT for verdict in file.verdicts):
            raise RecordingError(
                f"recording {path} has no registration with a result to verify; accepted: a "
                "recording of at least one"
            )
    except (ChselError, OSError, MemoryError) as error:
        file.unusable = str(error) or f"recording {path} does not fit into memory"
    file.seconds = time.perf_counter() - begun
    return file
