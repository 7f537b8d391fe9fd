"""One recorded problem registered again, with another method or other settings, as a recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from replay.comparing.contenders import recorded_or_none
from replay.environment import environment
from replay.events import Event, Probe, ProblemPosed, SessionEnded, SessionStarted
from replay.files import file_digest, new_file
from replay.mcap.reader import Recording, read_recording
from replay.mcap.writer import McapRecorder
from replay.registration import (
    NamedMethod,
    register_recorded,
    snapshot_interval,
    symmetry_for_errors,
)


@dataclass(frozen=True, eq=False)
class StepAgain:
    """A step's problem, what was recorded of its registration (None: nothing), and what is new.

    as_recorded: whether method and settings are the recorded ones. recording: the new one, as it
    reads. seconds: of registering.
    """

    problem: RegistrationProblem
    recorded: Hypotheses | None
    found: Hypotheses
    as_recorded: bool
    recording: Recording
    seconds: float

    @property
    def equal(self) -> bool:
        """Whether the hypotheses have the recorded bits."""
        return self.recorded is not None and self.recorded.digest == self.found.digest


def register_step_again(
    recording: Recording,
    step: int,
    method: NamedMethod,
    path: Path,
    *,
    preset: str | None = None,
    interval: int | None = None,
) -> StepAgain:
    """Register the problem of a step and record it in a new file, which names its source.

    preset: that the settings follow now, if not the recorded one. interval: iterations between
    snapshots of the archive, 0 for the first and last alone; None: as recorded. If the
    registration fails, no file is left. Raises RecordingError for a step without a problem, and a
    file that exists.
    """
    recording.checked_steps([step])
    recorded = recording.hypotheses(step) if recording.has_result(step) else None
    facts = {"step": step, "method": recording.start.method}
    facts["hypotheses"] = None if recorded is None else recorded.digest
    start = _start(recording, method, facts, preset)
    if interval is None:
        interval = snapshot_interval(recording.snapshots(step))
    *probes, posed = _up_to_problem(recording, step)
    assert isinstance(posed, ProblemPosed)
    with new_file(path) as beside:
        recorder = McapRecorder(beside)
        try:
            for event in (start, *probes):
                recorder.record(event)
            registered = register_recorded(
                posed,
                method.method,
                recorder,
                start.world_from_object,
                symmetry_for_errors(start),
                snapshot_interval=interval,
            )
            recorder.record(SessionEnded(step, "finished"))
        finally:
            recorder.close()
    again = read_recording(path)
    known = recorded_or_none(recording)
    same = known is not None and known.config == method.config
    found = again.hypotheses(step)
    return StepAgain(posed.problem, recorded, found, same, again, registered.total_seconds)


def _start(
    recording: Recording, method: NamedMethod, facts: dict[str, Any], preset: str | None
) -> SessionStarted:
    """The session's start, with another method, from here, and with its source."""
    config = {**recording.start.config, "method": method.config, "source": facts}
    config.pop("policy", None)  # no decision is part of it
    if preset is not None:
        config["preset"] = {"name": preset}
    return dataclasses.replace(
        recording.start,
        method=method.name,
        config=config,
        environment=environment(),
        source=file_digest(recording.path),
    )


def _up_to_problem(recording: Recording, step: int) -> Iterator[Event]:
    """The probes before the problem of a step, and the problem."""
    for event in recording.events(images=False):
        if isinstance(event, Probe):
            yield event
        elif isinstance(event, ProblemPosed) and event.step == step:
            yield event
            return
