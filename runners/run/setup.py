"""The configuration of `runners.probe`, and the source and object that follow from it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from chsel.errors import InputWarning, SessionError
from chsel.events import SessionStarted, Start
from chsel.next_probe.decision_problem import Actions
from chsel.numerics.threads import require_threads
from chsel.policies import build_policy
from chsel.policies.policy import Policy
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from chsel.session.run import Run
from replay.environment import environment
from runners.objects.loader import ObjectConfig, check_size, load_object
from runners.objects.scans import AssetsConfig
from runners.run.grasps import GraspConfig
from runners.run.recording import RecordingConfig
from runners.sensors.session_report import Report
from runners.sessions import open_source, session_settings, source_kind
from runners.sessions.probing_settings import without_defaults
from runners.sessions.source import ObjectOrigin, ProbeSource, Steerable

if TYPE_CHECKING:
    import trimesh

GRID = "grid"
"""The policy of a session that is not steered: it probes in its own order."""
FIRST_CONTACT = Start(contacts=1)
"""When a session with a policy begins to register."""
_NOT_OF_THE_RESULT = ("assets", "logs", "recording", "threads")


@dataclass(frozen=True)
class PresetName:
    """The preset that the other choices followed."""

    name: str


@dataclass(frozen=True)
class ProbeConfig:
    """conf/probe.yaml, which has all defaults, checked."""

    object: ObjectConfig
    session: Any  # checked by the session's kind
    method: Any  # checked by the method
    policy: Any  # checked by the policy
    preset: PresetName
    grasp: GraspConfig
    recording: RecordingConfig
    assets: AssetsConfig
    logs: str
    seed: int
    threads: int
    configuration: str | None
    from_step: int | None  # `from` of the command line, a keyword of Python

    def __post_init__(self) -> None:
        StreamKey(self.seed, 0)
        require_threads("threads", self.threads)


@dataclass(frozen=True, eq=False)
class RunSetup:
    """The source of probes of a run, the object that it hides, and what chooses probes."""

    source: ProbeSource
    object_name: str
    mesh: trimesh.Trimesh
    sdf: SdfGrid
    start: Start
    # Spacing of the SDF grid that the settings ask for, metres; None: that of `object_grid`.
    object_resolution: float | None = None
    warnings: tuple[InputWarning, ...] = ()  # about the object and a file of points
    policy: Policy | None = None  # chooses the probes; None for the session's own order
    actions: Actions | None = None  # that a policy chooses from

    @property
    def report(self) -> Report | None:
        """Counts of sensors' messages, once they are read; None without sensors."""
        return self.source.report

    @property
    def moves(self) -> float:
        """Metres that a probe moves the object at most."""
        return self.source.push_distance

    def begin(self, run: Run, started: SessionStarted) -> None:
        """Open the recording of a run over the session, and offer the actions."""
        run.begin(started)
        if self.actions is not None:
            assert isinstance(self.source, Steerable)
            run.offer(self.actions, self.source.hand)
        run.flush()


def open_setup(config: ProbeConfig) -> RunSetup:
    """Open the session with its object; a recorded session brings its own.

    Raises SessionError for a policy on a session whose probes cannot be chosen.
    """
    values = dict(config.session)
    kind_name = str(values.pop("kind", None))
    kind = source_kind(kind_name)
    settings = session_settings(kind_name, values)
    values = dict(config.policy)
    policy_name = str(values.pop("name", None))
    policy = build_policy(policy_name, values)
    found: list[InputWarning] = []
    if kind.object is ObjectOrigin.RECORDED:
        source = open_source(kind_name, settings, object_model=None, seed=config.seed)
        assert source.recorded is not None
        setup = RunSetup(
            source,
            object_name=source.recorded.object,
            mesh=source.recorded.mesh,
            sdf=source.recorded.sdf,
            start=source.start,
            warnings=tuple(source.warnings),
        )
    else:
        with _caught() as found:
            model = load_object(config.object, config.assets.folder)
            source = open_source(kind_name, settings, object_model=model, seed=config.seed)
            sdf = model.grid(settings)
        found += source.warnings
        if kind.object is ObjectOrigin.REAL:
            found += check_size(model, source.workspace)
        setup = RunSetup(
            source,
            object_name=model.name,
            mesh=model.mesh,
            sdf=sdf,
            start=source.start,
            object_resolution=model.resolution(settings),
            warnings=tuple(found),
        )
    if policy_name == GRID:
        return setup
    if not isinstance(source, Steerable):
        raise SessionError(
            f"session {kind_name} cannot be steered, as its probes are given; accepted: "
            "policy=grid, or a session that takes probes as they are chosen, such as kinematic"
        )
    actions = source.offer(policy.settings.actions)
    return replace(setup, start=FIRST_CONTACT, policy=policy, actions=actions)


@contextmanager
def _caught() -> Iterator[list[InputWarning]]:
    """Collect warnings about the object's mesh and grid, which belong into the recording."""
    found: list[InputWarning] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield found
    for each in caught:
        if isinstance(each.message, InputWarning):
            found.append(each.message)
        else:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)


def session_started(
    config: ProbeConfig, values: Mapping[str, Any], *, method_name: str, setup: RunSetup
) -> SessionStarted:
    """Return the first event of the recording."""
    source = setup.source
    recorded = {key: value for key, value in values.items() if key not in _NOT_OF_THE_RESULT}
    used = {
        "free_resolution": source.free_resolution,
        "object_resolution": setup.object_resolution,
    }
    # Numbers that settings leave to the object, so that a recording has them.
    recorded["session"] = {
        key: used.get(key) if value is None else value
        for key, value in without_defaults(values["session"]).items()
    }
    if setup.policy is None:
        recorded.pop("policy", None)
    if config.grasp.path is None:
        recorded.pop("grasp", None)
    if config.from_step is None:
        for name in ("from", "from_step"):
            recorded.pop(name, None)
    return SessionStarted(
        runner="probe",
        object=setup.object_name,
        session=str(config.session["kind"]),
        method=method_name,
        seed=config.seed,
        config=recorded,
        mesh=setup.mesh,
        sdf=setup.sdf,
        workspace=source.workspace,
        free_resolution=source.free_resolution,
        initial_points=source.initial_points,
        world_from_object=source.world_from_object,
        environment=environment(),
        start=setup.start,
        moves=setup.moves,
        prior=source.prior,
    )
