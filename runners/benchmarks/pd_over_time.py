"""Plausible diversity over time: what every method gets for its milliseconds, effort by effort."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from chsel.methods import preset_settings
from chsel.methods.method import Method
from chsel.numerics.threads import threads
from chsel.plausible.plausible_set import PlausibleSet, load_plausible
from chsel.plausible.plausible_settings import plausible_settings
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.settings import settings_mapping
from runners.benchmarks.timing import Row
from runners.evaluation.contenders import chosen_contenders
from runners.evaluation.metrics import HypothesisMetrics, MetricsConfig
from runners.evaluation.plan import OWN, Plan, Trial
from runners.evaluation.trial_session import (
    make_session,
    open_recorded,
    plausible_settings_of,
    problems,
)

PD, TIME = "PD over time", "PD over time, time"
"""Measures: rows of the former have the median time, milliseconds, as their place."""
_TRIALS = tuple(
    Trial(10, name)
    for name in (
        "drill",
        "drill_fallen",
        "mustard",
        "mustard_fallen",
        "hammer",
        "box_fallen",
        "can",
        "clamp_sideways",
    )
)
_STEPS = "8,19"
_DEFINITION = "wide_means"  # as in docs/results.md and docs/anchored.md
# Within 1 % of distances to the mesh in these sessions, which take 20 to 40 times as long.
_METRICS = MetricsConfig(method="grid")
_LEAST = 1e-3  # mm^2: below it, a PD is as good as 0
_SHARES = {"a fifth": 0.2, "half": 0.5, "all": 1.0, "3 x": 3.0}
"""Of the steps that a method does by default."""


def _chsel(preset: str) -> dict[str, Any]:
    settings = preset_settings("chsel", preset)
    return {
        name: {
            "descent": {"restarts": max(1, round(settings.descent.restarts * share))},
            "emitter": {"iterations": round(settings.emitter.iterations * share)},
        }
        for name, share in _SHARES.items()
    }


def _shares(setting: str, usual: int) -> dict[str, Any]:
    return {name: {setting: round(usual * share)} for name, share in _SHARES.items()}


EFFORTS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "chsel@reference": _chsel("reference"),
    "chsel@paper": _chsel("paper"),
    "chsel": _chsel("default"),
    "anchored": {size: {"size": size} for size in ("small", "medium", "large", "adaptive")},
    "gradient_descent": {
        f"{most} restarts": {"descent": {"restarts": most}} for most in (2, 5, 10)
    },
    "icp": {f"{most} iterations": {"iterations": most} for most in (1, 3, 10, 100)},
    "svgd": _shares("iterations", 300),
    "cvo": {f"{most} iterations": {"max_iterations": most} for most in (10, 30, 100)},
    "medial_constraint": {
        f"{most} generations": {"cma_es": {"generations": most}} for most in (50, 100, 200, 10_000)
    },
}
"""Settings by effort, of each method in a preset, the default one where none is named."""


def pd_over_time() -> Iterator[Row]:
    """The time of a registration, and the geometric mean of its PD, on development sessions.

    Every method gets the problems of probed sessions, each without a result before it. Times are
    those of the processor, on one thread. All of it takes some minutes.
    """
    methods = {
        (curve, effort): _method(curve, changes)
        for curve, efforts in EFFORTS.items()
        for effort, changes in efforts.items()
    }
    taken: dict[tuple[str, str], list[float]] = {case: [] for case in methods}  # ms
    diversity: dict[tuple[str, str], list[float]] = {case: [] for case in methods}  # mm^2
    with TemporaryDirectory() as folder:
        plan = _plan(Path(folder))
        for trial in _TRIALS:
            make_session(plan, trial)
            session = open_recorded(plan, trial)
            assert session.world_from_object is not None
            members: dict[int, PlausibleSet] = {}  # by step
            mesh, truth = session.recorded.mesh, session.world_from_object
            metrics = HypothesisMetrics(plan.metrics, mesh, truth)
            settings = plausible_settings_of(plan, session)
            for case, method in methods.items():
                for problem in problems(plan, trial, session, method.online):
                    milliseconds, found = _timed(method, problem, warm=bool(taken[case]))
                    taken[case].append(milliseconds)
                    step = problem.key.step
                    if step not in members:
                        there = load_plausible(trial.folder(plan) / "plausible", problem, settings)
                        assert there is not None
                        members[step] = there
                    measured = metrics.compute(problem, members[step], found, ranked=False)
                    diversity[case].append(measured.get("diversity", np.inf))
    for case, samples in taken.items():
        curve, effort = case
        row = Row(TIME, effort, curve, "ms", tuple(samples))
        mean = float(np.exp(np.log(np.maximum(diversity[case], _LEAST)).mean()))
        yield row
        yield Row(PD, effort, curve, "mm²", (mean,), at=row.median)


def _timed(method: Method, problem: RegistrationProblem, *, warm: bool) -> tuple[float, Hypotheses]:
    """Milliseconds of a registration. warm: whether the method has registered before."""
    with threads(1):
        if not warm:
            method.register(problem)  # loads what is compiled
        begun = time.thread_time()
        found = method.register(problem)
        return 1000.0 * (time.thread_time() - begun), found


def _method(curve: str, changes: Mapping[str, Any]) -> Method:
    name, _, preset = curve.partition("@")
    entry = {"name": name, "settings": changes}
    return chosen_contenders([entry], {}, preset or "default")[name].method()


def _plan(folder: Path) -> Plan:
    values = settings_mapping(plausible_settings(_DEFINITION, 1.0))
    return Plan(
        folder=folder,
        preset="default",
        session={"kind": "kinematic"},
        objects="models",
        definition={"name": _DEFINITION, **values, "epsilon": None},
        metrics=_METRICS,
        steps=_STEPS,
        starts=OWN,
        every=None,
        recordings=False,
        assets=folder,
        contenders={},
        outside={},
    )
