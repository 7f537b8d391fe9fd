"""What a benchmark found: tables on the terminal and in Markdown, and the same numbers as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

from rich.box import MARKDOWN, SIMPLE_HEAD, Box
from rich.table import Table

from replay.console import Console
from runners.run.recording import write_in_run_folder

Values = Mapping[str, Any]
_PACKAGE = "package"  # begins the names of its registrations
_MEASURE_WIDTH = 12  # characters, on the terminal
_PAGE_WIDTH = 160  # characters: no table is wider


def write(path: Path, report: Values) -> None:
    """The report as JSON."""
    write_in_run_folder(path, json.dumps(report, indent=2) + "\n")


def show(console: Console, report: Values, box: Box = SIMPLE_HEAD) -> None:
    """The report as tables."""
    for line in _machine(report["machine"]):
        console.print(line, soft_wrap=True)
        console.print()
    if report["comparison"]:
        console.print(report["what"], soft_wrap=box is MARKDOWN)
        console.print()
        _show_comparison(console, report["comparison"], box)
        _show_calls(console, report["problems"])
    if report["alone"]:
        _show_alone(console, report["alone"], box)


def write_markdown(path: Path, report: Values) -> None:
    """The same tables as a page: docs/speed.md is one of them."""
    page = StringIO()
    show(Console(file=page, width=_PAGE_WIDTH), report, MARKDOWN)
    lines = [line.rstrip() for line in page.getvalue().splitlines()]
    lines = ["# Speed", "", "Written by `python -m runners.benchmark`.", "", *lines, ""]
    write_in_run_folder(path, "\n".join(lines))


def number(value: float) -> str:
    """Three digits that count, without an exponent."""
    for digits, limit in ((3, 1.0), (2, 10.0), (1, 100.0)):
        if abs(value) < limit:
            return f"{value:.{digits}f}"
    return f"{value:.0f}"


def ratios(rows: Sequence[Values], row: Values) -> dict[str, float]:
    """How many times as long as the median of one of ours those of the packages' rows are."""
    if row["who"].startswith(_PACKAGE):
        return {}
    beside = {r["who"]: r["median"] for r in rows if r["case"] == row["case"]}
    packages = [who for who in beside if who.startswith(_PACKAGE)]
    return {who: beside[who] / row["median"] for who in packages}


def _machine(machine: Values) -> list[str]:
    packages = ("numpy", "torch", "numba")
    versions = ", ".join(f"{name} {machine[f'package {name}']}" for name in packages)
    lines = [
        f"{machine['processor']}, {machine['cores_usable']} of {machine['cores']} cores usable, "
        f"load {machine['load_before']} before, {machine['load_after']} after",
        f"Python {machine['python']}, {versions}",
    ]
    if "published" in machine:
        published = ", ".join(f"{name} {value}" for name, value in machine["published"].items())
        lines.append(f"package: {published}")
    return lines


def _show_comparison(console: Console, rows: Sequence[Values], box: Box) -> None:
    packages = list(dict.fromkeys(who for row in rows for who in row["faster"]))
    title = "one registration in ms"
    if packages:
        title += "; x: how many times as long the package takes, with its own cost and with Eq. 8"
    for line in (title, "cost: of the best pose, by Eq. 7 with nearest lookup for all", ""):
        console.print(line, soft_wrap=True)
    table = Table(box=box, show_edge=box is MARKDOWN, collapse_padding=True)
    for name in ("problem", "registration"):
        table.add_column(name, no_wrap=True)
    ratio_names = [who.replace("package", "x").replace("x, ", "x ") for who in packages]
    for name in ("median", "quartiles", *ratio_names, "cost"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        times = [number(row["faster"][who]) if who in row["faster"] else "" for who in packages]
        cells = [row["case"], row["who"], number(row["median"]), _quartiles(row)]
        table.add_row(*cells, *times, number(row["lowest_cost"]))
    console.print(table)


def _show_calls(console: Console, problems: Mapping[str, Values]) -> None:
    """How often the package asked for its cost: twice an iteration of the search, once a step.

    And how many poses the descents of CHSEL evaluated, in each preset.
    """
    lines = []
    for name, problem in problems.items():
        did = problem["did"]
        descended = {who: one.get("poses_descended", 0) for who, one in did.items()}
        counts = [f"{who.removeprefix('ours, ')} {n}" for who, n in descended.items() if n]
        calls = ""
        if "package" in did:
            calls = f"; cost calls of the package {did['package']['cost_calls']}"
        lines.append(f"{name}: {', '.join(counts)}{calls}")
    for line in ("", "poses evaluated in descents, counted:", "", *lines, ""):
        console.print(f"- {line}" if line in lines else line, soft_wrap=True)


def _show_alone(console: Console, rows: Sequence[Values], box: Box) -> None:
    console.print("this library alone: median and quartiles")
    console.print()
    table = Table(box=box, show_edge=box is MARKDOWN, collapse_padding=True)
    table.add_column("measure", max_width=None if box is MARKDOWN else _MEASURE_WIDTH)
    table.add_column("case")
    table.add_column("method", no_wrap=True)
    for name in ("median", "quartiles", ""):
        table.add_column(name, justify="right")
    previous = ""
    for row in rows:
        repeated = row["measure"] == previous and box is not MARKDOWN
        measure = "" if repeated else row["measure"]
        previous = row["measure"]
        cells = [measure, row["case"], row["who"], number(row["median"])]
        table.add_row(*cells, _quartiles(row), row["unit"])
    console.print(table)


def _quartiles(row: Values) -> str:
    if len(row["samples"]) == 1:
        return ""
    return f"{number(row['lower_quartile'])}-{number(row['upper_quartile'])}"
