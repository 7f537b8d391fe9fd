"""Metrics of hypotheses: by the plausible set and its definition, and those beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

from chsel.numerics.arrays import FloatArray
from chsel.plausible.plausible_set import PlausibleSet
from chsel.plausible.plausible_settings import PlausibleSettings, definition_name
from chsel.plausible.pose_metrics import cheapest, plausible_diversity, true_pose_rank
from chsel.plausible.surface_distance import DistanceSettings, SurfaceDistance, surface_points
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.settings import build_settings, settings_mapping
from chsel.problem.streams import StreamKey
from runners.command.choices import store

_COMBINED = {"sums": "sums over points (the paper's)", "means": "means over points"}


def definition_settings(definition: Mapping[str, Any], epsilon: float | None) -> PlausibleSettings:
    """Return the settings of a choice `definition`, checked; epsilon, metres, where it has none."""
    values = {key: value for key, value in definition.items() if key != "name"}
    if values.get("epsilon") is None:
        values["epsilon"] = epsilon
    return build_settings(PlausibleSettings, values, where="definition")


def definition_label(definition: Mapping[str, Any]) -> str:
    """Return the name of a definition as tables have it: two that differ never have the same one.

    Where settings were changed, the name of the one it was, "~", and the start of their digest.
    """
    settings = definition_settings(definition, 1.0)
    name = definition_name(settings)
    if name is not None and definition.get("epsilon") is None:
        return name
    return f"{definition.get('name', 'own')}~{settings.digest[:8]}"


def definition_text(definition: Mapping[str, Any]) -> str:
    """Return the label of a definition, and which poses are members by it."""
    cost = definition_settings(definition, 1.0).cost
    epsilon = definition.get("epsilon")
    bound = "that of each object" if epsilon is None else f"{1000.0 * epsilon:g} mm"
    return (
        f"{definition_label(definition)}, cost by {_COMBINED[cost.combine]}, free points at most "
        f"{1000.0 * cost.tolerance:g} mm inside of members, epsilon {bound}"
    )


@dataclass(frozen=True)
class MetricsConfig(DistanceSettings):
    """Settings of the metrics: how distances are measured, and for which hypotheses."""

    quantile: float = 1.0  # of the hypotheses by their cost, the cheapest

    def __post_init__(self) -> None:
        super().__post_init__()
        cheapest(np.zeros(1), self.quantile)  # which checks it


store("metrics", "default", node=settings_mapping(MetricsConfig()))


class HypothesisMetrics:
    """The metrics of hypotheses; the same points on the surface for all steps of a session."""

    def __init__(
        self, config: MetricsConfig, mesh: trimesh.Trimesh, *, world_from_object: FloatArray
    ) -> None:
        """Prepare the metrics. mesh: in metres. world_from_object (4, 4): the true pose."""
        self._config = config
        self._mesh = mesh
        self._truth = world_from_object
        self._distance: SurfaceDistance | None = None

    def compute(
        self,
        problem: RegistrationProblem,
        members: PlausibleSet,
        *,
        found: Hypotheses | None,
        ranked: bool = True,
    ) -> dict[str, float]:
        """Return coverage, plausibility, diversity (mm^2), its root (mm), precision and recall.

        ranked: the rank of the true pose, too.
        """
        if found is None or len(found.cost) == 0:
            return {}
        distance = self._surface_distance(problem)
        chosen = found.object_from_world[cheapest(found.cost, self._config.quantile)]
        metrics = plausible_diversity(distance.between(chosen, members.world_from_object))
        names = ("coverage", "plausibility", "diversity", "root", "precision", "recall")
        row = {"distinct": found.distinct, **{name: getattr(metrics, name) for name in names}}
        if ranked and len(chosen) > 1:
            row["rank"] = true_pose_rank(distance, chosen, world_from_object=self._truth)
        return row

    def nearest(
        self, problem: RegistrationProblem, found: Hypotheses, *, truth: FloatArray
    ) -> tuple[int, float]:
        """Return the index of the hypothesis nearest to the truth (4, 4), and its RMS distance, m.

        The truth is that of the problem's step, as pushes may move the object.
        """
        distance = self._surface_distance(problem)
        squares = distance.between(found.object_from_world, truth[None])[:, 0]  # (B,), mm^2
        nearest = int(np.argmin(squares))
        return nearest, 1e-3 * float(np.sqrt(squares[nearest]))

    def _surface_distance(self, problem: RegistrationProblem) -> SurfaceDistance:
        if self._distance is None:
            key = StreamKey(problem.key.seed, 0)
            points = surface_points(self._mesh, self._config.points, key=key)
            self._distance = SurfaceDistance(
                problem.sdf, self._mesh, points=points, settings=self._config
            )
        return self._distance
