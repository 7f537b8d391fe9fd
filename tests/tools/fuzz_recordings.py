"""`python -m tests.tools.fuzz_recordings --cases N --seed S`: changed recordings, and reading them.

Every case must end in one clear RecordingError, in a reading equal to the original, or in a verdict
that is right: "equal" only if registering the problem that was read gives the result that was read.
"""

from __future__ import annotations

import contextlib
import re
import struct
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chsel.errors import ChselError, RecordingError
from replay.comparing.choices import recorded_method, recorded_policy
from replay.comparing.recording_diff import recording_diff
from replay.comparing.verification import DIFFERS, EQUAL, Verdict, verify
from replay.content.recording_info import recording_info
from replay.events import Event, HypothesesFound, ProblemPosed, SessionStarted
from replay.mcap.reader import Recording, read_recording
from tests.replay.conftest import same_bits
from tests.tools.fuzzing import Tally, WrongOutcome, run_cases
from tests.tools.mutations import LAYERS, Random, file_of, meaning, split
from tests.tools.seals import resealed
from tests.tools.small_recordings import (
    METHODS,
    registered_session,
    robot_session,
    steered_session,
    write_recording,
)

MEANING = "meaning"
SHARES = {"raw": 0.2, "records": 0.2, "messages": 0.25, "tampered": 0.1, MEANING: 0.25}
RESEALED = {"records": 0.5, "messages": 1.0}  # how often the seals of a changed file are right
HANGS_AFTER = 60.0  # seconds of one case: the process ends with a traceback


@dataclass
class Original:
    """A recording that is whole: its bytes and its events."""

    name: str
    data: bytes
    events: list[Event]


def originals(folder: Path) -> list[Original]:
    """A small recording of each method, one of a robot with sensors, and one that is steered."""
    sessions = {name: registered_session(name) for name in METHODS}
    sessions["sensors"] = robot_session("gradient_descent")
    sessions["steered"] = steered_session()
    made = []
    for name, events in sessions.items():
        data = write_recording(folder / f"{name}.mcap", events)
        made.append(Original(name, data, [*read_recording(folder / f"{name}.mcap").events()]))
    return made


def run_case(index: int, seed: int, whole: Sequence[Original], folder: Path, tally: Tally) -> None:
    """Make one case and judge it; raises WrongOutcome, or what should not have been raised."""
    random = np.random.default_rng([seed, index])
    original = whole[int(random.integers(len(whole)))]
    layer = str(random.choice(list(SHARES), p=list(SHARES.values())))
    path = folder / "case.mcap"
    path.unlink(missing_ok=True)
    begun = time.perf_counter()
    data = changed(original, layer, path, random)
    if data is None:
        outcome = "no such values"
    else:
        path.write_bytes(data)
        outcome = judge(path, original, tally)
        if layer == "tampered" and outcome != "refused":
            raise WrongOutcome(f"a message that is not the one written is read: {outcome}")
        if index % 3 == 0:
            judge_partial(path, original, prefix=layer in ("raw", "records"))
        elif index % 3 == 1:
            ask(path, folder / f"{original.name}.mcap", outcome)
    tally.outcomes[f"{layer}: {outcome}"] += 1
    tally.timed(index, time.perf_counter() - begun)


def changed(original: Original, layer: str, path: Path, random: Random) -> bytes | None:
    """The bytes of a changed recording, None if the change cannot be made."""
    if layer == MEANING:
        return meaning(original.events, path, random)
    data = LAYERS[layer](original.data, random)
    if data is not None and random.random() < RESEALED.get(layer, 0.0):
        with contextlib.suppress(ValueError, struct.error):  # no records any more
            data = file_of(resealed(split(data[8:-8])))
    return data


def judge(path: Path, original: Original, tally: Tally) -> str:
    """What reading and verifying a file comes to."""
    try:
        recording = read_recording(path)
        events = list(recording.events())
    except RecordingError as error:
        _count(error, path, tally)
        return "refused"
    if _same(events, original.events):
        return "the same"
    try:
        verdicts = list(verify(recording))
    except RecordingError as error:
        _count(error, path, tally)
        return "refused by verify"
    except ChselError:  # of a step whose sets do not follow from the step before
        return "refused by verify"
    for verdict in verdicts:
        _check_verdict(verdict, recording, events, original)
    if not verdicts:
        return "nothing to verify"
    return " and ".join(sorted({verdict.outcome for verdict in verdicts}))


