"""How long decisions and registrations take, by policy."""

from __future__ import annotations

import pandas as pd

from runners.reporting.section import Section, Styles
from runners.reporting.steered_sessions import SteeredSessions
from runners.reporting.tables import Cell, Table, number

_MS = 1000.0


def decision_times(sessions: SteeredSessions, styles: Styles) -> Section | None:
    """A table; None without a session."""
    if not sessions.count:
        return None
    text = (
        "Wall-clock time on one thread, after a warm-up, of choosing the next probe, of the "
        "registration before it, and of both together. Several workers on one machine slow each "
        "other down."
    )
    table = times_table(sessions, styles)
    return Section("decision-times", "Time per decision and registration", text, tables=(table,))


def times_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """Median and 95th percentile of milliseconds, a row for every policy."""
    rows = sessions.rows
    both = rows["seconds"] + rows["decision_seconds"].fillna(0.0)
    times = rows.assign(both=both)
    columns = {"decision_seconds": "decision", "seconds": "registration", "both": "both"}
    header = ("policy", *(f"{name}, {kind}" for name in columns.values() for kind in _KINDS))
    lines = [
        (
            Cell(styles[policy].title),
            *(cell for column in columns for cell in _cells(times, policy, column)),
        )
        for policy in sessions.policies
    ]
    return Table("Milliseconds a probe, medians and 95th percentiles", header, tuple(lines))


_KINDS = ("median", "p95")


def _cells(times: pd.DataFrame, policy: str, column: str) -> list[Cell]:
    values = _MS * times.loc[times["policy"] == policy, column].dropna().astype(float)
    return [Cell(number(float(values.quantile(share)))) for share in (0.5, 0.95)]
