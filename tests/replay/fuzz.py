"""`python -m tests.replay.fuzz --cases N --seed S`: changed recordings, and what reading them does.

Every case must end in one clear RecordingError, in a reading equal to the original, or in a verdict
that is right: "equal" only if registering the problem that was read gives the result that was read.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import re
import resource
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from chsel.errors import ChselError, RecordingError
from replay.comparing.recording_diff import recording_diff
from replay.events import Event, HypothesesFound, ProblemPosed, SessionStarted
from replay.mcap.reader import Recording, read_recording
from replay.recording_info import recording_info
from replay.registration import recorded_method
from replay.verification import DIFFERS, EQUAL, Verdict, verify
from tests.replay.conftest import same_bits
from tests.replay.mutations import LAYERS, Random, file_of, meaning, split
from tests.replay.seals import resealed
from tests.replay.small_recordings import (
    METHODS,
    registered_session,
    robot_session,
    write_recording,
)

MEANING = "meaning"
SHARES = {"raw": 0.2, "records": 0.2, "messages": 0.25, "tampered": 0.1, MEANING: 0.25}
RESEALED = {"records": 0.5, "messages": 1.0}  # how often the seals of a changed file are right
HANGS_AFTER = 60.0  # seconds of one case: the process ends with a traceback
_WARM = 200  # cases after which memory should grow no more


class WrongOutcome(Exception):
    """A case ended in another way than it may."""


@dataclass
class Original:
    """A recording that is whole: its bytes and its events."""

    name: str
    data: bytes
    events: list[Event]


@dataclass
class Tally:
    """What the cases came to."""

    outcomes: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)
    slowest: float = 0.0
    slowest_case: int = -1


def originals(folder: Path) -> list[Original]:
    """A small recording of each method, and one of a robot with sensors."""
    sessions = {name: registered_session(name) for name in METHODS}
    sessions["sensors"] = robot_session("gradient_descent")
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
    seconds = time.perf_counter() - begun
    tally.outcomes[f"{layer}: {outcome}"] += 1
    if seconds > tally.slowest:
        tally.slowest, tally.slowest_case = seconds, index


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
        if found.is_equal and outcome not in ("the same", "refused"):
            raise WrongOutcome("diff finds no difference to the original, but reading does")


def _check_verdict(
    verdict: Verdict, recording: Recording, events: Sequence[Event], original: Original
) -> None:
    """Whether registering anew, apart from `verify`, says the same."""
    step = verdict.step
    if verdict.outcome == EQUAL:
        method = recorded_method(recording).method
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


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Without the warnings that absurd numbers cause."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        yield


def peak_memory() -> float:
    """Most megabytes that this process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main(arguments: Sequence[str] | None = None) -> int:
    """Run cases, and print what they came to; 1 if any ended otherwise than it may."""
    parser = argparse.ArgumentParser(prog="tests.replay.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="index of the first case")
    parser.add_argument("--keep", type=Path, help="folder for files of cases that went wrong")
    given = parser.parse_args(arguments)
    tally, wrong = Tally(), 0
    with tempfile.TemporaryDirectory() as name, quiet():
        folder = Path(name)
        whole = originals(folder)
        before = 0.0
        begun = time.perf_counter()
        for index in range(given.first, given.first + given.cases):
            faulthandler.dump_traceback_later(HANGS_AFTER, exit=True, file=sys.__stderr__)
            try:
                run_case(index, given.seed, whole, folder, tally)
            except Exception as error:
                wrong += 1
                where = traceback.extract_tb(error.__traceback__)[-1]
                place = f"{Path(where.filename).name}:{where.lineno}"
                print(f"case {index}: {type(error).__name__}: {error} ({place})"[:500], flush=True)
                _keep(folder, given.keep, index)
            done = index - given.first + 1
            if done == min(_WARM, given.cases):
                before = peak_memory()
            if done % 1000 == 0 and sys.stderr.isatty():
                print(f"\r{done} of {given.cases} cases", end="", file=sys.stderr)
        faulthandler.cancel_dump_traceback_later()
        seconds = time.perf_counter() - begun
    _print_table(tally, given.cases, seconds, wrong, peak_memory() - before)
    return 1 if wrong else 0


def _keep(folder: Path, kept: Path | None, index: int) -> None:
    case = folder / "case.mcap"
    if kept is not None and case.exists():
        kept.mkdir(parents=True, exist_ok=True)
        (kept / f"{index}.mcap").write_bytes(case.read_bytes())


def _print_table(tally: Tally, cases: int, seconds: float, wrong: int, grown: float) -> None:
    print(f"\n{cases} cases in {seconds:.0f} s, {cases / seconds:.0f} a second; {wrong} wrong")
    print(f"slowest: case {tally.slowest_case}, {tally.slowest:.2f} s")
    print(f"memory: {peak_memory():.0f} MB at most, {grown:.0f} MB more than after {_WARM} cases")
    for title, counts in (("outcomes", tally.outcomes), ("errors", tally.errors)):
        print(f"\n{title}")
        for text, count in counts.most_common(60):
            print(f"{count:8}  {text}")


if __name__ == "__main__":
    sys.exit(main())