def judge_partial(path: Path, original: Original, *, prefix: bool) -> None:
    """Read what is whole; of a file whose content is not changed, that begins as it did."""
    try:
        events = list(read_recording(path, partial=True).events())
    except RecordingError as error:
        _check_message(error, path)
        return
    if prefix and not _same(events, original.events[: len(events)]):
        raise WrongOutcome("partial reading gives events that are not those of the original")


def ask(path: Path, whole: Path, outcome: str) -> None:
    """What the other commands say of a file: one clear error, or an answer."""
    for question in (lambda: recording_info(path), lambda: recording_info(path, check=True)):
        try:
            question()
        except RecordingError as error:
            _check_message(error, path)
    try:
        found = recording_diff(path, whole)
    except RecordingError as error:
        _check_message(error, path)
    else:
        if not found.differences and outcome not in ("the same", "refused"):
            raise WrongOutcome("diff finds no difference to the original, but reading does")


def _check_verdict(
    verdict: Verdict, recording: Recording, events: Sequence[Event], original: Original
) -> None:
    """Whether registering or deciding anew, apart from `verify`, says the same."""
    step = verdict.step
    if verdict.is_decision:
        decided, policy = recording.decision(step), recorded_policy(recording).build()
        if verdict.outcome == EQUAL and policy.decide(decided.problem).digest != (
            decided.decision.digest
        ):
            raise WrongOutcome(f'the decision of step {step} is "equal", but today has other bits')
        return
    if verdict.outcome == EQUAL:
        method = recorded_method(recording).build()
        if method.register(recording.problem(step)).digest != recording.hypotheses(step).digest:
            raise WrongOutcome(f'step {step} is "equal", but a registration gives other bits')
    here, there = _of_step(events, step), _of_step(original.events, step)
    if here.problem is None or there.problem is None or here.found is None or there.found is None:
        return
    alike = here.problem.digest == there.problem.digest and here.method == there.method
    if alike and verdict.outcome == EQUAL and not same_bits(here.found, there.found):
        raise WrongOutcome(f'step {step} is "equal", but its result is not the original\'s')
    if alike and verdict.outcome == DIFFERS and _same(events, original.events):
        raise WrongOutcome(f'step {step} "differs", but all of it is the original\'s')


@dataclass
class _Step:
    problem: object = None
    found: object = None
    method: object = None


def _of_step(events: Sequence[Event], step: int) -> _Step:
    """Problem and result of a step, and the method's settings."""
    of = _Step()
    for event in events:
        if isinstance(event, SessionStarted):
            of.method = event.config.get("method")
        elif isinstance(event, ProblemPosed) and event.step == step:
            of.problem = event.problem
        elif isinstance(event, HypothesesFound) and event.step == step:
            of.found = event.hypotheses
    return of


def _same(events: Sequence[Event], others: Sequence[Event]) -> bool:
    return len(events) == len(others) and all(map(same_bits, events, others))


def _count(error: RecordingError, path: Path, tally: Tally) -> None:
    _check_message(error, path)
    text = str(error).replace(str(path), "").removeprefix("recording : ").removeprefix("recording ")
    tally.errors[re.sub(r"'[^']*'|[0-9a-f]{32}|-?\d[\d.e+-]*", "#", text)[:70]] += 1


def _check_message(error: RecordingError, path: Path) -> None:
    text = str(error)
    if "\n" in text or str(path) not in text or len(text) > 3000:
        raise WrongOutcome(f"an error is not one line that names the file: {text!r}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run cases, and print what they came to; 1 if any ended otherwise than it may."""

    def prepare(folder: Path, tally: Tally) -> Callable[[int, int], None]:
        whole = originals(folder)
        return lambda index, seed: run_case(index, seed, whole, folder, tally)

    return run_cases(__doc__, arguments, prepare, cases=10_000, hangs_after=HANGS_AFTER)


if __name__ == "__main__":
    sys.exit(main())
