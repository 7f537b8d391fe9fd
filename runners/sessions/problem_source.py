"""Where plausible sets are made for: the problems of a recording, a raw log or a points file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import trimesh
from mcap.exceptions import McapError
from mcap.records import Header
from mcap.stream_reader import StreamReader

from chsel.errors import RecordingError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.file_checks import refuse_special_file
from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import build_settings
from chsel.problem.streams import StreamKey
from replay.events import Event, Probe, RigDescribed, SessionStarted
from replay.files import file_digest
from replay.mcap.reader import Recording, read_recording
from replay.mcap.schemas import PROFILE
from runners.objects.loader import ObjectConfig, load_object
from runners.sensors.depth_frame import SUFFIXES as FRAME_SUFFIXES
from runners.sessions import open_session, session_settings
from runners.sessions.session import Session

_LONGEST_HEADER = 4096  # bytes


@dataclass(frozen=True, eq=False)
class Source:
    """What a file holds."""

    object: str
    mesh: trimesh.Trimesh
    world_from_object: FloatArray | None  # (4, 4), where known
    epsilon: float | None  # of the object, metres; None where the file does not say
    steps: tuple[int, ...]
    problems: Problems
    digest: str  # of the file's bytes


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
    """A recording; else a raw log or a file of known points, for which the object must be named.

    session: its settings, for what is not a recording; raw logs need those of kind "sensors", with
    which a .yaml is a depth image.
    """
    refuse_special_file(str(path), path, SettingError)
    is_mcap = path.suffix.lower() == ".mcap"
    if is_mcap and _is_recording(path):
        return _recorded(path)
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
        values |= {"pose": "none", "images": False}
        return _of_session("sensors", path, object_config, values, assets, seed)
    return _of_session("points", path, object_config, values, assets, seed)


def _recorded(path: Path) -> Source:
    recording = read_recording(path)
    start = recording.start
    config = start.config.get("object")
    epsilon = config.get("epsilon") if isinstance(config, Mapping) else None
    epsilon = float(epsilon) if isinstance(epsilon, int | float) else None
    problems: Problems = _RecordedProblems(recording)
    steps = recording.steps
    if not steps:  # nothing was registered, as where somebody else's method is to be measured
        problems = ProbedProblems(recording.probes, start, start.sdf, start.seed)
        steps = problems.steps
    if not steps:
        raise RecordingError(f"recording {path} has no registration problem and no probe")
    truth = start.world_from_object
    return Source(start.object, start.mesh, truth, epsilon, steps, problems, file_digest(path))


def _of_session(
    kind: str,
    path: Path,
    object_config: Mapping[str, Any],
    session: Mapping[str, Any],
    assets: Path,
    seed: int,
) -> Source:
    """A file of points, or a log of sensors, of which known points are made first."""
    model = load_object(build_settings(ObjectConfig, object_config, "object"), assets)
    settings = session_settings(kind, {**session, "path": str(path)})
    opened = open_session(kind, settings, model, seed)
    try:
        events = list(opened.probes())
    finally:
        opened.close()
    sdf = model.grid(settings)
    problems = ProbedProblems(events, opened, sdf, seed)
    described = [event.source for event in events if isinstance(event, RigDescribed)]
    return Source(
        model.name,
        model.mesh,
        opened.world_from_object,
        model.epsilon,
        problems.steps,
        problems,
        described[0] if described else file_digest(path),
    )


def _is_recording(path: Path) -> bool:
    """Whether a file is a recording, by its first record; also if that cannot be read."""
    try:
        with path.open("rb") as file:
            first = BytesIO(file.read(_LONGEST_HEADER))
        records = StreamReader(first, record_size_limit=_LONGEST_HEADER).records
        header = next(iter(records), None)
    except (McapError, OSError, ValueError):  # reading it reports what is wrong
        return True
    return not isinstance(header, Header) or header.profile == PROFILE


class _RecordedProblems:
    def __init__(self, recording: Recording) -> None:
        self._recording = recording

    def problem(self, step: int) -> RegistrationProblem:
        return self._recording.problem(step)

    def found(self, step: int) -> Hypotheses | None:
        return self._recording.hypotheses(step) if self._recording.has_result(step) else None


class ProbedProblems:
    """All points up to a step; where a registration starts does not matter here."""

    def __init__(
        self, events: Sequence[Event], of: Session | SessionStarted, sdf: SdfGrid, seed: int
    ) -> None:
        self._probes = [event for event in events if isinstance(event, Probe)]
        self._of, self._sdf, self._seed = of, sdf, seed
        self.steps = tuple(probe.step for probe in self._probes)

    def problem(self, step: int) -> RegistrationProblem:
        new = [probe.new_points for probe in self._probes if probe.step <= step]
        return RegistrationProblem(
            self._sdf,
            KnownPoints.joined([self._of.initial_points, *new]),
            np.eye(4)[None],
            self._of.workspace,
            self._of.free_resolution,
            StreamKey(self._seed, step),
        )

    def found(self, step: int) -> None:
        """Nothing was registered."""
