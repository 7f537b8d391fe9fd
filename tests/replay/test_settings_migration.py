"""What older recordings leave out has the value by which they were made."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

from chsel.cost.cost_settings import CostSettings
from chsel.methods import OURS, build_method, preset_settings
from chsel.problem.settings import settings_mapping
from replay.comparing.choices import recorded_method
from replay.mcap.reader import read_recording
from replay.settings_migration import LEFT_OUT, completed

REPLAYS = Path(__file__).resolve().parents[1] / "replays"
ROWS = [(cls, name, value) for cls, row in LEFT_OUT.items() for name, value in row.items()]
_LATER = {"starts", "descent.race", "output.choice", "output.margin"}
STORED = {
    "clamp_chsel": {*_LATER, "online.update"},
    "spam_can_chsel_cma_me": {*_LATER, "online.update"},
    "points_two_passes": _LATER,
    "clamp_medial_constraint_cma_me": {"output.choice", "output.margin"},
    "cracker_box_gradient_descent": {"descent.race", "online.update"},
    "mustard_anchored": {"shared_error", "limit"},
    "points_default_chsel": set(),
}
"""Stored recordings, and what each leaves out."""


def groups(settings: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """All groups of settings with their paths, the outermost first."""
    yield path, settings
    for field in fields(settings):
        if is_dataclass(value := getattr(settings, field.name)):
            yield from groups(value, f"{path}{field.name}.")


def value_at(settings: Any, path: str) -> Any:
    for name in path.split("."):
        settings = settings[name] if isinstance(settings, Mapping) else getattr(settings, name)
    return settings


@pytest.mark.parametrize(("cls", "name", "value"), ROWS)
def test_every_row_names_a_setting_of_a_value_that_it_can_have(
    cls: type, name: str, value: Any
) -> None:
    assert settings_mapping(cls(**{name: value}))[name] == value


@pytest.mark.parametrize("method", OURS)
@pytest.mark.parametrize(("cls", "name", "value"), ROWS)
def test_a_recording_without_a_setting_has_the_value_of_its_row_and_nothing_else_changes(
    method: str, cls: type, name: str, value: Any
) -> None:
    default = preset_settings(method)
    for path, group in groups(default):
        if type(group) is not cls:
            continue
        recorded = settings_mapping(default)
        del (value_at(recorded, path[:-1]) if path else recorded)[name]
        made = build_method(method, completed(recorded, default)).settings
        assert value_at(made, path + name) == value
        recorded, before = settings_mapping(made), settings_mapping(default)
        (value_at(recorded, path[:-1]) if path else recorded)[name] = value_at(before, path + name)
        assert recorded == before


def test_what_a_recording_has_stays() -> None:
    settings = settings_mapping(preset_settings("chsel"))
    assert completed(settings, preset_settings("chsel")) == settings
    assert completed({"free_scale": 2.0}, CostSettings()) == {"free_scale": 2.0}


def test_settings_that_no_longer_exist_are_dropped_where_they_were() -> None:
    recorded = {"penetration_tolerance": None, "outer_share": 0.25, "noise": 0.002}
    made = build_method("anchored", completed(recorded, preset_settings("anchored")))
    assert settings_mapping(made.settings)["noise"] == 0.002
    run_ends = {"cma_es": {"tolfun": 1e-5, "tolfunhist": 1e-6, "tolx": 1e-11}}
    default = preset_settings("medial_constraint")
    made = build_method("medial_constraint", completed(run_ends, default))
    assert made.settings.cma_es.tolfun == 1e-5
    threshold = {"sigma": 0.1, "s_sigma": 0.8, "sp_thres": 6e-4, "ell": 0.2}
    made = build_method("cvo", completed(threshold, preset_settings("cvo")))
    assert made.settings.ell == 0.2
    tolerance = {"penetration_tolerance": -0.01}
    assert completed(tolerance, CostSettings()) == tolerance


@pytest.mark.parametrize("name", STORED)
def test_stored_recordings_mean_what_they_meant(name: str) -> None:
    recording = read_recording(REPLAYS / f"{name}.mcap")
    config = recording.start.config["method"]
    settings = recorded_method(recording).settings
    left_out = set()
    for path, group in groups(settings):
        given = value_at(config, path[:-1]) if path else config
        left_out |= {path + field.name for field in fields(group) if field.name not in given}
    assert left_out == STORED[name]
    rows = {name: value for _, name, value in ROWS}
    for path in left_out:
        assert value_at(settings, path) == rows[path.rpartition(".")[2]]


def test_the_stored_recordings_leave_out_every_row() -> None:
    left_out = {path.rpartition(".")[2] for paths in STORED.values() for path in paths}
    assert left_out == {name for _, name, _ in ROWS}
