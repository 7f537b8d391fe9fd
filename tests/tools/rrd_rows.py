"""Rerun recordings, read back with Rerun's own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rerun.blueprint.components import PlayState
from rerun.chunk import RrdReader

Row = tuple[dict[str, int], dict[str, Any]]
"""Times by timeline, and values by component."""


def read(path: Path, *, blueprint: bool = False) -> dict[str, list[Row]]:
    """All rows of a recording, or of its one layout, by entity, as they were logged."""
    reader, rows = RrdReader(path), dict[str, list[tuple[bytes, Row]]]()
    (store,) = reader.blueprints() if blueprint else reader.recordings()
    for chunk in reader.stream(store=store).to_chunks():
        batch = chunk.to_record_batch()
        for row in batch.to_pylist():
            times = {name: row.pop(name) for name in chunk.timeline_names}
            key = row.pop("rerun.controls.RowId")
            values = {name: value for name, value in row.items() if value is not None}
            rows.setdefault(chunk.entity_path, []).append((key, (times, values)))
    return {
        entity: [row for _, row in sorted(pairs, key=lambda pair: pair[0])]
        for entity, pairs in rows.items()
    }


def at_probe(rows: list[Row], step: int) -> list[dict[str, Any]]:
    return [values for times, values in rows if times.get("probe") == step]


def shown_at(rows: list[Row], step: int) -> dict[str, Any]:
    """What a view shows at a probe: the last value of each component, or the one that stays."""
    shown: dict[str, Any] = {}
    for times, values in rows:
        shown |= values if times.get("probe", step) <= step else {}
    return shown


def until_probe(rows: list[Row], step: int) -> list[dict[str, Any]]:
    """What a view at a probe draws from: the last value counts."""
    return [values for times, values in rows if times.get("probe", step + 1) <= step]


def last_layout(path: Path) -> list[dict[str, Any]]:
    """The rows of the blueprint that counts."""
    reader, layouts = RrdReader(path), []
    for store in reader.blueprints():
        batches = [chunk.to_record_batch() for chunk in reader.stream(store=store).to_chunks()]
        rows = [row for batch in batches for row in batch.to_pylist()]
        layouts.append((min(row["rerun.controls.RowId"] for row in rows), rows))
    return max(layouts, key=lambda layout: layout[0])[1]


def views_of_the_last_layout(path: Path) -> set[str]:
    """Their titles."""
    rows = last_layout(path)
    return {name for row in rows for name in row.get("ViewBlueprint:display_name") or ()}


def opens_at(path: Path) -> tuple[str, PlayState]:
    """The timeline that the viewer shows first, and whether it follows what comes."""
    panel = {name: value for row in last_layout(path) for name, value in row.items() if value}
    (timeline,), (state,) = (panel[f"TimePanelBlueprint:{n}"] for n in ("timeline", "play_state"))
    return timeline, PlayState(state)
