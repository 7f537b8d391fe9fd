"""What an evaluation does, as every process that works on it knows it; and where its files are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from chsel.errors import SettingError, require_choice
from chsel.evaluation.plausible_settings import PlausibleSettings
from chsel.methods import build_method, preset_settings
from chsel.methods.method import Method
from chsel.settings import build_settings
from replay.step_ranges import chosen_steps
from runners.cli import CONF
from runners.evaluation.contenders import Contender
from runners.evaluation.measure import MetricsConfig
from runners.objects.loader import ObjectConfig
from runners.sessions import session_settings
from runners.sessions.configurations import CONFIGURATIONS
from runners.sessions.probing import ProbingSettings

SESSIONS = ("simulated", "kinematic")
OWN = "own"
OBJECTS = {"models": "", "scans": "ycb/"}
"""Folders of conf/object by the name of what is in them."""


@dataclass(frozen=True, eq=False)
class Plan:
    """All that determines the results, and where they go.

    folder: of the evaluation. session: settings, with kind. objects: "models" or "scans".
    definition: of the plausible sets, epsilon None for that of the object. starts: OWN, where E_0
    and E_l of a step follow from the results of each method itself (CHSEL, Alg. 2), or the method
    from whose results they follow, so that all register the same problems. every: iterations
    between measures of the search; None: at its end alone. recordings: whether to write
    METHOD.mcap. outside: folders of hypothesis sets by label.
    """

    folder: Path
    preset: str
    session: Mapping[str, Any]
    objects: str
    definition: Mapping[str, Any]
    metrics: MetricsConfig
    steps: str | None
    starts: str
    every: int | None
    recordings: bool
    assets: Path
    contenders: Mapping[str, Contender]
    outside: Mapping[str, Path]

    def leader(self) -> Method | None:
        """The method whose problems all methods get, if these are not their own."""
        if self.starts == OWN:
            return None
        return build_method(self.starts, preset_settings(self.starts, self.preset))

    def object_config(self, configuration: str) -> ObjectConfig:
        """The object of a configuration."""
        require_choice("objects", self.objects, OBJECTS)
        name = f"{OBJECTS[self.objects]}{CONFIGURATIONS[configuration].object}"
        values = yaml.safe_load((CONF / "object" / f"{name}.yaml").read_text())
        return build_settings(ObjectConfig, values, "object")

    def session_config(self, configuration: str) -> dict[str, Any]:
        """The settings of the session of a configuration, with its kind."""
        return {**self.session, "configuration": configuration}

    def session_settings(self, configuration: str) -> ProbingSettings:
        """The same, checked."""
        config = self.session_config(configuration)
        kind = str(config.pop("kind", None))
        require_choice("session", kind, SESSIONS)
        settings = session_settings(kind, config)
        assert isinstance(settings, ProbingSettings)
        return settings

    def plausible_settings(self, epsilon: float) -> PlausibleSettings:
        """The definition of the plausible sets of an object of this epsilon, metres."""
        values = {key: value for key, value in self.definition.items() if key != "name"}
        if values.get("epsilon") is None:
            values["epsilon"] = epsilon
        return build_settings(PlausibleSettings, values, "definition")

    def steps_of(self, configuration: str) -> tuple[int, ...]:
        """The steps at which there may be a registration; none if the configuration has none."""
        every = range(len(CONFIGURATIONS[configuration].grid))
        try:
            return chosen_steps(self.steps, every)
        except SettingError:
            if len(every) and self.steps is not None:
                chosen_steps(self.steps, range(10_000))  # a text of another form is an error
            return ()


@dataclass(frozen=True, order=True)
class Trial:
    """One session: a configuration probed with a seed."""

    seed: int
    configuration: str

    def folder(self, plan: Plan) -> Path:
        """Where all about it is."""
        return plan.folder / "trials" / self.configuration / f"seed_{self.seed}"


@dataclass(frozen=True, order=True)
class Unit:
    """What one worker does at a time: the session of a trial, or a label's rows about it.

    label: of a contender, or of sets from outside; "" for the session and its plausible sets.
    """

    trial: Trial
    label: str = ""

    def __str__(self) -> str:
        what = self.label or "session"
        return f"{self.trial.configuration}, seed {self.trial.seed}: {what}"

    def finished(self, plan: Plan) -> Path:
        """The file that is there once the unit is finished."""
        folder = self.trial.folder(plan)
        return folder / (f"{self.label}.parquet" if self.label else "session.json")

    def failed(self, plan: Plan) -> Path:
        """Rows that say how the unit failed, until it is done again."""
        return self.trial.folder(plan) / f"{self.label}.failed.parquet"
