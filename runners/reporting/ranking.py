"""An evaluation beside the one of its name that comes with this package."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pandas as pd

from chsel.errors import SettingError, quoted
from runners.reporting.evaluation_folder import TRIAL, open_evaluation
from runners.reporting.sections import against_baseline, short_tables
from runners.reporting.tables import Table

KEPT = Path(__file__).parents[1] / "results"
"""The tables behind docs/results.md, a folder for each evaluation."""
PACKAGE = "package"  # with which methods are compared
_KEYS = [*TRIAL, "faults", "step", "method", "policy", "draw"]
_TIMES = ["seconds", "decision_seconds"]


def stored_names(kept: Path) -> list[str]:
    """Return names of the evaluations in a folder."""
    return sorted(path.parent.name for path in kept.glob("*/experiment.json"))


def ranking(folder: Path, kept: Path = KEPT) -> Iterator[str | Table]:
    """Yield whether an evaluation has the bits of the kept one at the same rows, and its place.

    Raise RecordingError for a folder that is no evaluation, SettingError if none of its name and
    kind is kept.
    """
    own = open_evaluation(folder)
    name, is_steered = str(own.experiment["name"]), bool(own.experiment["policies"])
    if name not in stored_names(kept):
        accepted = f"accepted: {', '.join(stored_names(kept))}"
        raise SettingError(f"nothing is kept beside evaluation {quoted(name)}; {accepted}")
    ours = open_evaluation(kept / name)
    kind, group = ("probes", "policies") if is_steered else ("rows", "methods")
    if bool(ours.experiment["policies"]) is not is_steered:
        text = f"evaluation {quoted(name)} in {folder} is of {group}, and the kept one is not"
        raise SettingError(f"{text}; accepted: another name for it, as in name=NAME")
    tables = [getattr(one, kind) for one in (own, ours)]
    keys = [key for key in _KEYS if key in tables[0]]
    mine, theirs = (one.set_index(keys).drop(columns=_TIMES, errors="ignore") for one in tables)
    common = mine.index.intersection(theirs.index)
    first, second = mine.loc[common], theirs.loc[common]
    equal = ((first == second) | (first.isna() & second.isna())).fillna(False).all(axis=1)
    yield f"{equal.sum()} of {len(common)} rows that both have are the same to the bit"
    yield from (f"differs: {dict(zip(keys, key, strict=True))}" for key in common[~equal][:1])
    named = {group: {**own.experiment[group], **ours.experiment[group]}}
    rows = {kind: pd.concat([tables[0][~mine.index.isin(common)], tables[1]])}
    both = replace(ours, experiment={**ours.experiment, **named}, **rows)
    if is_steered:
        yield from short_tables(both)
    else:
        yield against_baseline(both, PACKAGE if PACKAGE in both.methods else "chsel")[0]
