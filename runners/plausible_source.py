"""Where plausible sets are made for: the registration problems of a recording or a points file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import trimesh

from chsel.arrays import FloatArray
from chsel.errors import RecordingError
from chsel.points import KnownPoints
from chsel.problem import Hypotheses, RegistrationProblem
from chsel.sdf import SdfGrid
from chsel.settings import build_settings
from chsel.streams import StreamKey
from replay.mcap.reader import Recording, read_recording
from runners.objects.loader import ObjectConfig, load_object
from runners.sessions.points import PointsSession, PointsSettings


@dataclass(frozen=True, eq=False)
class Source:
    """What a file holds: the object, its true pose (4, 4) where known, and problems by step.

    epsilon: of the object, metres; None where the file does not say.
    """

    object: str
    mesh: trimesh.Trimesh
    world_from_object: FloatArray | None
    epsilon: float | None
    steps: tuple[int, ...]
    problems: Problems


class Problems(Protocol):
    """The registration problems of a file."""

    def problem(self, step: int) -> RegistrationProblem:
        """All that is known at a step."""

    def found(self, step: int) -> Hypotheses | None:
        """What was found at a step, if that was recorded."""


def open_source(
    path: Path,
    object_config: Mapping[str, Any],
    session: Mapping[str, Any],
    assets: Path,
    seed: int,
) -> Source:
    """A recording, else a file of known points, for which the object must be named."""
    if path.suffix.lower() == ".mcap":
        return _recorded(path)
    config = build_settings(ObjectConfig, object_config, "object")
    model = load_object(config, assets)
    values = {key: value for key, value in session.items() if key != "kind"}
    settings = build_settings(PointsSettings, {**values, "path": str(path)}, "session")
    points = PointsSession(settings, model)
    sdf = SdfGrid.from_mesh(model.mesh, settings.object_resolution, padding=settings.object_padding)
    problems = _PointProblems(points, sdf, seed)
    steps = tuple(probe.step for probe in problems.probes)
    truth = points.world_from_object
    return Source(model.name, model.mesh, truth, model.epsilon, steps, problems)


def _recorded(path: Path) -> Source:
    recording = read_recording(path)
    if not recording.steps:
        raise RecordingError(f"recording {path} has no registration problem")
    start = recording.start
    config = start.config.get("object")
    epsilon = config.get("epsilon") if isinstance(config, Mapping) else None
    epsilon = float(epsilon) if isinstance(epsilon, int | float) else None
    problems = _RecordedProblems(recording)
    truth = start.world_from_object
    return Source(start.object, start.mesh, truth, epsilon, recording.steps, problems)


class _RecordedProblems:
    def __init__(self, recording: Recording) -> None:
        self._recording = recording

    def problem(self, step: int) -> RegistrationProblem:
        return self._recording.problem(step)

    def found(self, step: int) -> Hypotheses | None:
        return self._recording.hypotheses(step) if self._recording.has_result(step) else None


class _PointProblems:
    """All points up to a step; where a registration starts does not matter here."""

    def __init__(self, session: PointsSession, sdf: SdfGrid, seed: int) -> None:
        self.probes = list(session.probes())
        self._session, self._sdf, self._seed = session, sdf, seed

    def problem(self, step: int) -> RegistrationProblem:
        news = [probe.new_points for probe in self.probes if probe.step <= step]
        points = reduce(KnownPoints.merged, news, self._session.initial_points)
        return RegistrationProblem(
            self._sdf,
            points,
            np.eye(4)[None],
            self._session.workspace,
            self._session.free_resolution,
            StreamKey(self._seed, step),
        )

    def found(self, step: int) -> None:
        """A points file holds no result."""
