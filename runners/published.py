"""`python -m runners.published`: the published package on the sessions of an evaluation."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from omegaconf import DictConfig

from chsel.errors import PoseError, SettingError
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.poses import Poses, inverse, nearest_rigid
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.settings import build_settings, in_preset
from chsel.problem.streams import Purpose
from chsel.qd.selection import repeated
from replay.console import Console, Progress
from replay.files import file_digest, whole_file
from runners.command.program import command, plain
from runners.evaluation.contenders import repeat_label, repeat_seed, require_repeats
from runners.evaluation.experiment import read_experiment
from runners.evaluation.plan import Task, Trial
from runners.evaluation.run_method import REPEAT_FOLDER
from runners.evaluation.trial_configurations import chosen_names, chosen_seeds
from runners.evaluation.trial_session import read_told
from runners.published_package.process import PackageConfig, PublishedPackage, interpreter
from runners.published_package.worker_process import RefusedError
from runners.sessions.recorded import RecordedSettings, RecordedSource

HOW = replace(in_preset(OnlineSettings(), "reference"), initial="so3")
"""E_0 and E_l as the package's authors make them, but first from the starts that all others get."""


@dataclass(frozen=True)
class PublishedConfig:
    """conf/published.yaml, which has all defaults, checked."""

    configurations: Any  # checked by `found_trials`, as are seeds
    seeds: Any
    package: PackageConfig
    dir: str | None
    out: str | None
    draws: int

    def __post_init__(self) -> None:
        require_repeats(self.draws)
        if not self.dir:
            raise SettingError("dir is missing; pass dir=FOLDER, of an evaluation")

    @property
    def folder(self) -> Path:
        """Folder of the sets."""
        evaluation = Path(self.dir or "").expanduser()
        return Path(self.out).expanduser() if self.out else evaluation / "package"


@command("published")
def main(config: DictConfig) -> None:
    """Register what is not registered yet."""
    checked = build_settings(PublishedConfig, plain(config), where="published")
    trials = found_trials(checked)
    console = Console(soft_wrap=True)
    with PublishedPackage(interpreter(checked.package, console.print)) as package:
        sessions = [
            PackageSession(
                package, checked.folder, trial=trial, draw=draw, session=session, steps=steps
            )
            for draw in range(checked.draws)
            for trial, session in trials
            if (steps := tuple(read_told(session.parent)["steps"]))
        ]
        missing = [one for one in sessions if one.failures() is None]
        console.print(
            f"{len(sessions)} sessions, of which {len(sessions) - len(missing)} are finished"
        )
        with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
            shown = bar.add_task("", total=sum(len(one.steps) for one in missing))
            for one in missing:
                bar.update(shown, description=str(one.unit))
                for _ in one.register():
                    bar.advance(shown)
    failed = [
        f"failed: {one.unit}: step {step}: {reason}"
        for one in sessions
        for step, reason in (one.failures() or {}).items()
    ]
    for line in failed:
        console.print(line)
    console.print(f"sets of {len(sessions)} sessions, draws apart, are in {checked.folder}")
    console.print(f"the evaluation's command ranks them with outside.package={checked.folder}")
    if failed:
        sys.exit(1)


def found_trials(config: PublishedConfig) -> list[tuple[Trial, Path]]:
    """Return trials with a finished session and its recording, seed by seed.

    Raise SettingError if the settings name none.
    """
    folder = Path(config.dir or "").expanduser()
    experiment = read_experiment(folder)
    names = chosen_names(
        "configurations", config.configurations, existing=experiment["configurations"]
    )
    seeds = experiment["seeds"] if config.seeds is None else chosen_seeds(config.seeds)
    trials = sorted(Trial(seed, name) for seed in seeds for name in names)
    place = "trials/{0.configuration}/seed_{0.seed}/session.mcap"
    paths = [(trial, folder / place.format(trial)) for trial in trials]
    found = [(trial, path) for trial, path in paths if path.with_suffix(".json").is_file()]
    if not found:
        raise SettingError(
            f"configurations={config.configurations} and seeds={config.seeds} name no session; "
            f"accepted: {', '.join(names)}; seeds {', '.join(map(str, experiment['seeds']))}"
        )
    return found


