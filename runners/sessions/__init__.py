"""Sources of known points: one file a kind, and the registry of all kinds by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from chsel.errors import require_choice
from chsel.problem.settings import build_settings
from runners.objects.loader import ObjectModel
from runners.sessions.bop import BOP
from runners.sessions.points import POINTS
from runners.sessions.probing import PROBING
from runners.sessions.recorded import RECORDED
from runners.sessions.sensors import SENSORS
from runners.sessions.source import ObjectOrigin, ProbeSource, SourceKind

KINDS: Mapping[str, SourceKind] = {
    **PROBING,
    "points": POINTS,
    "bop": BOP,
    "recorded": RECORDED,
    "sensors": SENSORS,
}
"""All kinds of sources, the choices of `session=`."""


def source_kind(name: Any) -> SourceKind:
    """Return the kind of this name. Raise SettingError if there is none."""
    require_choice("session.kind", name, accepted=KINDS)
    return KINDS[name]


def kinds_of(origin: ObjectOrigin) -> tuple[str, ...]:
    """Return the names of the kinds whose object comes from there."""
    return tuple(name for name, kind in KINDS.items() if kind.object is origin)


def session_settings(kind: str, config: Mapping[str, Any]) -> Any:
    """Return the checked settings of a source of this kind."""
    return build_settings(source_kind(kind).settings, config, where="session")


def open_source(
    kind: str, settings: Any, *, object_model: ObjectModel | None, seed: int
) -> ProbeSource:
    """Open a source with settings from `session_settings`; see `SourceKind.open`."""
    return source_kind(kind).open(settings, object_model, seed)
