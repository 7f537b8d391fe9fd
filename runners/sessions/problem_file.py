"""The problems of a recording, of a raw log or of a file of points, as plausible sets use them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader

from chsel.errors import RecordingError, SettingError
from chsel.events import Event, Probe, RigDescribed, SessionStarted
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import build_settings
from chsel.problem.streams import StreamKey
from replay.files import file_digest
from replay.mcap.reader import Recording, read_recording
from replay.mcap.schemas import PROFILE
from runners.objects.loader import ObjectConfig, load_object
from runners.sensors.depth_frame import SUFFIXES as FRAME_SUFFIXES
from runners.sessions import open_source, session_settings
from runners.sessions.source import ProbeSource

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class ProblemFile:
    """The content of a file."""

    object: str
    mesh: trimesh.Trimesh
    world_from_object: FloatArray | None  # (4, 4), where known
    epsilon: float | None  # of the object, metres; None where the file does not say
    steps: tuple[int, ...]
    problems: ProbedProblems | RecordedProblems
    digest: str  # of the file's bytes


class ProbedProblems:
    """Problems of all points up to a step, wherever a registration starts."""

    def __init__(
        self, events: Sequence[Event], of: ProbeSource | SessionStarted, *, sdf: SdfGrid, seed: int
    ) -> None:
        self._probes = [event for event in events if isinstance(event, Probe)]
        self._of = of
        self._sdf = sdf
        self._seed = seed
        self.steps = tuple(probe.step for probe in self._probes)

    def problem(self, step: int) -> RegistrationProblem:
        """Return the problem of all that is known at a step."""
        new = [probe.new_points for probe in self._probes if probe.step <= step]
        return RegistrationProblem(
            sdf=self._sdf,
            points=KnownPoints.joined([self._of.initial_points, *new]),
            initial_set=np.eye(4)[None],
            workspace=self._of.workspace,
            free_resolution=self._of.free_resolution,
            key=StreamKey(self._seed, step),
            prior=self._of.prior,
        )

    def hypotheses(self, step: int) -> None:
        """Return None, as nothing was registered."""


class RecordedProblems:
    """The problems of a recording, with what was found."""

    def __init__(self, recording: Recording) -> None:
        self.problem = recording.problem
        self._recording = recording

    def hypotheses(self, step: int) -> Hypotheses | None:
        """Return the result of a step, if one was recorded."""
        return self._recording.hypotheses(step) if self._recording.has_result(step) else None


def open_problem_file(
    path: Path,
    object_config: Mapping[str, Any],
    *,
    session: Mapping[str, Any],
    assets: Path,
    seed: int,
) -> ProblemFile:
    """Open a recording; else a raw log or a file of known points, whose object must be named.

    session: its settings, for what is not a recording; raw logs need those of kind "sensors", with
    which a .yaml is a depth image.
    """
    if is_recording(path):
        return _recorded(path)
    is_mcap = path.suffix.lower() == ".mcap"
    kind = "points"
    values = {key: value for key, value in session.items() if key != "kind"}
    of_sensors = session.get("kind") == "sensors"
    is_frame = of_sensors and path.suffix.lower() in FRAME_SUFFIXES
    if is_mcap or path.is_dir() or is_frame:
        if not of_sensors:
            raise SettingError(
                f"{path} is not a recording; accepted for a raw log: session=sensors "
                "session/rig=NAME object=NAME"
            )
        # Images are for the eye; a pose beside the log is what is sought here.
        kind = "sensors"
        values = {**values, "pose": "none", "images": False}
    model = load_object(build_settings(ObjectConfig, object_config, where="object"), assets)
    settings = session_settings(kind, {**values, "path": str(path)})
    opened = open_source(kind, settings, object_model=model, seed=seed)
    events = list(opened.probes())
    sdf = model.grid(settings)
    problems = ProbedProblems(events, opened, sdf=sdf, seed=seed)
    described = [event.source for event in events if isinstance(event, RigDescribed)]
    digest = described[0] if described else file_digest(path)
    truth = opened.world_from_object
    return ProblemFile(
        model.name,
        model.mesh,
        world_from_object=truth,
        epsilon=model.epsilon,
        steps=problems.steps,
        problems=problems,
        digest=digest,
    )


def _recorded(path: Path) -> ProblemFile:
    recording = read_recording(path)
    start = recording.start
    epsilon = start.config.get("object", {}).get("epsilon")
    problems: ProbedProblems | RecordedProblems = RecordedProblems(recording)
    steps = recording.steps
    if not steps:  # nothing was registered, as where somebody else's method is to be measured
        problems = ProbedProblems(recording.probes, start, sdf=start.sdf, seed=start.seed)
        steps = problems.steps
    if not steps:
        raise RecordingError(f"recording {path} has no registration problem and no probe")
    truth = start.world_from_object
    return ProblemFile(
        start.object,
        start.mesh,
        world_from_object=truth,
        epsilon=epsilon,
        steps=steps,
        problems=problems,
        digest=file_digest(path),
    )


def is_recording(path: Path) -> bool:
    """Return whether a file is a recording, by its name and header; also if it is unreadable."""
    if path.suffix.lower() != ".mcap":
        return False
    if not path.is_file():
        return True  # reading it reports what is wrong, as below
    try:
        with path.open("rb") as file:
            return make_reader(file).get_header().profile == PROFILE
    except (McapError, OSError, ValueError):
        return True
