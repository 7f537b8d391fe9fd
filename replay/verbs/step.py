"""Register one recorded problem again, with another method or other settings; record that.

It is `compare` on one step, with --out. The new recording has all that the problem follows from,
and names its source by digest. With --policy nothing is registered: a table shows what policies
decide after the step.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from chsel.errors import SettingError
from chsel.methods import METHODS
from chsel.policies import POLICIES
from replay.arguments import path_argument
from replay.mcap.reader import read_recording
from replay.verbs import compare


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the file, its step, the method with its settings, and what to write."""
    parser.add_argument("file", type=path_argument, metavar="FILE", help="a recording")
    parser.add_argument("--step", type=int, required=True, metavar="K", help="a recorded problem")
    parser.add_argument(
        "--method",
        nargs="+",
        default=[],
        metavar=("NAME", "KEY=VALUE"),
        help=f"one of {', '.join(METHODS)}, or NAME@PRESET, by default the recorded one; then "
        "settings such as cost.free_scale=40",
    )
    parser.add_argument(
        "--policy",
        nargs="+",
        action="append",
        default=[],
        metavar=("NAME", "KEY=VALUE"),
        help=f"one of {', '.join(POLICIES)}, then settings such as noise=0.01: what it decides "
        "after the step; may be repeated",
    )
    parser.add_argument(
        "-o",
        "--out",
        type=path_argument,
        help="a new file; else RECORDING_stepK_METHOD.mcap in this folder",
    )
    parser.add_argument(
        "--save-rerun", type=path_argument, metavar="RRD", help="also both results side by side"
    )


def run(given: argparse.Namespace) -> int:
    """Compare on the step."""
    parser = argparse.ArgumentParser()
    compare.add_arguments(parser)
    asked = parser.parse_args(["", "--methods", "", "--each"])
    asked.file = given.file
    asked.steps = str(given.step)
    asked.save_rerun = given.save_rerun
    if given.policy:
        if given.method:
            raise SettingError("--policy registers nothing; accepted: with FILE and --step")
        asked.methods = None
        asked.policies = _policies(given.policy)
        asked.out = given.out
        return compare.run(asked)
    names = [word for word in given.method if "=" not in word]
    if len(names) > 1:
        raise SettingError(f"--method names {' and '.join(names)}; accepted: one, then KEY=VALUE")
    label = names[0] if names else read_recording(given.file).start.method
    default = f"{given.file.stem}_step{given.step}_{label.partition('@')[0]}.mcap"
    asked.methods = [label, *(word for word in given.method if "=" in word)]
    asked.out = given.out or Path(default)
    return compare.run(asked)


def _policies(groups: list[list[str]]) -> list[str]:
    """Return `--policy NAME KEY=VALUE --policy NAME` as `compare --policies` takes it."""
    words: list[str] = []
    counts: Counter[str] = Counter()
    for name, *changes in groups:
        if "=" in name:
            raise SettingError(f"--policy {name} names none; accepted: {', '.join(POLICIES)}")
        counts[name] += 1
        label = name if counts[name] == 1 else f"{name}#{counts[name]}"
        words += [label, *(f"{label}:{change}" for change in changes)]
    return words
