"""`python -m runners.published`: the published package on the sessions of an evaluation."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from chsel.errors import SettingError
from chsel.problem.settings import build_settings
from replay.console import Console, Progress
from runners.command.program import command, plain
from runners.evaluation.contenders import require_repeats
from runners.evaluation.experiment import read_experiment
from runners.evaluation.plan import Trial
from runners.evaluation.trial_configurations import chosen_names, chosen_seeds
from runners.evaluation.trial_session import read_told
from runners.published_package.package_session import PackageSession
from runners.published_package.process import PackageConfig, PublishedPackage, interpreter


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
        """Of the sets."""
        evaluation = Path(self.dir or "").expanduser()
        return Path(self.out).expanduser() if self.out else evaluation / "package"


@command("published")
def main(config: DictConfig) -> None:
    """Register what is not registered yet."""
    checked = build_settings(PublishedConfig, plain(config), "published")
    trials = found_trials(checked)
    console = Console(soft_wrap=True)
    with PublishedPackage(interpreter(checked.package, console.print)) as package:
        sessions = [
            PackageSession(package, checked.folder, trial, draw, session, steps)
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
    """Trials with a finished session and its recording, seed by seed.

    Raises SettingError if the settings name none.
    """
    folder = Path(config.dir or "").expanduser()
    experiment = read_experiment(folder)
    names = chosen_names("configurations", config.configurations, experiment["configurations"])
    seeds = experiment["seeds"] if config.seeds is None else chosen_seeds(config.seeds)
    found = []
    for trial in sorted(Trial(seed, name) for seed in seeds for name in names):
        session = folder / "trials" / trial.configuration / f"seed_{trial.seed}" / "session.mcap"
        if session.is_file() and session.with_suffix(".json").is_file():
            found.append((trial, session))
    if not found:
        raise SettingError(
            f"configurations={config.configurations} and seeds={config.seeds} name no session; "
            f"accepted: {', '.join(names)}; seeds {', '.join(map(str, experiment['seeds']))}"
        )
    return found


if __name__ == "__main__":
    main()
