"""`python -m runners.benchmark`: time registrations, beside those of the published package."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import DictConfig

from chsel.errors import require_choice, require_positive
from chsel.problem.settings import build_settings
from chsel.problem.streams import StreamKey
from replay.console import Console
from runners.benchmarks import benchmark_tables as report
from runners.benchmarks.comparison import WHAT, compare
from runners.benchmarks.measures import MEASURES
from runners.benchmarks.plot import picture_of_benchmark
from runners.benchmarks.problems import PROBLEMS
from runners.benchmarks.registrations import Scope, Steps
from runners.benchmarks.timing import load, machine
from runners.command.program import command, plain
from runners.published_package.environment import PackageConfig, interpreter
from runners.published_package.process import PublishedPackage
from runners.reporting.figures import FORMATS, drawing, write_picture
from runners.run.recording import IN_RUN_FOLDER, make_run_folder, write_in_run_folder

_LONG = ("methods", "pd_over_time", "start")
"""What a quick run leaves out."""


@dataclass(frozen=True)
class BenchmarkConfig:
    """conf/benchmark.yaml, which has all defaults, checked."""

    problems: tuple[str, ...]  # which to register
    alone: tuple[str, ...]  # what else to measure of this library
    free_points: tuple[int, ...]  # sizes that show how the time grows
    hypotheses: tuple[int, ...]
    package: PackageConfig
    steps: Steps
    logs: str
    format: str  # of the picture
    repeats: int
    seed: int
    quick: bool

    def __post_init__(self) -> None:
        StreamKey(self.seed, 0)
        require_positive("repeats", self.repeats)
        for name in ("free_points", "hypotheses"):
            for value in getattr(self, name):
                require_positive(name, value)
        for problem in (*self.problems, *self.package.equation):
            require_choice("problem", problem, PROBLEMS)
        for measure in self.alone:
            require_choice("alone", measure, MEASURES)
        require_choice("format", self.format, FORMATS)

    def shortened(self) -> BenchmarkConfig:
        """As much as takes under a minute; its times are not to be quoted."""
        return replace(
            self,
            problems=("real_20",),
            alone=tuple(name for name in self.alone if name not in _LONG),
            free_points=(5000, 20_000),
            hypotheses=(10, 30),
            repeats=2,
            package=replace(self.package, equation=()),
            steps=Steps(restarts=1, adam=50, search=10, long_search=20),
        )


@command("benchmark")
def main(config: DictConfig) -> None:
    """Run the benchmark."""
    values = plain(config)
    checked = build_settings(BenchmarkConfig, values, "benchmark")
    if checked.quick:
        checked = checked.shortened()
    torch.set_num_threads(1)
    console = Console()
    say = partial(console.print, soft_wrap=True)
    with ExitStack() as stack:
        python = None if checked.package.skip else interpreter(checked.package, say)
        package = None if python is None else stack.enter_context(PublishedPackage(python))
        folder = make_run_folder(Path(checked.logs) / "benchmark", "drill")
        write_in_run_folder(folder / "config.yaml", yaml.safe_dump(values, sort_keys=False))
        found = _run(checked, package, folder, console)
    report.show(console, found)
    report.write_markdown(folder / "speed.md", found)
    with drawing():
        if (picture := picture_of_benchmark(found)) is not None:
            write_picture(picture, folder, checked.format, accepted=IN_RUN_FOLDER)
    for path in sorted(folder.iterdir()):
        say(f"written: {path}")


def _run(
    config: BenchmarkConfig, package: PublishedPackage | None, folder: Path, console: Console
) -> dict[str, Any]:
    """Measure everything; what is measured so far is always in the file."""
    found: dict[str, Any] = {
        "runner": "benchmark",
        "what": WHAT,
        "settings": asdict(config),
        "machine": {**machine(), "load_before": load(), "load_after": None},
        "problems": {},
        "comparison": [],
        "alone": [],
    }
    if package is not None:
        found["machine"]["published"] = package.versions

    def write() -> None:
        found["machine"]["load_after"] = load()
        report.write(folder / "benchmark.json", found)

    with console.status("") as status:
        for name in config.problems:
            status.update(f"registering {name}")
            rows, problem = compare(
                name,
                config.steps,
                config.repeats,
                config.seed,
                package,
                folder,
                equation=name in config.package.equation,
            )
            found["problems"][name] = problem
            added = [row.mapping() for row in rows]
            found["comparison"] += [
                row
                | {"faster": report.ratios(added, row)}
                | {"lowest_cost": problem["did"][row["who"]]["lowest_cost"]}
                for row in added
            ]
            write()
        scope = Scope(
            config.steps,
            config.repeats,
            config.seed,
            config.free_points,
            config.hypotheses,
        )
        for name in config.alone:
            status.update(f"measuring {name}")
            for row in MEASURES[name](scope):
                found["alone"].append(row.mapping())
                write()
    write()
    return found


if __name__ == "__main__":
    main()
