"""Cases run by hand, thousands at a time: what each came to, and which went wrong."""

from __future__ import annotations

import argparse
import faulthandler
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.replay.fuzz import peak_memory


@dataclass
class Tally:
    """What the cases came to. memory: MB that the process had held after the first."""

    outcomes: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)
    slowest: float = 0.0
    slowest_case: int = -1
    memory: float = 0.0


def run_cases(
    program: str,
    arguments: Sequence[str] | None,
    prepare: Callable[[Path, Tally], Callable[[int, int], None]],
    *,
    cases: int,
    hangs_after: float,
) -> int:
    """Run cases, and print what they came to; 1 if any ended otherwise than it may.

    prepare: of a folder to write in, makes what runs the case of an index and a seed. hangs_after:
    seconds of one case, at which the process ends with a traceback.
    """
    parser = argparse.ArgumentParser(prog=program)
    parser.add_argument("--cases", type=int, default=cases)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="index of the first case")
    given = parser.parse_args(arguments)
    tally, wrong = Tally(), 0
    with tempfile.TemporaryDirectory() as folder:
        run_case = prepare(Path(folder), tally)
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
        faulthandler.cancel_dump_traceback_later()
        seconds = time.perf_counter() - begun
    print(f"{given.cases} cases in {seconds:.0f} s; {wrong} wrong")
    print(f"slowest: case {tally.slowest_case}, {tally.slowest:.2f} s")
    print(f"memory: {peak_memory():.0f} MB at most")
    for text, count in [*sorted(tally.outcomes.items()), *tally.errors.most_common(25)]:
        print(f"{count:8}  {text}")
    return 1 if wrong else 0
