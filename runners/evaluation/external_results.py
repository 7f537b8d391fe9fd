"""Hypothesis sets that were made elsewhere, from files with transforms per step."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError
from chsel.numerics.arrays import FloatArray, frozen
from chsel.problem.file_checks import read_npz
from chsel.problem.poses import Poses, check_rigid, inverse
from chsel.problem.registration_problem import Hypotheses
from chsel.qd.selection import repeated
from replay.files import file_digest
from runners.evaluation.contenders import MOST_REPEATS, repeat_label
from runners.evaluation.plan import Plan, Trial
from runners.evaluation.run_method import ResultRows
from runners.evaluation.table import RESULTS, Row, write_part
from runners.evaluation.trial_session import open_recorded, problems

REPEAT_FOLDER = "draw_{}"
"""Where further sets of the same sessions are, in the folder of the first ones."""
SUFFIXES = (".npz", ".json")
_TOLERANCE = 1e-5  # of rotations: transforms may have been written as text
_KEY = re.compile(r"(step|cost|seconds)_(\d{1,10})")


class ExternalSetError(ChselError):
    """A file of hypothesis sets from elsewhere cannot be used."""


@dataclass(frozen=True, eq=False)
class ExternalSet:
    """The hypotheses of one step.

    world_from_object (B, 4, 4): poses of the object's mesh frame in the world, best first. cost
    (B,): where given, they are put in its order. seconds: where given.
    """

    world_from_object: FloatArray
    cost: FloatArray | None
    seconds: float | None

    def hypotheses(self) -> Hypotheses:
        """As those of a method; without costs all are 0."""
        cost = np.zeros(len(self.world_from_object)) if self.cost is None else self.cost
        order = np.argsort(cost, kind="stable")
        poses = inverse(self.world_from_object)[order]
        cells = np.full(len(poses), -1, dtype=np.int64)
        return Hypotheses(poses, cost[order], repeated(Poses.of(poses)), cells, poses)


def external_folders(given: Mapping[str, Path]) -> dict[str, Path]:
    """Folders by label: those given, and under a label of its own every draw in them."""
    found = dict(given)
    for label, folder in given.items():
        for draw in range(1, MOST_REPEATS):
            of_draw = folder / REPEAT_FOLDER.format(draw)
            if not of_draw.is_dir():
                break
            found.setdefault(repeat_label(label, draw), of_draw)
    return found


def external_file(folder: Path, trial: Trial) -> Path | None:
    """FOLDER/CONFIGURATION/seed_S.npz, or .json; None if there is neither."""
    for suffix in SUFFIXES:
        path = folder / trial.configuration / f"seed_{trial.seed}{suffix}"
        if path.is_file():
            return path
    return None


def external_digest(plan: Plan, trial: Trial, label: str) -> str:
    """Digest of the file of a trial; "none" without one."""
    path = external_file(plan.outside[label], trial)
    return "none" if path is None else file_digest(path)


def read_external(plan: Plan, trial: Trial, label: str) -> tuple[dict[int, ExternalSet], str]:
    """The sets of a trial in the folder of a label, by step, and why others have none.

    npz: arrays `step_K` (B, 4, 4), world_from_object of step K; where known `cost_K` (B,) and
    `seconds_K`. json: an object with the same names, and lists. Raises ExternalSetError for
    anything else: other names, steps that do not exist, shapes, numbers, rotations.
    """
    folder = plan.outside[label]
    path = external_file(folder, trial)
    if path is None:
        return {}, f"there is no {folder / trial.configuration / f'seed_{trial.seed}{SUFFIXES[0]}'}"
    values = _values(path)
    steps = plan.probes_of(trial.configuration)
    for key in values:
        match = _KEY.fullmatch(key)
        if match is None:
            raise ExternalSetError(f"{path} has {key!r}; accepted: step_K, cost_K and seconds_K")
        if int(match[2]) not in steps:
            raise ExternalSetError(
                f"{path} has {key}; accepted: steps 0 to {steps[-1]} of {trial.configuration}"
            )
        if f"step_{int(match[2])}" not in values:
            raise ExternalSetError(f"{path} has {key}; accepted: only with step_{int(match[2])}")
    named = [int(key[5:]) for key in values if key.startswith("step_")]
    return {step: _set_of(path, step, values) for step in named}, f"{path} has no set of this step"


def external_rows(plan: Plan, trial: Trial, label: str) -> None:
    """Write the part of the table about external results, of one trial."""
    sets, missing = read_external(plan, trial, label)
    digest = external_digest(plan, trial, label)
    session = open_recorded(plan, trial)
    result_rows = ResultRows(plan, trial, session, label)
    rows: list[Row] = []
    for problem in problems(plan, trial, session):
        given = sets.get(problem.key.step)
        if given is None:
            row = result_rows.row(problem, None, missing)
        else:
            row = result_rows.row(problem, given.hypotheses()) | {"seconds": given.seconds}
            if given.cost is None:
                row |= {"best_cost": None, "mean_cost": None}
        rows.append(row | {"problem_digest": None})  # a problem has an E_0, which is not known
    write_part(trial.folder(plan) / f"{label}.parquet", rows, RESULTS, digest)


def _values(path: Path) -> Mapping[str, Any]:
    try:
        if path.suffix == ".npz":
            return read_npz(path, error=ExternalSetError)
        values = json.loads(path.read_text())
    except (OSError, ValueError, ExternalSetError) as error:
        reason = " ".join(str(error).split())
        raise ExternalSetError(f"{path} cannot be read ({reason})") from None
    if not isinstance(values, Mapping):
        raise ExternalSetError(f"{path} is no object; accepted: step_K, cost_K and seconds_K")
    return values


def _set_of(path: Path, step: int, values: Mapping[str, Any]) -> ExternalSet:
    name = f"{path}: step_{step}"
    poses = frozen(name, values[f"step_{step}"], (None, 4, 4), error=ExternalSetError)
    if len(poses) == 0:
        raise ExternalSetError(f"{name} is empty; accepted: at least one transform")
    check_rigid(name, poses, _TOLERANCE)
    cost = values.get(f"cost_{step}")
    if cost is not None:
        cost = frozen(f"{path}: cost_{step}", cost, (len(poses),), error=ExternalSetError)
    seconds = values.get(f"seconds_{step}")
    if seconds is not None:
        seconds = float(frozen(f"{path}: seconds_{step}", seconds, (), error=ExternalSetError))
    return ExternalSet(poses, cost, seconds)
