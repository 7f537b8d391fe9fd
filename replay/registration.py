"""Runs registrations and records them: new ones, and recorded problems again."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import yaml

from chsel.errors import RecordingError, SettingError
from chsel.methods import build_method, preset_settings, trust_by
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray, digest
from chsel.plausible.pose_metrics import result_numbers
from chsel.plausible.symmetry import ObjectSymmetry, object_symmetry
from chsel.problem.online_registration import OnlineRegistration
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses
from chsel.problem.settings import PRESETS, changed_settings, settings_mapping
from replay.events import (
    HypothesesFound,
    Measured,
    ProblemPosed,
    Recorder,
    SessionStarted,
    SnapshotTaken,
    Traced,
)
from replay.mcap.reader import Recording


class StepObserver:
    """Hands what happens within one registration to the recorder, and takes the time by stage."""

    def __init__(
        self,
        recorder: Recorder,
        step: int,
        snapshot_interval: int,
        show: Callable[[str, int, int], None],
    ) -> None:
        self.snapshot_interval = snapshot_interval
        self.seconds: dict[str, float] = {}
        self._recorder = recorder
        self._step = step
        self._show = show
        self._mark = time.perf_counter()

    def progress(self, stage: str, iteration: int, total: int) -> None:
        """Show it, and count the time since the last report to the stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._mark
        self._mark = now
        self._show(stage, iteration, total)

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        """Record where the stage stands."""
        state = np.array(vectors), np.array(cost)
        self._recorder.record_later(partial(_traced, self._step, stage, iteration, *state))

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        """Record the archive."""
        self._recorder.record(SnapshotTaken(self._step, archive))


@dataclass(frozen=True, eq=False)
class NamedMethod:
    """A method with the name and the plain settings that make it again."""

    name: str
    settings: Mapping[str, Any]
    method: Method

    @property
    def config(self) -> dict[str, Any]:
        """As the configuration of a recording has it."""
        return {"name": self.name, **self.settings}


@dataclass(frozen=True, eq=False)
class Registered:
    """What a registration gave: its result with trust, numbers, wall-clock seconds by stage."""

    hypotheses: Hypotheses
    numbers: Mapping[str, float]
    seconds: Mapping[str, float]

    @property
    def total_seconds(self) -> float:
        """Of all stages."""
        return sum(self.seconds.values())


def recorded_method(recording: Recording) -> NamedMethod:
    """The method of a recording, with its settings; RecordingError if it does not have them."""
    name, config = recording.start.method, recording.start.config.get("method")
    if not isinstance(config, Mapping) or config.get("name") != name:
        raise RecordingError(f"recording {recording.path} does not have the settings of {name}")
    try:
        settings = {key: value for key, value in config.items() if key != "name"}
        return _named(name, settings)
    except SettingError as error:
        raise RecordingError(f"recording {recording.path}: {error}") from error


def other_method(recording: Recording, name: str | None, changes: Sequence[str]) -> NamedMethod:
    """A method by name (None: the recorded one) with changes such as "cost.free_scale=40".

    Unchanged settings are those of the recording if it is the recorded method, else those of a
    preset: the recording's if it has one, or that of the change "preset=NAME".
    Raises SettingError for names and values that do not exist.
    """
    pairs = [setting_change(change) for change in changes]
    preset = next((value for key, value in pairs if key == "preset"), None)
    recorded = recording.start.method
    if name in (None, recorded) and preset is None:
        settings = recorded_method(recording).method.settings
    else:
        preset = preset or _recorded_preset(recording)
        settings = preset_settings(name or recorded, str(preset))
    for key, value in pairs:
        if key != "preset":
            for part in reversed(key.removeprefix("method.").split(".")):
                value = {part: value}
            settings = changed_settings(settings, value, "method")
    return _named(name or recorded, settings)


def setting_change(change: str) -> tuple[str, Any]:
    """Key and value of a change such as "cost.free_scale=40"; SettingError if it is none."""
    key, sign, value = change.partition("=")
    if not sign or not key:
        raise SettingError(f"{change!r} is not a setting; accepted: KEY=VALUE")
    try:
        return key, yaml.safe_load(value)
    except yaml.YAMLError:
        raise SettingError(f"{change!r} has no value; accepted: KEY=VALUE, as in YAML") from None


def recorded_online(recording: Recording, method: Method) -> OnlineRegistration:
    """The loop that a recorded session walks with a method, before its first step."""
    start = recording.start
    return OnlineRegistration(
        start.sdf,
        start.workspace,
        start.free_resolution,
        method.online,
        seed=recording.seed,
        points=start.initial_points,
    )


def symmetry_for_errors(start: SessionStarted) -> ObjectSymmetry | None:
    """The symmetries of a session's object; None if no true pose is known to need them."""
    return None if start.world_from_object is None else recorded_symmetry(start)


def recorded_symmetry(start: SessionStarted) -> ObjectSymmetry:
    """The symmetries of a session's object."""
    return object_symmetry(start.mesh)


def snapshot_interval(snapshots: Sequence[ArchiveSnapshot]) -> int:
    """Iterations between recorded snapshots; 0 if there are the first and the last alone."""
    iterations = sorted({archive.iteration for archive in snapshots})
    return iterations[1] if len(iterations) > 2 else 0


def register_recorded(
    posed: ProblemPosed,
    method: Method,
    recorder: Recorder,
    world_from_object: FloatArray | None,
    symmetry: ObjectSymmetry | None,
    *,
    snapshot_interval: int = 0,
    show: Callable[[str, int, int], None] = lambda *_: None,
) -> Registered:
    """Register a problem, and record it with all that the registration gives.

    world_from_object (4, 4): the true pose, where known. symmetry: of the object, for the errors to
    the true pose; None: without errors. show: gets stage, iteration and total.
    """
    recorder.record(posed)
    observer = StepObserver(recorder, posed.step, snapshot_interval, show)
    begun = time.perf_counter()
    hypotheses = method.register(posed.problem, observer)
    seconds = dict(observer.seconds)
    seconds["other"] = time.perf_counter() - begun - sum(observer.seconds.values())
    recorder.record(HypothesesFound(posed.step, hypotheses))
    trust = trust_by(method, posed.problem, hypotheses)
    truth = None if symmetry is None else world_from_object
    numbers = result_numbers(hypotheses, posed.problem, truth, symmetry, trust)
    recorder.record(Measured(posed.step, numbers))
    return Registered(replace(hypotheses, trust=trust), numbers, seconds)


def _traced(step: int, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> Traced:
    ordered, half = np.sort(cost), len(cost) // 2  # faster than numpy's median
    median = ordered[half] if len(cost) % 2 else (ordered[half - 1] + ordered[half]) / 2.0
    costs = (float(cost.min()), float(median), float(cost.max()))
    return Traced(step, stage, iteration, digest(vectors, cost), *costs)


def _named(name: str, settings: Any) -> NamedMethod:
    method = build_method(name, settings)
    return NamedMethod(name, settings_mapping(method.settings), method)


def _recorded_preset(recording: Recording) -> str:
    preset = recording.start.config.get("preset")
    name = preset.get("name") if isinstance(preset, Mapping) else None
    return name if name in PRESETS else "default"
