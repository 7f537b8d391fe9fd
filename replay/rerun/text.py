"""What a session is, as text for people."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import yaml

from chsel.problem.noise import FREEDOMS
from chsel.problem.registration_problem import VERDICTS, Trust
from replay.events import SessionStarted


class _Dumper(yaml.SafeDumper):
    """Writes a value out each time, also where one object stands in two places."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


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
    if policy := _find(started.config, "policy"):
        rows["policy"] = policy
    if started.source:
        rows["problems of"] = f"recording {started.source}"
    lines = [f"| {name} | **{_literal(text)}** |" for name, text in rows.items()]
    table = [lines[0], "|---|---|", *lines[1:]]
    parts = ["\n".join(table)]
    for title, mapping in (("Configuration", started.config), ("Environment", started.environment)):
        if mapping:
            text = yaml.dump(dict(mapping), Dumper=_Dumper, sort_keys=False)
            fence = "`" * (1 + max([2, *map(len, re.findall("`+", text))]))
            parts.append(f"**{title}**\n{fence}\n{text}{fence}")
    return "\n\n".join(parts) + "\n"


def verdict_markdown(values: Mapping[str, float], known: int) -> str:
    """How far to trust a result, by its measured values: the verdict large; "" without one.

    known: the number of points of known signed distance.
    """
    names = ("estimated_noise", "outlier_share", "misfit", "modes", "set_spread", "verdict")
    noise, outliers, misfit, modes, spread, verdict = (values.get(n, math.nan) for n in names)
    if verdict not in range(len(VERDICTS)) or not math.isfinite(modes):
        return ""
    named, redundancy = VERDICTS[int(verdict)], max(known - FREEDOMS, 0)
    trust = Trust(noise, outliers, misfit, int(modes), spread, named, redundancy)
    _, _, reasons = str(trust).partition("(")
    return f"# {trust.verdict}\n\n{reasons.rstrip(')')}\n"


def _literal(text: Any) -> str:
    """Text that Markdown takes for nothing else."""
    return re.sub(r"([\\`*_\[\]<>|#~$&])", r"\\\1", str(text))


def _find(config: Mapping[str, Any], name: str) -> Any:
    """The choice of a group at the top of the configuration, or in its group `method`."""
    method = config.get("method")
    found = config.get(name) or (method.get(name) if isinstance(method, Mapping) else None)
    return found.get("name") if isinstance(found, Mapping) else found
