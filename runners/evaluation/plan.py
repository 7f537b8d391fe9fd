"""The plan of an evaluation, as every worker knows it, and the places of its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from chsel.errors import SettingError, require_choice
from chsel.methods import build_method, preset_settings
from chsel.methods.method import Method
from chsel.plausible.plausible_settings import PlausibleSettings
from chsel.plausible.pose_scan import TruePoseSettings
from chsel.problem.settings import build_settings
from replay.arguments import chosen_steps
from runners.evaluation.contenders import Contender
from runners.evaluation.metrics import MetricsConfig, definition_label, definition_settings
from runners.evaluation.trial_configurations import (
    HOUSEHOLD,
    MOST_PROBES,
    SENSORS,
    TrialConfiguration,
    configurations_of,
    household_configurations,
    object_values,
    recorded_object,
)
from runners.objects.loader import FITTED, ObjectConfig
from runners.sessions import kinds_of, session_settings
from runners.sessions.faults import CLEAN, LEVELS, level_name
from runners.sessions.probing_settings import ProbingSettings
from runners.sessions.source import ObjectOrigin

SESSIONS = (*kinds_of(ObjectOrigin.PLACED), SENSORS)
OWN = "own"
OBJECTS = {"models": "", "scans": "ycb/", HOUSEHOLD: "household/"}
"""What comes before the names of objects, by what they are."""


@dataclass(frozen=True, eq=False)
class Plan:
    """The settings of an evaluation that determine the results, and the folder of these."""

    folder: Path
    preset: str
    session: Mapping[str, Any]  # settings, with kind
    objects: str  # one of OBJECTS
    definition: Mapping[str, Any]  # of the plausible sets, epsilon None for that of the object
    metrics: MetricsConfig
    steps: str | None
    # OWN, where E_0 and E_l follow from each method's own results (CHSEL, Alg. 2), or the method
    # from whose results they follow, so that all register the same problems.
    starts: str
    every: int | None  # iterations between measures of the search; None: at its end alone
    recordings: bool  # whether to write METHOD.mcap
    assets: Path
    contenders: Mapping[str, Contender]  # by label
    outside: Mapping[str, Path]  # folders of hypothesis sets by label
    # Of raw logs, for sessions of sensors; None: simulated ones in the evaluation's folder.
    logs: Path | None = None
    truth: TruePoseSettings = field(default_factory=TruePoseSettings)  # how it is sought in these
    plausible: bool = True  # whether to make plausible sets; without them there is no PD
    # By label; each probes in sessions of its own, registered by the only contender.
    policies: Mapping[str, Contender] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_choice("session", self.kind, accepted=SESSIONS)
        if self.plausible and self.session.get("moves"):
            raise SettingError(
                "plausible sets of an object that moves (session.moves); accepted: plausible=false"
            )

    @property
    def kind(self) -> str:
        """Kind of the sessions."""
        return str(self.session.get("kind"))

    @cached_property
    def configurations(self) -> dict[str, TrialConfiguration]:
        """Configurations of this kind by name, also those not chosen."""
        if self.objects == HOUSEHOLD and self.kind != SENSORS:
            return household_configurations()
        return configurations_of(self.kind, self.logs)

    @property
    def labels(self) -> list[str]:
        """Labels of the parts of a trial's table: policies, or methods and external results."""
        return [*self.policies] or [*self.contenders, *self.outside]

    def about(self, trial: Trial, label: str) -> dict[str, Any]:
        """Return the columns that all rows of a label in a trial share."""
        row = {
            "object": self.configurations[trial.configuration].object,
            "configuration": trial.configuration,
            "seed": trial.seed,
            "faults": self.faults(trial),
        }
        if self.policies:
            (contender,) = self.contenders.values()
            return row | {"policy": label, "method": contender.label, "preset": contender.preset}
        preset = self.contenders[label].preset if label in self.contenders else "outside"
        definition = definition_label(self.definition)
        return row | {"method": label, "preset": preset, "definition": definition}

    def leader(self) -> Method | None:
        """Return the method whose problems all methods get, if these are not their own."""
        if self.starts == OWN:
            return None
        return build_method(self.starts, preset_settings(self.starts, self.preset))

    def object_config(self, configuration: str) -> ObjectConfig:
        """Return the object of a configuration; at its real size in sessions of sensors."""
        of = self.configurations[configuration]
        if of.log_folder is not None:
            return recorded_object(of)
        values = object_values(f"{OBJECTS[self.objects]}{of.object}")
        if self.kind == SENSORS:
            values |= {"scale": 1.0, "configuration": configuration}
        return build_settings(ObjectConfig, values, where="object")

    def session_config(self, trial: Trial) -> dict[str, Any]:
        """Return the settings of the session of a trial, with its kind."""
        if self.kind == SENSORS:
            # A pose beside the log is a guess here, from which the true pose is sought.
            return {**self.session, "path": str(trial.log(self)), "pose": "none"}
        of = self.configurations[trial.configuration]
        place = FITTED if self.objects == HOUSEHOLD else of.clean_name
        values = {**self.session, "configuration": place}
        return values if of.faults == CLEAN else values | {"faults": asdict(LEVELS[of.faults])}

    def session_settings(self, trial: Trial) -> Any:
        """Return the session settings of a trial, validated."""
        values = self.session_config(trial)
        return session_settings(values.pop("kind"), values)

    def faults(self, trial: Trial) -> str:
        """Return the name of the level of faults in a trial's session."""
        settings = self.session_settings(trial)
        return level_name(settings.faults) if isinstance(settings, ProbingSettings) else CLEAN

    def plausible_settings(self, epsilon: float) -> PlausibleSettings:
        """Return the definition of the plausible sets of an object of this epsilon, metres."""
        return definition_settings(self.definition, epsilon)

    def probes_of(self, configuration: str) -> range:
        """Return the indices that probes of a configuration may have."""
        probes = self.configurations[configuration].probes
        return range(MOST_PROBES if probes is None else probes)

    def steps_of(self, configuration: str) -> tuple[int, ...]:
        """Return the steps that may have a registration: those named that a configuration has."""
        every = self.probes_of(configuration)
        if self.steps is None:
            return tuple(every)
        named = chosen_steps(self.steps, range(MOST_PROBES))
        return tuple(step for step in every if step in set(named))


