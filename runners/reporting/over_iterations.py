"""PD and cost over the iterations of quality-diversity search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from runners.reporting.evaluation_folder import Evaluation, Row
from runners.reporting.method_style import MethodStyle
from runners.reporting.panels import drawn, legend_of_methods, panels, positive_scale
from runners.reporting.section import NotDrawn, Picture, Table
from runners.reporting.statistics import grouped, spread
from runners.reporting.tables import method_table

_COLUMNS = {"diversity": "PD in mm²", "mean_cost": "mean relaxed cost of the best cells"}
_OWN_COST = "medial_constraint"  # of what these search, the cost is another one
Styles = Mapping[str, MethodStyle]


def picture_over_iterations(evaluation: Evaluation, styles: Styles, name: str) -> Picture:
    """Medians and quartiles over trials and steps; NotDrawn where nothing was measured."""
    rows = evaluation.iterations
    if not evaluation.iterations:
        raise NotDrawn(
            "no moments within registrations were measured; `python -m runners.evaluate "
            "experiment=paper_qd` measures them"
        )
    if not any(row.get(column) is not None for row in rows for column in _COLUMNS):
        raise NotDrawn("no moment within a registration has a number")
    shown = {m: style for m, style in styles.items() if any(row["method"] == m for row in rows)}
    alt = (
        "Plausible diversity and mean cost of the best cells over iterations of "
        f"{' and '.join(style.title for style in shown.values())}: medians with quartile bands."
    )
    return Picture(name, alt, drawn(lambda: _figure(rows, shown)))


def tables_over_iterations(evaluation: Evaluation, styles: Styles) -> tuple[Table, ...]:
    """Of both numbers."""
    titles = {"diversity": "PD in mm² by iteration", "mean_cost": "Mean cost by iteration"}
    tables = []
    for column, title in titles.items():
        rows = _comparable(evaluation.iterations, column)
        shown = {m: style for m, style in styles.items() if any(row["method"] == m for row in rows)}
        if any(row.get(column) is not None for row in rows):
            tables.append(
                method_table(
                    title, "iteration", rows, lambda row: row["iteration"], shown, column=column
                )
            )
    return tuple(tables)


def _comparable(rows: Sequence[Row], column: str) -> Sequence[Row]:
    """Without the costs that are of another kind."""
    if column != "mean_cost":
        return rows
    return [row for row in rows if not row["method"].startswith(_OWN_COST)]


def _figure(rows: Sequence[Row], styles: Styles) -> Figure:
    figure, axes = panels(2, columns=2, row_height=3.8)
    for panel, (column, label) in zip(axes, _COLUMNS.items(), strict=True):
        _draw(panel, _comparable(rows, column), styles, column)
        panel.set_ylabel(label)
        panel.set_xlabel("QD iterations")
    legend_of_methods(figure, list(styles.values()))
    return figure


def _draw(axes: Axes, rows: Sequence[Row], styles: Styles, column: str) -> None:
    values: list[float] = []
    by_method = grouped(rows, lambda row: row["method"])
    for place, (method, style) in enumerate(styles.items()):
        by_iteration = grouped(by_method.get(method, ()), lambda row: row["iteration"])
        spreads = {at: spread(some, column) for at, some in sorted(by_iteration.items())}
        spreads = {at: found for at, found in spreads.items() if found.count}
        if not spreads:
            continue
        quartiles = [found.quartiles for found in spreads.values()]
        lower, median, upper = (list(part) for part in zip(*quartiles, strict=True))
        values += [*lower, *upper]
        at = list(spreads)
        every = max(1, len(at) // 12)
        axes.fill_between(at, lower, upper, color=style.color, alpha=0.18, linewidth=0)
        axes.plot(
            at,
            median,
            color=style.color,
            linestyle=style.line,
            marker=style.marker,
            markevery=(place % every, every),
        )
    positive_scale(axes, values)
    axes.set_xlim(0.0, max((row["iteration"] for row in rows), default=1) or 1)
