"""Texts for people about a session and its results."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import yaml

from chsel.events import SessionStarted
from chsel.problem.noise import FREEDOMS
from chsel.problem.registration_problem import VERDICTS, Hypotheses, Trust
from replay.colors import CostScale, number
from replay.rerun.scene import shown_hypotheses

COLORS = """
| in the scene | colour |
|---|---|
| contacts | red |
| free space, of the last probe | blue, bright |
| occupied, other known points | orange, violet |
| gripper, its paths before | white, grey |
| object at its true pose | white |
| hypotheses by cost | yellow: lowest; green; violet: highest |
| actions by score | pale: best; brown: worst; grey: not possible |
| next action, contacts it forecasts | cream, pink |
"""


class _Dumper(yaml.SafeDumper):
    """A dumper of YAML that writes an object out at each of its places."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def session_markdown(started: SessionStarted) -> str:
    """Return a table that says what was run, then the whole configuration, then where it ran."""
    preset = _find(started.config, "preset")
    rows = {
        "object": started.object,
        "session": started.session,
        "method": f"{started.method}, preset {preset}" if preset else started.method,
        "seed": started.seed,
        "true pose": "known" if started.world_from_object is not None else "unknown",
        "policy": _find(started.config, "policy"),
        "problems of": f"recording {started.source}" if started.source else "",
    }
    lines = [f"| {name} | **{literal(text)}** |" for name, text in rows.items() if text != ""]
    parts = ["\n".join([lines[0], "|---|---|", *lines[1:]])]
    for title, mapping in (("Configuration", started.config), ("Environment", started.environment)):
        if mapping:
            text = yaml.dump(dict(mapping), Dumper=_Dumper, sort_keys=False)
            fence = "`" * (1 + max([2, *map(len, re.findall("`+", text))]))
            parts.append(f"**{title}**\n{fence}\n{text}{fence}")
    return "\n\n".join(parts) + "\n"


def costs_markdown(hypotheses: Hypotheses, scale: CostScale | None = None) -> str:
    """Return how many hypotheses are drawn, and the costs at the ends of their colours."""
    shown = shown_hypotheses(hypotheses)
    scale = scale or CostScale.of(hypotheses.cost[shown])
    colors = f"cost {number(scale.low)} (yellow) to {number(scale.high)} (violet)"
    return f"{len(shown)} of {len(hypotheses.cost)} hypotheses drawn; {colors}"


def verdict_markdown(values: Mapping[str, float], known: int) -> str:
    """Return how far to trust a result, by its numbers: the verdict large; "" without one.

    known: the number of points of known signed distance.
    """
    names = ("estimated_noise", "outlier_share", "misfit", "modes", "set_spread", "verdict")
    noise, outliers, misfit, modes, spread, verdict = (values.get(n, math.nan) for n in names)
    if verdict not in range(len(VERDICTS)) or not math.isfinite(modes):
        return ""
    named = VERDICTS[int(verdict)]
    redundancy = max(known - FREEDOMS, 0)
    trust = Trust(
        noise=noise,
        outliers=outliers,
        misfit=misfit,
        modes=int(modes),
        spread=spread,
        verdict=named,
        redundancy=redundancy,
        limit=values.get("spread_limit"),
        centre_within=values.get("centre_within"),
        turn_within=values.get("turn_within"),
    )
    _, _, reasons = str(trust).partition("(")
    return f"# {trust.verdict}\n\n{reasons.replace(')', '')}\n"


def literal(text: Any) -> str:
    """Return text that Markdown takes for nothing else."""
    return re.sub(r"([\\`*_\[\]<>|#~$&])", r"\\\1", str(text))


def _find(config: Mapping[str, Any], name: str) -> Any:
    """Return the choice of a group of the configuration or of its group `method`, or ""."""
    method = config.get("method")
    found = config.get(name) or (method.get(name) if isinstance(method, Mapping) else None)
    return (found.get("name") if isinstance(found, Mapping) else found) or ""
