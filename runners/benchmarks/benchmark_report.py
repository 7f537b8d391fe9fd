"""The results of a benchmark as JSON, and as a page of tables; docs/speed.md is one."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from runners.benchmarks.checkouts import ComparedRow
from runners.benchmarks.registrations import PACKAGE, WHAT, Row
from runners.reporting.tables import number
from runners.run.recording import write_in_run_folder

_COMPARED = "registration"
_VERSIONS = ("numpy", "torch", "numba")
_WRITTEN = (
    "Written by `python -m runners.benchmark`. `python -m runners.benchmark against=REF` compares "
    "this code with that of another revision or folder, in turn: sessions and commands, too."
)
COMPARED = (
    "Medians of pairs that were measured in turn. ratio: how many times as fast this checkout is "
    "as the other one, or how many times as small, by pair: median and quartiles. processor: time "
    "of the process and those it started, one thread each; wall: by the clock. costs: of the best "
    "pose by the other and by this checkout, by Eq. 7 with nearest lookup."
)


def write(folder: Path, rows: Sequence[Row], *, about: Mapping[str, Any]) -> None:
    """Write all numbers as benchmark.json, and speed.md. about: machine and settings."""
    report = {**about, "rows": [row.mapping() for row in rows]}
    write_in_run_folder(folder / "benchmark.json", json.dumps(report, indent=2) + "\n")
    lines = ["# Speed", "", _WRITTEN, "", *page(rows, about)]
    write_in_run_folder(folder / "speed.md", "\n".join(lines) + "\n")


def page(rows: Sequence[Row], about: Mapping[str, Any]) -> list[str]:
    """Return the tables in Markdown, which a terminal shows as well."""
    machine = about["machine"]
    lines = _machine(machine)
    if "published" in machine:
        published = ", ".join(f"{name} {value}" for name, value in machine["published"].items())
        lines += [f"package: {published}", ""]
    compared = [row for row in rows if row.measure == _COMPARED]
    if compared:
        lines += [WHAT, "", "One registration in ms; x: how many times as long the package takes"]
        lines += ["cost: of the best pose, by Eq. 7 with nearest lookup for all", ""]
        lines += [*_table(_comparison(compared)), ""]
    alone = [row for row in rows if row.measure != _COMPARED]
    if alone:
        lines += ["This library alone: median and quartiles", ""]
        cells = [
            {"measure": row.measure, "case": row.case, "method": row.who, **_numbers(row)}
            | {"unit": row.unit}
            for row in alone
        ]
        lines += [*_table(cells), ""]
    return lines


def write_comparison(
    folder: Path, rows: Sequence[ComparedRow], *, about: Mapping[str, Any]
) -> None:
    """Write all numbers of a comparison as benchmark.json, and comparison.md."""
    report = {**about, "rows": [row.mapping() for row in rows]}
    write_in_run_folder(folder / "benchmark.json", json.dumps(report, indent=2) + "\n")
    text = "\n".join(["# Two checkouts", "", *comparison_page(rows, about)]) + "\n"
    write_in_run_folder(folder / "comparison.md", text)


def comparison_page(rows: Sequence[ComparedRow], about: Mapping[str, Any]) -> list[str]:
    """Return the table of two checkouts in Markdown."""
    checkouts = ", ".join(f"{name}: {commit}" for name, commit in about["checkouts"].items())
    lines = [*_machine(about["machine"]), checkouts, "", COMPARED, ""]
    if rows:
        lines += [*_table([_compared(row) for row in rows]), ""]
    missing = dict.fromkeys(f"{row.case}: {row.missing}" for row in rows if row.missing)
    return [*lines, *(line for text in missing for line in (text, ""))]


def _compared(row: ComparedRow) -> dict[str, str]:
    line = {"measure": row.case, "unit": row.unit, "of": row.clock}
    for name, readings in (("other", row.other), ("this", row.this)):
        line[name] = number(float(np.median(row.numbers(readings)))) if readings else "-"
    ratios = row.ratios.tolist()
    quartiles = np.quantile(ratios, [0.25, 0.75]).tolist() if len(ratios) > 1 else []
    return {
        **line,
        "ratio": number(float(np.median(ratios))) if ratios else "",
        "quartiles": "-".join(map(number, quartiles)),
        "pairs": str(len(ratios)),
        "costs": ", ".join(map(number, row.costs)),
    }


def _machine(machine: Mapping[str, Any]) -> list[str]:
    load = f"load {machine['load']:.2f}"
    if "load at the end" in machine:
        load += f", {machine['load at the end']:.2f} at the end"
    versions = [f"{name} {machine[f'package {name}']}" for name in _VERSIONS]
    lines = [f"{machine['processor']}, {machine['cores']} cores, {load}", ""]
    return [*lines, ", ".join([f"Python {machine['python']}", *versions]), ""]


def slower(rows: Sequence[Row], row: Row, *, package: str) -> float | None:
    """Return how many times as long as one of ours the package takes on the same problem."""
    beside = [other for other in rows if (other.case, other.who) == (row.case, package)]
    if row.who.startswith(PACKAGE) or not beside:
        return None
    return beside[0].median / row.median


def _comparison(rows: Sequence[Row]) -> list[dict[str, str]]:
    packages = [who for who in dict.fromkeys(row.who for row in rows) if who.startswith(PACKAGE)]
    lines = []
    for row in rows:
        line = {"problem": row.case, "registration": row.who, **_numbers(row)}
        for package in packages:
            ratio = slower(rows, row, package=package)
            heading = package.replace(PACKAGE, "x").replace(",", "")
            line[heading] = "" if ratio is None else number(ratio)
        lines.append(line | {"cost": "" if row.cost is None else number(row.cost)})
    return lines


def _numbers(row: Row) -> dict[str, str]:
    quartiles = "-".join(map(number, row.quartiles)) if len(row.samples) > 1 else ""
    return {"median": number(row.median), "quartiles": quartiles}


def _table(lines: Sequence[Mapping[str, str]]) -> list[str]:
    """Return a table of Markdown whose columns are as wide as their widest cell."""
    cells = [list(lines[0]), *(list(line.values()) for line in lines)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    rows = [" | ".join(map(str.ljust, row, widths)) for row in cells]
    rows.insert(1, "-|-".join("-" * width for width in widths))
    return [f"| {row} |" for row in rows]
