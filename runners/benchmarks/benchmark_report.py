"""What a benchmark found: as JSON, drawn, and as a page of tables; docs/speed.md is one."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from runners.benchmarks.pd_over_time import PD
from runners.benchmarks.registrations import OURS, PACKAGE, SIZES, WHAT
from runners.benchmarks.timing import Row
from runners.reporting.figures import Picture, new_figure, positive_scale
from runners.reporting.tables import number
from runners.run.recording import write_in_run_folder

_COMPARED = "registration"
_VERSIONS = ("numpy", "torch", "numba")
_COLORS = ("#0b3c5d", "#1b6ca8", "#7db8e0", "#a8d5a2", "#5fae57", "#2f7a34", "#d1603d", "#8c3a22")
_LABELS = [one if one in SIZES else f"ours, {one}" for one in OURS]
_STYLE = dict(zip([*_LABELS, PACKAGE, f"{PACKAGE}, Eq. 8"], _COLORS, strict=True))


def write(folder: Path, rows: Sequence[Row], about: Mapping[str, Any]) -> None:
    """All numbers as benchmark.json, and speed.md. about: machine and settings."""
    report = {**about, "rows": [row.mapping() for row in rows]}
    write_in_run_folder(folder / "benchmark.json", json.dumps(report, indent=2) + "\n")
    lines = ["# Speed", "", "Written by `python -m runners.benchmark`.", "", *page(rows, about)]
    write_in_run_folder(folder / "speed.md", "\n".join(lines) + "\n")


def page(rows: Sequence[Row], about: Mapping[str, Any]) -> list[str]:
    """The tables in Markdown, which a terminal shows as well."""
    lines = list(_machine(about["machine"]))
    compared = [row for row in rows if row.measure == _COMPARED]
    if compared:
        lines += [WHAT, "", "One registration in ms; x: how many times as long the package takes"]
        lines += ["cost: of the best pose, by Eq. 7 with nearest lookup for all", ""]
        lines += [*_table(_comparison(compared)), ""]
    alone = [row for row in rows if row.measure != _COMPARED]
    if alone:
        lines += ["This library alone: median and quartiles", ""]
        lines += [*_table([_cells(row) for row in alone]), ""]
    return lines


def slower(rows: Sequence[Row], row: Row, package: str) -> float | None:
    """How many times as long as one of ours the package takes on the same problem."""
    beside = [other for other in rows if (other.case, other.who) == (row.case, package)]
    if row.who.startswith(PACKAGE) or not beside:
        return None
    return beside[0].median / row.median


def _machine(machine: Mapping[str, Any]) -> Iterator[str]:
    yield (
        f"{machine['processor']}, {machine['cores_usable']} of {machine['cores']} cores usable, "
        f"load {machine['load_before']} before, {machine['load_after']} after"
    )
    yield ""
    versions = [f"{name} {machine[f'package {name}']}" for name in _VERSIONS]
    yield ", ".join([f"Python {machine['python']}", *versions])
    yield ""
    if "published" in machine:
        published = ", ".join(f"{name} {value}" for name, value in machine["published"].items())
        yield from (f"package: {published}", "")


def _comparison(rows: Sequence[Row]) -> list[dict[str, str]]:
    packages = [who for who in dict.fromkeys(row.who for row in rows) if who.startswith(PACKAGE)]
    lines = []
    for row in rows:
        line = {"problem": row.case, "registration": row.who}
        line |= {"median": number(row.median), "quartiles": _quartiles(row)}
        for package in packages:
            ratio = slower(rows, row, package)
            heading = package.replace(PACKAGE, "x").replace(",", "")
            line[heading] = "" if ratio is None else number(ratio)
        lines.append(line | {"cost": "" if row.cost is None else number(row.cost)})
    return lines


def _cells(row: Row) -> dict[str, str]:
    about = {"measure": row.measure, "case": row.case, "method": row.who}
    numbers = {"median": number(row.median), "quartiles": _quartiles(row), "unit": row.unit}
    return about | numbers


def _quartiles(row: Row) -> str:
    return "-".join(map(number, row.quartiles)) if len(row.samples) > 1 else ""


def _table(lines: Sequence[Mapping[str, str]]) -> list[str]:
    """A table of Markdown whose columns are as wide as their widest cell."""
    cells = [list(lines[0]), *(list(line.values()) for line in lines)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    rows = [" | ".join(map(str.ljust, row, widths)) for row in cells]
    rows.insert(1, "-|-".join("-" * width for width in widths))
    return [f"| {row} |" for row in rows]


def picture_of_benchmark(rows: Sequence[Row]) -> Picture | None:
    """Bars of times by problem, and PD over time; None if neither was measured."""
    table = pd.DataFrame([row.mapping() for row in rows])
    parts = []
    for measure, draw in ((_COMPARED, _draw_times), (PD, _draw_curves)):
        own = table[table["measure"] == measure] if len(table) else table
        if len(own):
            parts.append((draw, own))
    if not parts:
        return None
    figure = new_figure(1.0 + 4.2 * len(parts))
    for place, (draw, own) in enumerate(parts):
        draw(figure.add_subplot(len(parts), 1, place + 1), own)
    columns = ["case", "who", "measure", "at", "median", "lower_quartile", "upper_quartile"]
    alt = "Milliseconds of a registration by problem, and plausible diversity over them."
    return Picture("benchmark", alt, figure, pd.concat([own for _, own in parts])[columns])


def _draw_times(axes: Axes, rows: pd.DataFrame) -> None:
    """Bars of medians with their quartiles."""
    problems = list(rows["case"].unique())
    names = [who for who in _STYLE if (rows["who"] == who).any()]
    width = 0.8 / len(names)
    for place, who in enumerate(names):
        own = rows[rows["who"] == who]
        x = own["case"].map(problems.index) + (place - (len(names) - 1) / 2) * width
        quartiles = own[["lower_quartile", "upper_quartile"]].to_numpy()
        spread = np.abs(quartiles - own[["median"]].to_numpy()).T
        axes.bar(x, own["median"], width, color=_STYLE[who], yerr=spread, label=who)
    positive_scale(axes, rows["median"])
    axes.set_xticks(range(len(problems)), problems)
    axes.set_ylabel("ms, median and quartiles")
    axes.set_xlabel("problem: size of the drill, contacts")
    axes.legend(ncols=len(names), fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _draw_curves(axes: Axes, rows: pd.DataFrame) -> None:
    """PD over the time of a registration, a line for each method; each dot is an effort."""
    for index, (who, own) in enumerate(rows.groupby("who", sort=False)):
        own = own.sort_values("at")
        axes.plot(own["at"], own["median"], "o-", color=f"C{index}", label=who)
    positive_scale(axes, rows["at"], axis="x")
    positive_scale(axes, rows["median"])
    axes.set_xlabel("ms of a registration, median")
    axes.set_ylabel("PD in mm², geometric mean")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
