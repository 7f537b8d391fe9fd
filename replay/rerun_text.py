"""What a session is, as text for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from replay.events import SessionStarted


def session_markdown(started: SessionStarted) -> str:
    """A table that says what was run, then the whole configuration, then where it ran."""
    preset = _find(started.config, "preset")
    rows = {
        "object": started.object,
        "session": started.session,
        "method": f"{started.method}, preset {preset}" if preset else started.method,
        "seed": started.seed,
        "true pose": "known" if started.world_from_object is not None else "unknown",
    }
    lines = [f"| {name} | **{text}** |" for name, text in rows.items()]
    table = [lines[0], "|---|---|", *lines[1:]]
    parts = ["\n".join(table)]
    for title, mapping in (("Configuration", started.config), ("Environment", started.environment)):
        if mapping:
            parts.append(f"**{title}**\n```\n" + "\n".join(_indented(mapping)) + "\n```")
    return "\n\n".join(parts) + "\n"


def _find(config: Mapping[str, Any], name: str) -> Any:
    """The choice of a group at the top of the configuration, or in its group `method`."""
    method = config.get("method")
    found = config.get(name) or (method.get(name) if isinstance(method, Mapping) else None)
    return found.get("name") if isinstance(found, Mapping) else found


def _indented(value: Any, depth: int = 0) -> list[str]:
    """Nested mappings as indented lines of `key: value`."""
    lines: list[str] = []
    for key, inner in value.items():
        start = "  " * depth + f"{key}:"
        if isinstance(inner, Mapping) and inner:
            lines += [start, *_indented(inner, depth + 1)]
        else:
            lines.append(f"{start} {_plain(inner)}")
    return lines


def _plain(value: Any) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(_plain(item) for item in value) + "]"
    return "-" if value is None else str(value)
