"""Runs cases by the thousand: what each came to, and which went wrong."""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

_WARM = 200  # cases after which memory should grow no more


class WrongOutcome(Exception):
    """A case ended in another way than it may."""


@dataclass
class Tally:
    """What the cases came to."""

    outcomes: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)
    slowest: float = 0.0  # seconds
    slowest_case: int = -1
    memory: float = 0.0  # MB that the process had held after the first case

    def timed(self, index: int, seconds: float) -> None:
        """Note how long a case took."""
        if seconds > self.slowest:
            self.slowest, self.slowest_case = seconds, index


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Without the warnings that absurd numbers cause."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        yield


def peak_memory() -> float:
    """Most megabytes that this process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def run_cases(
    description: str | None,
    arguments: Sequence[str] | None,
    prepare: Callable[[Path, Tally], Callable[[int, int], None]],
    *,
    cases: int,
    hangs_after: float,
) -> int:
    """Run cases, and print what they came to; 1 if any ended otherwise than it may.

    description: a tool's own. prepare: of a folder to write in, makes what runs the case of an
    index and a seed, by way of the file case.mcap in it. cases: how many, unless the command line
    says. hangs_after: seconds of one case, at which the process ends with a traceback.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--cases", type=int, default=cases)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="index of the first case")
    parser.add_argument("--keep", type=Path, help="folder for files of cases that went wrong")
    given = parser.parse_args(arguments)
    tally, wrong, before = Tally(), 0, 0.0
    with tempfile.TemporaryDirectory() as name, quiet():
        folder = Path(name)
        run_case = prepare(folder, tally)
        begun = time.perf_counter()
        for index in range(given.first, given.first + given.cases):
            faulthandler.dump_traceback_later(hangs_after, exit=True, file=sys.__stderr__)
            try:
                run_case(index, given.seed)
            except Exception as error:
                wrong += 1
                where = traceback.extract_tb(error.__traceback__)[-1]
                place = f"{Path(where.filename).name}:{where.lineno}"
                print(f"case {index}: {type(error).__name__}: {error} ({place})"[:500], flush=True)
                _keep(folder / "case.mcap", given.keep, index)
            done = index - given.first + 1
            if done == min(_WARM, given.cases):
                before = peak_memory()
            if done % 1000 == 0 and sys.stderr.isatty():
                print(f"\r{done} of {given.cases} cases", end="", file=sys.stderr)
        faulthandler.cancel_dump_traceback_later()
        seconds = time.perf_counter() - begun
    _print_table(tally, given.cases, seconds, wrong, peak_memory() - before)
    return 1 if wrong else 0


def _keep(case: Path, kept: Path | None, index: int) -> None:
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
