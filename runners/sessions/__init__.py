"""Where known points come from: one file a session, found by its name."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from chsel.errors import MeshWarning, require_choice
from chsel.problem.settings import build_settings
from runners.objects.loader import ObjectModel
from runners.sessions.configurations import FITTED, find_configuration
from runners.sessions.points import PointsSession, PointsSettings
from runners.sessions.probing import open_probing
from runners.sessions.probing_settings import ProbingSettings
from runners.sessions.recorded import RecordedSession, RecordedSettings
from runners.sessions.sensors import SensorsSettings, open_sensors
from runners.sessions.source import ProbeSource

SESSIONS: dict[str, type[Any]] = {
    "simulated": ProbingSettings,
    "kinematic": ProbingSettings,
    "points": PointsSettings,
    "recorded": RecordedSettings,
    "sensors": SensorsSettings,
}


def session_settings(kind: str, config: Mapping[str, Any]) -> Any:
    """The settings of a session of this kind."""
    require_choice("session.kind", kind, SESSIONS)
    return build_settings(SESSIONS[kind], config, "session")


def open_session(kind: str, settings: Any, object_model: ObjectModel, seed: int) -> ProbeSource:
    """Open a session with settings from `session_settings`.

    Raises ChselError if it cannot be opened, or if a configuration is one of another object.
    """
    if kind == "points":
        return PointsSession(settings, object_model)
    if kind == "recorded":
        return RecordedSession(settings)
    if kind == "sensors":
        return open_sensors(settings, object_model, seed)
    configuration = settings.configuration or object_model.configuration
    if configuration != FITTED:
        find_configuration(configuration, object_model.name)
        if not object_model.of_paper:
            text = (
                f"configuration {configuration} is laid out for an object of the paper's size, and "
                "its probes may miss this one; configuration=fitted is for any size"
            )
            warnings.warn(MeshWarning("other_size", text), stacklevel=2)
    return open_probing(kind, object_model.mesh, configuration, settings, seed)
