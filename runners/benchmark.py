"""`python -m runners.benchmark`: time registrations, beside those of the published package.

With `against=REF`: time what a session and a program do, beside another checkout.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import DictConfig

from chsel.errors import require_choice, require_positive
from chsel.problem.settings import build_settings
from chsel.problem.streams import StreamKey
from replay.console import Console
from replay.environment import environment
from runners.benchmarks import benchmark_report
from runners.benchmarks.checkouts import ComparedRow, commit_of, comparison
from runners.benchmarks.compared_rows import GROUPS
from runners.benchmarks.registrations import MEASURES, PROBLEMS, Row, Scope, Steps, compare
from runners.command.program import command, plain
from runners.published_package.process import PackageConfig, PublishedPackage, interpreter
from runners.run.recording import make_run_folder, write_in_run_folder

_QUICK = ("anchored", "stages")  # rows of a short comparison


@dataclass(frozen=True)
class ComparedPackage(PackageConfig):
    """The published package, and which problems it registers by another cost, too."""

    skip: bool = False  # measure this library alone
    equation: tuple[str, ...] = ()  # by the paper's own free term: half a minute each time


@dataclass(frozen=True)
class BenchmarkConfig:
    """conf/benchmark.yaml, which has all defaults, checked."""

    problems: tuple[str, ...]  # which to register
    alone: tuple[str, ...]  # what else to measure of this library
    package: ComparedPackage
    steps: Steps
    logs: str
    repeats: int
    seed: int
    quick: bool
    against: str | None  # another checkout, to compare this one with it
    rows: tuple[str, ...]  # of that comparison

    def __post_init__(self) -> None:
        StreamKey(self.seed, 0)
        require_positive("repeats", self.repeats)
        for problem in (*self.problems, *self.package.equation):
            require_choice("problem", problem, accepted=PROBLEMS)
        for measure in self.alone:
            require_choice("alone", measure, accepted=MEASURES)
        for name in self.rows:
            require_choice("rows", name, accepted=GROUPS)

    def shortened(self) -> BenchmarkConfig:
        """Return a configuration of less than a minute, whose times are not to be quoted."""
        return replace(
            self,
            problems=("real_20",),
            alone=tuple(name for name in self.alone if name != "methods"),
            repeats=2,
            package=replace(self.package, equation=()),
            steps=Steps(restarts=1, adam=50, search=10, long_search=20),
            rows=tuple(name for name in self.rows if name in _QUICK),
        )


@command("benchmark")
def main(config: DictConfig) -> None:
    """Run the benchmark; what is measured so far is always in its files."""
    values = plain(config)
    checked = build_settings(BenchmarkConfig, values, where="benchmark")
    if checked.quick:
        checked = checked.shortened()
    torch.set_num_threads(1)
    console = Console(soft_wrap=True)
    if checked.against is not None:
        _compare_checkouts(checked, checked.against, values=values, console=console)
        return
    with ExitStack() as stack:
        package = None
        if not checked.package.skip:
            python = interpreter(checked.package, console.print)
            package = stack.enter_context(PublishedPackage(python))
        folder = _run_folder(checked, "drill", values=values)
        machine = _machine()
        if package is not None:
            machine["published"] = package.versions
        about: dict[str, Any] = {"settings": asdict(checked), "machine": machine}
        rows: list[Row] = []
        with console.status("") as status:
            for name, measured in _measures(checked, package):
                status.update(f"measuring {name}")
                for row in measured:
                    rows.append(row)
                    benchmark_report.write(folder, rows, about=about)
    _show(console, benchmark_report.page(rows, about), folder=folder)


def _compare_checkouts(
    config: BenchmarkConfig, against: str, *, values: dict[str, Any], console: Console
) -> None:
    """Measure this checkout and another one in turn; what is measured so far is in its files."""
    with comparison(against, config.repeats) as compared:
        folder = _run_folder(config, "checkouts", values=values)
        machine = _machine()
        checkouts = {name: commit_of(side.folder) for name, side in compared.sides.items()}
        about = {"settings": asdict(config), "machine": machine, "checkouts": checkouts}
        rows: list[ComparedRow] = []
        with console.status("") as status:
            for name in config.rows:
                status.update(f"measuring {name}")
                for row in GROUPS[name](compared):
                    rows.append(row)
                    machine["load at the end"] = os.getloadavg()[0]
                    benchmark_report.write_comparison(folder, rows, about=about)
    _show(console, benchmark_report.comparison_page(rows, about), folder=folder)


def _run_folder(config: BenchmarkConfig, name: str, *, values: dict[str, Any]) -> Path:
    folder = make_run_folder(Path(config.logs) / "benchmark", name)
    write_in_run_folder(folder / "config.yaml", yaml.safe_dump(values, sort_keys=False))
    return folder


def _machine() -> dict[str, Any]:
    # Processes that ran or waited on average over the last minute.
    return {**environment(), "cores": os.cpu_count(), "load": os.getloadavg()[0]}


def _show(console: Console, lines: list[str], *, folder: Path) -> None:
    for line in lines:
        console.print(line)
    for path in sorted(folder.iterdir()):
        console.print(f"written: {path}")


def _measures(
    config: BenchmarkConfig, package: PublishedPackage | None
) -> Iterator[tuple[str, Iterator[Row]]]:
    """Yield the measurements by name; rows are measured as they are taken."""
    scope = Scope(config.steps, config.repeats, seed=config.seed)
    for name in config.problems:
        yield name, compare(name, scope, package=package, equation=name in config.package.equation)
    for name in config.alone:
        yield name, MEASURES[name](scope)


if __name__ == "__main__":
    main()
