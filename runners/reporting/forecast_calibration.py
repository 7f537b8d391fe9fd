"""Whether forecasts come true: chances of a hit, and the spread at which a session stops."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from runners.reporting.evaluation_folder import TRIAL
from runners.reporting.figures import NotDrawn, Picture, legend_of_methods, new_figure
from runners.reporting.method_style import MethodStyle
from runners.reporting.section import Section, Styles, drawn
from runners.reporting.statistics import shares
from runners.reporting.steered_sessions import SESSION, SteeredSessions
from runners.reporting.tables import Cell, Table, number

STOP_SPREADS = (0.020, 0.010, 0.005)  # metres
STOP_FACTOR = 1.5  # of the spread at which a session stops; an error above is a wrong stop
_ALL = "all"
_BINS = np.linspace(0.0, 1.0, 11)
_MM = 1000.0
_TOGETHER = MethodStyle("all, with 95 % intervals", "#cc3311", "", "-")


def forecast_calibration(sessions: SteeredSessions, styles: Styles) -> Section | None:
    """None without a session."""
    if not sessions.count:
        return None
    picture, missing = drawn(lambda: picture_of_hits(sessions, styles))
    text = (
        "Hits: the chance that was forecast for the chosen probe, and how often such probes met "
        "the object. Stops: where a session would have ended by the spread of its belief alone, at "
        "the first probe after which this is at most so much; it is a good stop if the error of "
        f"the set then is at most {STOP_FACTOR:g} times as much."
    )
    tables = (hits_table(sessions, styles), bins_table(sessions), stops_table(sessions, styles))
    title = "Calibration of forecasts and of stopping"
    return Section("forecast-calibration", title, text, picture, missing, tables)


def forecast_rows(sessions: SteeredSessions) -> pd.DataFrame:
    """The rows with a forecast and an outcome; `touched`: there was a contact before the probe."""
    rows = sessions.rows.sort_values([*SESSION, "probes"])
    before = rows.groupby(SESSION)["contacts"].shift(1).fillna(0.0)
    rows = rows.assign(touched=before.astype(float) > 0.0)
    return rows[rows["hit_forecast"].notna() & rows["hit"].notna()].astype({"hit": float})


def hits_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """Means of forecasts and outcomes by policy, before the first contact and after it."""
    rows = forecast_rows(sessions)
    groups = [(styles[policy].title, rows["policy"] == policy) for policy in sessions.policies]
    groups += [("all, before the first contact", ~rows["touched"])]
    groups += [("all, after it", rows["touched"]), (_ALL, rows["touched"].notna())]
    lines = [_hits_line(title, rows[own]) for title, own in groups if own.any()]
    header = ("policy", "probes", "forecast", "happened", "difference, points")
    note = "Means over probes; a positive difference means that more was forecast than happened."
    return Table("Chance of a hit, forecast and happened, %", header, tuple(lines), note=note)


def _hits_line(title: str, rows: pd.DataFrame) -> tuple[Cell, ...]:
    forecast, happened = 100.0 * rows["hit_forecast"].mean(), 100.0 * rows["hit"].mean()
    texts = (str(len(rows)), f"{forecast:.1f}", f"{happened:.1f}", f"{forecast - happened:+.1f}")
    return Cell(title), *(Cell(text) for text in texts)


def hit_bins(rows: pd.DataFrame) -> pd.DataFrame:
    """`shares` of hits by tenths of the forecast, with the mean `forecast` of each."""
    place = np.clip(np.digitize(rows["hit_forecast"], _BINS) - 1, 0, len(_BINS) - 2)
    rows = rows.assign(bin=place)
    found = shares(rows, "bin", "hit")
    return found.join(rows.groupby("bin")["hit_forecast"].mean().rename("forecast"))


def bins_table(sessions: SteeredSessions) -> Table:
    """A row for every tenth of the forecast."""
    lines = []
    for of in hit_bins(forecast_rows(sessions)).itertuples():
        name = f"{100.0 * _BINS[of.Index]:.0f} to {100.0 * _BINS[of.Index + 1]:.0f}"
        interval = f"[{100.0 * of.lower:.0f}, {100.0 * of.upper:.0f}]"
        happened = Cell(f"{100.0 * of.share:.0f}", between=interval)
        lines.append(
            (Cell(name), Cell(str(of.total)), Cell(f"{100.0 * of.forecast:.0f}"), happened)
        )
    header = ("forecast, %", "probes", "mean forecast", "happened [95 %]")
    return Table("Hits by their forecast, all policies", header, tuple(lines))


def first_stops(rows: pd.DataFrame, spread: float) -> pd.DataFrame:
    """Of each session the first row with at most this spread of the belief, metres."""
    narrow = rows[rows["spread"] <= spread].sort_values([*SESSION, "probes"])
    return narrow.drop_duplicates(SESSION)


def stops_table(sessions: SteeredSessions, styles: Styles) -> Table:
    """A row for every policy and spread at which it would stop."""
    header = ("policy", "stop at spread of", "sessions", "stopped", "probes, median")
    errors = ("error at most", "share [95 %]", "largest error")
    lines = []
    for spread in STOP_SPREADS:
        stops = first_stops(sessions.rows, spread)
        stops = stops.assign(good=stops["error"] <= STOP_FACTOR * spread, all=_ALL)
        groups = [(styles[policy].title, stops["policy"] == policy) for policy in sessions.policies]
        groups += [(_ALL, stops["error"].notna())]
        for title, own in groups:
            some = stops[own]
            if some.empty:
                continue
            of = shares(some, "all", "good").iloc[0]
            interval = f"[{100.0 * of['lower']:.0f}, {100.0 * of['upper']:.0f}]"
            total = sessions.count * (len(sessions.policies) if title == _ALL else 1)
            lines.append(
                (
                    Cell(title),
                    Cell(f"{_MM * spread:g} mm"),
                    Cell(str(total)),
                    Cell(str(len(some))),
                    Cell(number(float(some["probes"].median()))),
                    Cell(f"{_MM * STOP_FACTOR * spread:g} mm"),
                    Cell(f"{100.0 * of['share']:.1f} %", between=interval),
                    Cell(f"{_MM * some['error'].max():.1f} mm"),
                )
            )
    title = "Stopping by the spread of the belief"
    return Table(title, (*header, *errors), tuple(lines), labels=2)


def picture_of_hits(sessions: SteeredSessions, styles: Styles) -> Picture:
    """How often probes hit over the chance that was forecast; NotDrawn without a forecast."""
    rows = forecast_rows(sessions)
    if rows.empty:
        raise NotDrawn("no probe has a forecast")
    figure = new_figure(5.0)
    axes = figure.add_subplot(xlabel="forecast chance of a hit, %", ylabel="hits, %")
    axes.plot([0.0, 100.0], [0.0, 100.0], color="#222222", linewidth=1.0, linestyle=":")
    axes.set_xlim(-2.0, 102.0)
    axes.set_ylim(-2.0, 102.0)
    data, shown = [], []
    for policy in sessions.policies:
        own = rows[rows["policy"] == policy]
        if own.empty:
            continue
        found, style = hit_bins(own), styles[policy]
        looks: Any = {"color": style.color, "marker": style.marker, "linestyle": style.line}
        axes.plot(100.0 * found["forecast"], 100.0 * found["share"], linewidth=0.8, **looks)
        shown.append(style)
        data.append(found.reset_index().assign(policy=policy))
    found = hit_bins(rows)
    percent = 100.0 * found[["forecast", "share", "lower", "upper"]]
    below, above = percent["share"] - percent["lower"], percent["upper"] - percent["share"]
    bars: Any = {"yerr": [below.clip(lower=0.0), above.clip(lower=0.0)], "color": _TOGETHER.color}
    axes.errorbar(
        percent["forecast"], percent["share"], linewidth=2.4, elinewidth=1.0, capsize=3.0, **bars
    )
    data.append(found.reset_index().assign(policy=_ALL))
    shown.append(_TOGETHER)
    legend_of_methods(figure, shown)
    trials = rows.groupby(TRIAL).ngroups
    alt = f"Hits over their forecast chance, {len(rows)} probes in {trials} trials."
    return Picture("hit_forecasts", alt, figure, pd.concat(data))