@dataclass(frozen=True, order=True)
class Trial:
    """One session: a configuration probed with a seed."""

    seed: int
    configuration: str

    def folder(self, plan: Plan) -> Path:
        """Return the folder of all files about it."""
        return plan.folder / "trials" / self.configuration / f"seed_{self.seed}"

    def without_faults(self, plan: Plan) -> Trial:
        """Return the trial of the same probes that has its plausible sets."""
        return Trial(self.seed, plan.configurations[self.configuration].clean_name)

    def log(self, plan: Plan) -> Path:
        """Return its raw log, in sessions of sensors: a rosbag2 folder, or else an .mcap file."""
        folder = (plan.logs or plan.folder / "logs") / self.configuration
        bag = folder / f"seed_{self.seed}"
        return bag if bag.is_dir() else folder / f"seed_{self.seed}.mcap"


@dataclass(frozen=True, order=True)
class Task:
    """The work of one worker at a time: the session of a trial, or a label's rows about it."""

    trial: Trial
    label: str = ""  # of a contender or external results; "" for session and plausible sets

    def __str__(self) -> str:
        what = self.label or "session"
        return f"{self.trial.configuration}, seed {self.trial.seed}: {what}"

    def sessions(self, plan: Plan) -> tuple[Trial, ...]:
        """Return the trials whose sessions are needed, also without faults; none of policies."""
        if plan.policies:
            return ()
        clean = self.trial.without_faults(plan) if plan.plausible else self.trial
        return tuple(dict.fromkeys([clean, self.trial]))

    def finished(self, plan: Plan) -> Path:
        """Return the file that exists once the task is finished."""
        folder = self.trial.folder(plan)
        return folder / (f"{self.label}.parquet" if self.label else "session.json")

    def failed(self, plan: Plan) -> Path:
        """Return the file of the rows that say how the task failed, until it succeeds."""
        return self.trial.folder(plan) / f"{self.label}.failed.parquet"
