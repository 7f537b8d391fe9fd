"""The numbers of conf/ are the defaults of the classes that check them, wherever these have any."""

from __future__ import annotations

from dataclasses import MISSING, fields, is_dataclass
from typing import Any

import pytest
import yaml

from chsel.plausible.pose_scan import TruePoseSettings
from runners.benchmarks.registrations import Steps
from runners.command.choices import CONF
from runners.evaluation.metrics import MetricsConfig
from runners.published_package.environment import PackageConfig

SHOWN = [
    ("align", "search", TruePoseSettings),
    ("benchmark", "steps", Steps),
    ("published", "package", PackageConfig),
    ("plausible", "metrics", MetricsConfig),
    ("evaluate", "metrics", MetricsConfig),
]


def defaults(cls: type) -> dict[str, Any]:
    """The fields that have a default, with it."""
    found = {}
    for field in fields(cls):
        if field.default is not MISSING:
            found[field.name] = field.default
        elif field.default_factory is not MISSING:
            found[field.name] = field.default_factory()
    return found


def compare(shown: dict[str, Any], cls: type) -> int:
    """How many numbers are shown, all of which are the defaults of a class."""
    count = 0
    for name, value in defaults(cls).items():
        if is_dataclass(value) and name in shown:
            count += compare(shown[name], type(value))
        elif name in shown:
            assert shown[name] == (list(value) if isinstance(value, tuple) else value), name
            count += 1
    return count


@pytest.mark.parametrize(("file", "group", "cls"), SHOWN)
def test_a_file_shows_the_defaults_of_its_class(file: str, group: str, cls: type) -> None:
    values = yaml.safe_load((CONF / f"{file}.yaml").read_text())
    assert compare(values[group] if group else values, cls) >= 3
