"""The first stage in which a record is not what it should be, and by how much."""

import json
from pathlib import Path

import llvmlite
import numba
import numpy
import numpy as np
import torch

from chsel.numerics.arrays import digest
from replay.comparing.differences import ulps

GOLDEN_FILE = Path(__file__).with_name("golden.json")
_SAMPLES = 3

Golden = dict[str, dict[str, list[str]]]
"""By case and stage: a digest of all arrays, then a few of their numbers in hexadecimal."""


def condensed(record):
    """Digests and samples of a record."""
    return {
        case: {stage: [stage_digest(arrays), *_samples(arrays)] for stage, arrays in stages.items()}
        for case, stages in record.items()
    }


def stage_digest(arrays):
    """Digest of the arrays of a stage, short enough to be read."""
    return digest(*arrays.values())[:16]


def _numbers(arrays):
    parts = [array.reshape(-1) for array in arrays.values() if array.dtype == np.float64]
    return np.concatenate(parts)


def _samples(arrays):
    numbers = _numbers(arrays)
    return [float(numbers[(i * len(numbers)) // _SAMPLES]).hex() for i in range(_SAMPLES)]


def read_golden():
    """The digests that every machine must give."""
    return json.loads(GOLDEN_FILE.read_text())["cases"]


def write_golden(golden):
    """One line a stage, so that a change of one shows as one."""
    lines = ["{", f' "versions": {json.dumps(versions())},', ' "cases": {']
    for case, stages in golden.items():
        rows = [f"   {json.dumps(stage)}: {json.dumps(row)}" for stage, row in stages.items()]
        lines += [f"  {json.dumps(case)}: {{", ",\n".join(rows), "  },"]
    lines[-1] = "  }"
    GOLDEN_FILE.write_text("\n".join([*lines, " }", "}"]) + "\n")


def versions():
    """Of the packages that could change a bit."""
    return {module.__name__: module.__version__ for module in (numpy, torch, numba, llvmlite)}


def other_versions():
    """Which packages are not those with which golden.json was made; empty if all are."""
    made, here = json.loads(GOLDEN_FILE.read_text())["versions"], versions()
    return ", ".join(
        f"{name} {here[name]} instead of {made[name]}" for name in here if here[name] != made[name]
    )


def differences(golden, record, nearby=None):
    """A line for each case that is not as it should be, naming the first stage that differs.

    nearby: the same cases in the default setting of this machine, for how far the numbers are
    apart; without it, the samples in `golden` tell.
    """
    lines = [f"{case}: not recorded" for case in golden if case not in record]
    lines += [f"{case}: not in golden.json" for case in record if case not in golden]
    for case in golden:
        if case in record:
            lines += _first_difference(case, golden[case], record[case], nearby)
    return lines


def _first_difference(case, expected, stages, nearby):
    lines = []
    for stage, arrays in stages.items():
        if stage not in expected:
            lines.append(f"{case}: stage {stage!r} is new")
        elif stage_digest(arrays) != expected[stage][0]:
            usual = nearby[case].get(stage) if nearby else None
            if usual is None or stage_digest(usual) != expected[stage][0]:
                apart = _by_samples(expected[stage][1:], arrays)
            else:
                apart = _by_arrays(usual, arrays)
            return [*lines, f"{case}: {stage!r} differs, {apart}"]
    missing = [stage for stage in expected if "hypotheses" in stage and stage not in stages]
    return lines + [f"{case}: stage {stage!r} is missing" for stage in missing]


def _by_samples(expected, arrays):
    ours = np.array([float.fromhex(number) for number in _samples(arrays)])
    theirs = np.array([float.fromhex(number) for number in expected])
    apart = int(ulps(theirs, ours).max())
    place = "in" if apart else "but not in"
    return f"{f'by up to {apart} ulp ' if apart else ''}{place} the numbers in golden.json"


def _by_arrays(usual, arrays):
    said = []
    for name, array in arrays.items():
        if array.shape != usual[name].shape:
            said.append(f"{name} {array.shape} instead of {usual[name].shape}")
        elif digest(array) != digest(usual[name]):
            apart = ulps(usual[name], array)
            unequal = int((apart > 0).sum())
            said.append(f"{unequal} of {array.size} {name} by up to {apart.max()} ulp")
    return "; ".join(said)