@dataclass(frozen=True)
class PackageSession:
    """One draw of a trial, registered by the package, and the files of its results."""

    package: PublishedPackage
    folder: Path  # of all sets
    trial: Trial
    draw: int
    session: Path  # the trial's recording
    steps: tuple[int, ...]  # those to register

    @property
    def unit(self) -> Task:
        """The task, as progress names it."""
        return Task(self.trial, repeat_label("package", self.draw))

    @property
    def sets(self) -> Path:
        """The hypotheses, as runners.evaluate takes them."""
        of_draw = self.folder / REPEAT_FOLDER.format(self.draw) if self.draw else self.folder
        return of_draw / self.trial.configuration / f"seed_{self.trial.seed}.npz"

    @property
    def about(self) -> Path:
        """File of how the sets came about, and why steps have none; written last."""
        return self.sets.with_suffix(".about.json")

    def failures(self) -> Mapping[str, str] | None:
        """Return why steps have no set; None if the sets are missing or of another session.

        A file that cannot be read is made again.
        """
        with suppress(OSError, ValueError):
            about = json.loads(self.about.read_text())
            if self.sets.is_file() and self._source().items() <= about.items():
                return dict(about["failed"])
        return None

    def register(self) -> Iterator[int]:
        """Yield each step when the package is done with it; the files exist at the end."""
        session = RecordedSource(RecordedSettings(str(self.session), 0, start_probe=0))
        arrays: dict[str, Any] = {}
        about: dict[str, Any] = {"failed": {}, "cpu_seconds": {}, "free_points": {}}

        def register(problem: RegistrationProblem) -> Hypotheses:
            found, answer = registered(self.package, problem, mesh=session.recorded.mesh)
            step = problem.key.step
            arrays[f"step_{step}"] = inverse(found.object_from_world)
            arrays[f"cost_{step}"] = found.cost
            arrays[f"seconds_{step}"] = np.array(answer["seconds"])
            for name in ("cpu_seconds", "free_points"):
                about[name][str(step)] = answer[name]
            return found

        seed = repeat_seed(self.trial.seed, self.draw)
        loop = session.loop(HOW, seed=seed, steps=self.steps)
        for probe in session.probes():
            loop.perceive(probe)
            if loop.enough:
                try:
                    loop.remember(register(loop.problem()))
                except (RefusedError, PoseError) as error:
                    about["failed"][str(probe.step)] = " ".join(str(error).split())
            yield probe.step
        with whole_file(self.sets) as beside, beside.open("wb") as file:
            np.savez(file, **arrays)
        with whole_file(self.about) as beside:
            beside.write_text(json.dumps({**self._source(), **about}, indent=2) + "\n")

    def _source(self) -> dict[str, Any]:
        return {
            "session": file_digest(self.session),
            "steps": list(self.steps),
            "draw": self.draw,
            "versions": dict(self.package.versions),
        }


def registered(
    package: PublishedPackage, problem: RegistrationProblem, *, mesh: trimesh.Trimesh
) -> tuple[Hypotheses, Mapping[str, Any]]:
    """Return the hypotheses of the package with its own settings, best first, and its answer."""
    package.load(problem, mesh.bounds)
    # It draws from generators of its own, of one number that follows from ours.
    seed = int(problem.key.stream(Purpose.EMITTER).integers(2**32))
    answer = package.register(seed=seed)
    poses = nearest_rigid("a pose of the package", np.array(answer["poses"]))
    elites = nearest_rigid("an elite of the package", np.array(answer["elites"]))
    cost = np.array(answer["cost"], dtype=np.float64)
    if not np.isfinite(cost).all():
        raise RefusedError("a cost of the package is not finite")
    order = np.argsort(cost, kind="stable")
    poses, cells = poses[order], np.full(len(poses), -1, dtype=np.int64)
    return Hypotheses(
        poses, cost[order], duplicate=repeated(Poses.of(poses)), cell=cells, elites=elites
    ), answer


if __name__ == "__main__":
    main()
