"""Runs registrations again: recorded problems, with the recorded method or another."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from chsel.errors import RecordingError, SettingError
from chsel.evaluation.result_numbers import result_numbers
from chsel.methods import build_method, preset_settings
from chsel.methods.method import Method
from chsel.presets import PRESETS
from chsel.settings import settings_mapping
from replay.events import (
    HypothesesFound,
    Measured,
    ProblemPosed,
    Recorder,
    SessionStarted,
    Timed,
)
from replay.mcap_reader import Recording
from replay.step_observer import StepObserver


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


def recorded_method(recording: Recording) -> NamedMethod:
    """The method of a recording, with its settings; RecordingError if it does not tell them."""
    config = recording.start.config.get("method")
    if not isinstance(config, Mapping) or config.get("name") != recording.start.method:
        raise RecordingError(
            f"recording {recording.path} does not tell the settings of {recording.start.method}"
        )
    try:
        return _named(recording.start.method, {k: v for k, v in config.items() if k != "name"})
    except SettingError as error:
        raise RecordingError(f"recording {recording.path}: {error}") from error


def other_method(recording: Recording, name: str | None, changes: Sequence[str]) -> NamedMethod:
    """A method by name (None: the recorded one) with changes such as "cost.free_scale=40".

    Unchanged settings are those of the recording if it is the recorded method, else those of a
    preset: the recording's if it tells one, or that of the change "preset=NAME".
    Raises SettingError for names and values that do not exist.
    """
    pairs = [_pair(change) for change in changes]
    preset = next((value for key, value in pairs if key == "preset"), None)
    recorded = recording.start.method
    if name in (None, recorded) and preset is None:
        settings: dict[str, Any] = dict(recorded_method(recording).settings)
        name = recorded
    else:
        preset = preset or _recorded_preset(recording)
        settings = settings_mapping(preset_settings(name or recorded, str(preset)))
    for key, value in pairs:
        if key != "preset":
            settings = _changed(settings, key.removeprefix("method.").split("."), value, key)
    return _named(name or recorded, settings)


def register_again(
    posed: ProblemPosed,
    method: Method,
    recorder: Recorder,
    start: SessionStarted,
    *,
    snapshot_interval: int = 0,
    timings: bool = False,
) -> float:
    """Register a recorded problem and record all about it; seconds that the registration took."""
    step, problem = posed.step, posed.problem
    recorder.record(posed)
    observer = StepObserver(recorder, step, snapshot_interval, lambda *_: None)
    begun = time.perf_counter()
    hypotheses = method.register(problem, observer)
    seconds = time.perf_counter() - begun
    recorder.record(HypothesesFound(step, hypotheses))
    numbers = result_numbers(hypotheses, problem, start.world_from_object)
    recorder.record(Measured(step, numbers))
    if timings:
        recorder.record(Timed(step, observer.seconds))
    return seconds


def _named(name: str, settings: Mapping[str, Any]) -> NamedMethod:
    method = build_method(name, settings)
    return NamedMethod(name, settings_mapping(method.settings), method)


def _recorded_preset(recording: Recording) -> str:
    preset = recording.start.config.get("preset")
    name = preset.get("name") if isinstance(preset, Mapping) else None
    return name if name in PRESETS else "default"


def _pair(change: str) -> tuple[str, Any]:
    key, sign, value = change.partition("=")
    if not sign or not key:
        raise SettingError(f"{change!r} is no setting; accepted: KEY=VALUE")
    try:
        return key, yaml.safe_load(value)
    except yaml.YAMLError:
        raise SettingError(f"{change!r} has no value; accepted: KEY=VALUE, as in YAML") from None


def _changed(settings: Mapping[str, Any], path: list[str], value: Any, key: str) -> dict[str, Any]:
    """The settings with another value at a path; the path must exist."""
    name, *rest = path
    if name not in settings:
        raise SettingError(f"{key} does not exist; accepted: {', '.join(sorted(settings))}")
    inner = settings[name]
    if rest:
        if not isinstance(inner, Mapping):
            raise SettingError(f"{key} does not exist; {name} is {inner!r}")
        value = _changed(inner, rest, value, key)
    return {**settings, name: value}
