"""`python -m runners.real`: methods on real measurements, against published poses and held out."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import degrees, pi
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import pyarrow as pa
from omegaconf import DictConfig
from pyarrow import csv

from chsel.errors import SettingError
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.threads import require_threads, threads
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import symmetry_of
from chsel.problem.initial_sets import posed_problem
from chsel.problem.points import KnownPoints
from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.settings import CheckedSettings, build_settings
from chsel.problem.streams import Purpose, StreamKey, uniforms
from chsel.session.rehearsal import warm_up
from replay.console import Console, Progress
from replay.environment import environment
from replay.files import whole_file
from runners.command.program import command, plain
from runners.evaluation.contenders import chosen_contenders
from runners.evaluation.experiment import this_command
from runners.evaluation.trial_configurations import chosen_names, chosen_seeds
from runners.reporting.tables import Table, print_table, table_of
from runners.run.display import compiling_line
from runners.run.setup import PresetName
from runners.sensors.depth_frame import SUFFIXES as FRAMES
from runners.sessions.problem_file import open_problem_file

MADE = "made.json"
"""Name of the file beside results.csv that says how that was made."""
_RIGHT = (0.005, pi / 36.0)  # m and radians (5 degrees): errors of a hypothesis that is right
_EPSILON = 0.001  # m, of plausible sets, which are not made here
_SPLIT = 1  # the random stream, of a seed, that halves the touches
_ALL, _HALF = "all", "half"
_MEDIANS = (  # column, which rows, heading, factor
    ("residual", _ALL, "resi-\ndual\nmm", 1e3),
    ("position_error", _ALL, "posi-\ntion\nmm", 1e3),
    ("rotation_error", _ALL, "rota-\ntion\n°", degrees(1.0)),
    ("held_out", _HALF, "held\nout\nmm", 1e3),
    ("seconds", _ALL, "ms", 1e3),
)


@dataclass(frozen=True)
class CaseConfig:
    """One real case: files in the folder of the data."""

    path: str  # known points (.npz), or a depth image (.yaml)
    mesh: str  # of the object, metres


@dataclass(frozen=True)
class RealConfig(CheckedSettings):
    """conf/real.yaml, which has all defaults and says what they are, checked."""

    data: str | None
    cases: Any
    only: Any
    seeds: Any
    methods: Any
    settings: Any
    halves: bool
    rig: Any
    preset: PresetName
    out: str
    threads: Annotated[int, require_threads]


@command("real")
def main(config: DictConfig) -> None:
    """Register every case with every method and seed, and print medians."""
    checked = build_settings(RealConfig, plain(config), where="real")
    cases = chosen_names("only", checked.only, existing=checked.cases)
    seeds = chosen_seeds(checked.seeds)
    console = Console()
    if checked.data is None or not (Path(checked.data).expanduser() / "real").is_dir():
        raise SettingError(
            f"data is {checked.data}; accepted: a folder with real/, by data=FOLDER or CHSEL_DATA"
        )
    contenders = chosen_contenders(checked.methods, checked.settings, preset=checked.preset.name)
    methods = {label: contender.method() for label, contender in contenders.items()}
    rows: list[Mapping[str, Any]] = []
    with threads(checked.threads):
        opened = [RealCase(checked, name) for name in cases]
        with compiling_line():
            for method in methods.values():
                warm_up(method)
        waiting = Console(stderr=True)
        with Progress(console=waiting, transient=True, disable=not waiting.is_terminal) as bar:
            for case in bar.track(opened, description="cases"):
                rows += case.rows(methods, seeds)
    file = Path(checked.out).expanduser() / "results.csv"
    with whole_file(file) as beside:
        csv.write_csv(pa.Table.from_pylist(rows), beside)
    made = {"commands": [this_command()], "environments": [environment()]}
    with whole_file(file.with_name(MADE)) as beside:
        beside.write_text(json.dumps(made, indent=1) + "\n")
    print_table(console, medians(pd.DataFrame(rows)))
    console.print(str(file), soft_wrap=True)


class RealCase:
    """A case with its object, its points and, where it is known, its true pose."""

    def __init__(self, config: RealConfig, name: str) -> None:
        """Open the session; raise SettingError if there are too few touches."""
        case = build_settings(CaseConfig, config.cases[name], where=f"cases.{name}")
        folder = Path(config.data or "").expanduser() / "real"
        model = {"name": name, "scale": 1.0, "epsilon": _EPSILON, "configuration": name}
        model |= {"kind": "file", "path": str(folder / case.mesh)}
        frame = Path(case.path).suffix.lower() in FRAMES
        session = {"kind": "sensors", "rig": config.rig} if frame else {"kind": "points"}
        self._source = open_problem_file(
            folder / case.path, model, session=session, assets=folder, seed=0
        )
        self._given = self._source.problems.problem(self._source.steps[-1])
        self._touches = self._given.points.contacts
        if len(self._touches) < 2:
            raise SettingError(f"{name} has {len(self._touches)} touches; accepted: from 2")
        self._symmetry = symmetry_of(self._given.sdf, self._source.mesh)
        self._config = config
        self._name = name

    def rows(self, methods: Mapping[str, Method], seeds: Sequence[int]) -> Iterator[dict[str, Any]]:
        """Yield a row for every method and seed and, where wanted, another of half of the touches.

        Last one of the true pose itself, where it is known: what residual there is to reach.
        """
        every = np.arange(len(self._touches))
        for (label, method), seed in product(methods.items(), seeds):
            about = {"case": self._name, "method": label, "seed": seed}
            yield {**about, "points": _ALL, **self._numbers(method, seed, kept=every)}
            if self._config.halves:
                stream = StreamKey(seed, 0).stream(Purpose.CONTACT_POINTS, _SPLIT)
                order = np.argsort(
                    uniforms(stream, 0.0, upper=1.0, shape=len(every)), kind="stable"
                )
                kept = np.sort(order[: (len(every) + 1) // 2])
                yield {**about, "points": _HALF, **self._numbers(method, seed, kept=kept)}
        if (truth := self._source.world_from_object) is not None:
            about = {"case": self._name, "method": "(published)", "points": _ALL}
            yield about | self._counts(every, inverse(truth[None])[0])

    def _counts(self, kept: IntArray, pose: FloatArray) -> dict[str, Any]:
        """Return numbers of points, and the distances of all touches from the surface in a pose."""
        away = np.abs(mesh_sdf(self._source.mesh, apply(pose, self._touches))[0])  # (C,), metres
        rest = np.delete(np.arange(len(away)), kept)
        return {
            "touches": len(kept),
            "free_points": len(self._given.points.free),
            "residual": float(away[kept].mean()),
            "held_out": float(away[rest].mean()) if len(rest) else None,
            **dict.fromkeys(("position_error", "rotation_error", "right", "truth_held")),
        }

    def _numbers(self, method: Method, seed: int, *, kept: IntArray) -> dict[str, Any]:
        """Return the numbers of registering these touches; metres and radians."""
        given = self._given
        points = KnownPoints(free=given.points.free, known=self._touches[kept])
        problem = posed_problem(
            given.sdf,
            points,
            workspace=given.workspace,
            free_resolution=given.free_resolution,
            key=StreamKey(seed, 0),
            settings=method.online,
            prior=given.prior,
        )
        begun = time.perf_counter()
        found = method.register(problem)
        seconds = time.perf_counter() - begun
        best = found.object_from_world[:1]
        numbers = {"best_cost": float(found.cost[0]), **self._counts(kept, best[0])}
        if (truth := self._source.world_from_object) is not None:
            errors = pose_errors(best, truth, symmetry=self._symmetry)
            position, rotation = (float(error[0]) for error in errors)
            numbers |= {"position_error": position, "rotation_error": rotation}
            numbers["right"] = position <= _RIGHT[0] and rotation <= _RIGHT[1]
            if (holds := getattr(method, "holds", None)) is not None:
                numbers["truth_held"] = bool(holds(problem, found, inverse(truth[None]))[0])
        return numbers | {"seconds": seconds, "digest": found.digest}


def medians(rows: pd.DataFrame) -> Table:
    """Return medians over seeds of every case and method."""
    lines = []
    for (case, method), own in rows.groupby(["case", "method"], sort=False):
        every = own[own["points"] == _ALL]
        right = every["right"].dropna()
        line = {"case": case, "method": method, "tou-\nches": every["touches"].iloc[0]}
        line["right"] = f"{sum(right)}/{len(right)}" if len(right) else "-"
        for column, points, heading, scale in _MEDIANS:
            some = own.loc[own["points"] == points, column].astype(float)
            line[heading] = float(scale * some.median())
        lines.append(line)
    note = (
        "Of the best hypothesis. Residual: mean |SDF| of all touches; held out: of a random half, "
        "registered on the other. Right: within 5 mm and 5 degrees of the published pose."
    )
    return table_of("Medians over seeds", lines, labels=2, note=note)


if __name__ == "__main__":
    main()
