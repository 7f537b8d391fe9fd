"""How far hypotheses are from the plausible sets that lie beside a recording."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from chsel.errors import RecordingError, require_choice
from chsel.plausible.plausible_set import PlausibleSet, read_plausible
from chsel.plausible.plausible_settings import DEFINITIONS, plausible_settings
from chsel.plausible.pose_metrics import plausible_diversity
from chsel.plausible.surface_distance import DistanceSettings, SurfaceDistance, surface_points
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.streams import StreamKey
from replay.mcap.reader import Recording


class PlausibleSets:
    """The sets of a recording's steps by one definition, as `runners.plausible` keeps them.

    folder: by default `plausible` beside the recording. Raises RecordingError for a folder that
    does not exist, unless it is the default, and SettingError for an unknown definition.
    """

    def __init__(
        self, recording: Recording, folder: Path | None = None, definition: str = "default"
    ) -> None:
        require_choice("definition", definition, DEFINITIONS)
        if folder is not None and not folder.is_dir():
            raise RecordingError(f"{folder} is not a folder; accepted: one with plausible sets")
        self._folder = folder or recording.path.parent / "plausible"
        self._definition = definition
        self._start = recording.start

    @cached_property
    def _distance(self) -> SurfaceDistance:
        start = self._start
        points = surface_points(start.mesh, DistanceSettings().points, StreamKey(start.seed, 0))
        return SurfaceDistance(start.sdf, start.mesh, points)

    def numbers(self, problem: RegistrationProblem, hypotheses: Hypotheses) -> dict[str, float]:
        """Coverage, plausibility and PD in mm^2 (CHSEL, Sec. V); none without a set of the problem.

        Raises EvaluationError for a set that is damaged.
        """
        members = self._members(problem)
        if members is None or len(hypotheses.object_from_world) == 0:
            return {}
        poses = hypotheses.object_from_world
        found = plausible_diversity(self._distance.between(poses, members.world_from_object))
        return {
            "coverage": found.coverage,
            "plausibility": found.plausibility,
            "diversity": found.diversity,
        }

    def _members(self, problem: RegistrationProblem) -> PlausibleSet | None:
        """The set of these points and this object by the definition, whatever its eps."""
        for path in sorted(self._folder.glob(f"{problem.points.digest}_*.npz")):
            found = read_plausible(path)
            usual = plausible_settings(self._definition, found.settings.epsilon)
            if found.settings == usual and found.sdf_digest == problem.sdf.digest:
                return found
        return None
