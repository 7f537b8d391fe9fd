"""Rerun recordings, read back with Rerun's own reader."""

from typing import Any

from rerun.blueprint.components import PlayState
from rerun.chunk import RrdReader

Row = tuple[dict[str, int], dict[str, Any]]
"""Times by timeline, and values by component."""
_ID = "rerun.controls.RowId"


def _batches(reader, store):
    for chunk in reader.stream(store=store).to_chunks():
        yield chunk, chunk.to_record_batch().to_pylist()


def read(path, *, blueprint=False):
    """All rows of a recording, or of its one layout, by entity, as they were logged."""
    reader = RrdReader(path)
    found = {}
    (store,) = reader.blueprints() if blueprint else reader.recordings()
    for chunk, rows in _batches(reader, store):
        for row in rows:
            times = {name: row.pop(name) for name in chunk.timeline_names}
            key = row.pop(_ID)
            values = {name: value for name, value in row.items() if value is not None}
            found.setdefault(chunk.entity_path, []).append((key, (times, values)))
    ordered = {entity: sorted(pairs, key=lambda pair: pair[0]) for entity, pairs in found.items()}
    return {entity: [row for _, row in pairs] for entity, pairs in ordered.items()}


def at_probe(rows, step):
    return [values for times, values in rows if times.get("probe") == step]


def shown_at(rows, step):
    """What a view shows at a probe: the last value of each component, or the one that stays."""
    shown = {}
    for times, values in rows:
        shown |= values if times.get("probe", step) <= step else {}
    return shown


def last_layout(path):
    """The rows of the blueprint that counts."""
    reader = RrdReader(path)
    layouts = [
        [row for _, rows in _batches(reader, store) for row in rows]
        for store in reader.blueprints()
    ]
    return max(layouts, key=lambda rows: min(row[_ID] for row in rows))


def views_of_the_last_layout(path):
    """Their titles."""
    rows = last_layout(path)
    return {name for row in rows for name in row.get("ViewBlueprint:display_name") or ()}


def opens_at(path):
    """The timeline that the viewer shows first, and whether it follows what comes."""
    panel = {name: value for row in last_layout(path) for name, value in row.items() if value}
    (timeline,), (state,) = (panel[f"TimePanelBlueprint:{n}"] for n in ("timeline", "play_state"))
    return timeline, PlayState(state)
