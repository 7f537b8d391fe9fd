"""The golden digests: `python -m tests.tools.golden [--write]`.

Without --write: what differs from golden.json here. With it: make it anew, and say what changed.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import llvmlite
import numba
import numpy as np
import torch

from replay.comparing.differences import ulps
from tests.determinism.record import ENVIRONMENTS, recorded

GOLDEN_FILE = Path(__file__).parents[1] / "determinism" / "golden.json"


def read_golden():
    """The digests that every machine must give."""
    return json.loads(GOLDEN_FILE.read_text())["cases"]


def write_golden(golden):
    """One line a stage, so that a change of one shows as one."""
    cases = []
    for case, stages in golden.items():
        rows = [f"   {json.dumps(stage)}: {json.dumps(row)}" for stage, row in stages.items()]
        cases.append(f"  {json.dumps(case)}: {{\n" + ",\n".join(rows) + "\n  }")
    head = f'{{\n "versions": {json.dumps(versions())},\n "cases": {{\n'
    GOLDEN_FILE.write_text(head + ",\n".join(cases) + "\n }\n}\n")


def versions():
    """Of the packages that could change a bit."""
    return {module.__name__: module.__version__ for module in (np, torch, numba, llvmlite)}


def other_versions():
    """Which packages are not those with which golden.json was made; empty if all are."""
    made = json.loads(GOLDEN_FILE.read_text())["versions"]
    here = versions()
    other = (f"{name} {here[name]} for {made[name]}" for name in here if here[name] != made[name])
    return ", ".join(other)


def differences(golden, record, *, whole=True):
    """A line for each case that is not as it should be, naming the first stage that differs.

    whole: all stages must be there, as they are where an observer keeps them, and not the results
    alone.
    """
    lines = [f"{case}: not recorded" for case in golden if case not in record]
    lines += [f"{case}: not in golden.json" for case in record if case not in golden]
    for case in golden.keys() & record.keys():
        expected, stages = golden[case], record[case]
        missing = [name for name in expected if whole or "hypotheses" in name]
        found = [f"stage {name!r} is missing" for name in missing if name not in stages]
        for name, row in stages.items():
            if name not in expected:
                found.insert(0, f"stage {name!r} is new")
            elif row[0] != expected[name][0]:
                found.insert(0, f"{name!r} differs, {_apart(expected[name][1:], row[1:])}")
                break
        lines += [f"{case}: {text}" for text in found[:1]]
    return sorted(lines)


def _apart(expected, found):
    """How far the samples of a stage are from those in golden.json."""
    one, other = (np.array([float.fromhex(number) for number in row]) for row in (expected, found))
    apart = int(ulps(one, other).max())
    return f"by up to {apart} ulp in samples" if apart else "but not in samples"


def main():
    """Compare or write; status 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write golden.json")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        record, _ = recorded(ENVIRONMENTS["default"], Path(directory) / "record.json")
    lines = differences(read_golden() if GOLDEN_FILE.exists() else {}, record)
    print("\n".join(lines) or f"all {len(record)} cases are as in {GOLDEN_FILE.name}")
    if arguments.write:
        write_golden(record)
    elif lines:
        sys.exit(f"{GOLDEN_FILE.name} was made with other packages: here {other_versions()}")


if __name__ == "__main__":
    main()
