"""`python -m runners.probe`: probe an object, register after every probe, record everything."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Mapping
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from omegaconf import DictConfig

from chsel.errors import InputWarning, RecordingError
from chsel.methods import build_method
from chsel.methods.method import Method
from chsel.numerics.threads import require_threads
from chsel.problem.online_registration import OnlineRegistration, OnlineSettings, Start
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import build_settings
from chsel.problem.streams import StreamKey
from replay.environment import environment
from replay.events import Logged, Recorder, SessionEnded, SessionStarted
from replay.files import WritingError
from replay.recording_info import recording_digest
from replay.registration import symmetry_for_errors
from replay.startup import importing
from runners.command.interrupt import Interrupt
from runners.command.program import command, plain
from runners.objects.loader import ObjectConfig, ObjectModel, load_object
from runners.objects.scans import AssetsConfig
from runners.objects.size_check import check_size
from runners.run.compiling import Compiling
from runners.run.display import Display, reading_bar
from runners.run.recording import (
    RecordingConfig,
    make_run_folder,
    open_recorder,
    write_in_run_folder,
)
from runners.run.session_run import Row, SessionRun
from runners.sensors.session_report import Report
from runners.sessions import open_session, session_settings
from runners.sessions.depth_frame import DepthFrameSession
from runners.sessions.faults import without_clean_faults
from runners.sessions.recorded import RecordedSession
from runners.sessions.sensors import SensorsSession
from runners.sessions.session import Progress, Session, unwatched

if TYPE_CHECKING:
    import trimesh

_OF_REAL_OBJECTS = ("points", "sensors")  # sessions whose points come from real objects
_NOT_OF_THE_RESULT = ("assets", "logs", "recording", "threads")


@dataclass(frozen=True)
class PresetName:
    """The preset that the other choices followed."""

    name: str


@dataclass(frozen=True)
class ProbeConfig:
    """conf/probe.yaml, which has all defaults, checked.

    session and method: checked by whoever they name.
    """

    object: ObjectConfig
    session: Any
    method: Any
    preset: PresetName
    recording: RecordingConfig
    assets: AssetsConfig
    logs: str
    seed: int
    threads: int
    configuration: str | None

    def __post_init__(self) -> None:
        StreamKey(self.seed, 0)
        require_threads("threads", self.threads)


@dataclass
class Watcher:
    """Hands progress on to whatever shows it at the time."""

    show: Progress = unwatched

    def __call__(self, stage: str, done: int, total: int) -> None:
        """See `Progress`."""
        self.show(stage, done, total)


@dataclass(frozen=True, eq=False)
class Scene:
    """The session and the object that it hides. watcher: is told of what the session reads.

    warnings: about the object.
    """

    session: Session
    object_name: str
    mesh: trimesh.Trimesh
    sdf: SdfGrid
    start: Start
    watcher: Watcher = field(default_factory=Watcher)
    warnings: tuple[InputWarning, ...] = ()

    @property
    def report(self) -> Report | None:
        """What became of sensors' images, once they are read."""
        session = self.session
        return session.report if isinstance(session, SensorsSession | DepthFrameSession) else None

    def online(self, settings: OnlineSettings, seed: int) -> OnlineRegistration:
        """The loop of the session, before its first step; see `OnlineRegistration`."""
        return OnlineRegistration(
            self.sdf,
            self.session.workspace,
            self.session.free_resolution,
            settings,
            seed=seed,
            points=self.session.initial_points,
            start=self.start,
        )


@command("probe")
def main(config: DictConfig) -> None:
    """Run one session."""
    values = plain(config)
    checked = build_settings(ProbeConfig, values, "probe")
    display = Display(f"{_title(checked)}, preset {checked.preset.name}, seed {checked.seed}")
    with importing():  # what takes long, after there is something to read
        import igl  # noqa: F401
        import torch
        import trimesh  # noqa: F401
    torch.set_num_threads(checked.threads)
    method_config = dict(checked.method)
    method_name = str(method_config.pop("name", None))
    method = build_method(method_name, method_config)
    with ExitStack() as stack:
        with Compiling() as kernels:
            with reading_bar() as bar:
                scene = open_scene(checked, bar.show)
            stack.callback(scene.session.close)
            kernels.rehearse(method, sensing=checked.session["kind"] == "sensors")
        folder = make_run_folder(Path(checked.logs) / "probe", scene.object_name, method_name)
        write_in_run_folder(folder / "config.yaml", yaml.safe_dump(values, sort_keys=False))
        started = session_started(checked, values, method_name, scene)
        with Interrupt() as interrupt:
            interrupted = run(folder, checked, method, scene, started, interrupt, display)
    if interrupted:
        sys.exit(130)


def _title(config: ProbeConfig) -> str:
    """What is run; the object of a recorded session is known once it is read."""
    kind = str(config.session.get("kind"))
    session = f"{kind} session, {config.method.get('name')}"
    return session if kind == "recorded" else f"{config.object.name}, {session}"


def open_scene(config: ProbeConfig, show: Progress = unwatched) -> Scene:
    """Open the session with its object; a recorded session brings its own."""
    watcher = Watcher(show)
    session_config = dict(config.session)
    kind = str(session_config.pop("kind", None))
    settings = session_settings(kind, session_config)
    if kind == "recorded":
        recorded = RecordedSession(settings)
        of = recorded.recorded
        return Scene(recorded, of.object, of.mesh, of.sdf, recorded.start)
    object_model, found = _load_object(config)
    session = open_session(kind, settings, object_model, config.seed, watcher)
    sdf = object_model.grid(settings, watcher)
    start = Start(settings.start_contacts, settings.start_probe)
    if kind in _OF_REAL_OBJECTS:
        found += check_size(object_model, session.workspace)
    name, mesh = object_model.name, object_model.mesh
    return Scene(session, name, mesh, sdf, start, watcher, tuple(found))


def _load_object(config: ProbeConfig) -> tuple[ObjectModel, list[InputWarning]]:
    """The object, and warnings about its mesh, which belong into the recording."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        object_model = load_object(config.object, config.assets.folder)
    found = []
    for each in caught:
        if isinstance(each.message, InputWarning):
            found.append(each.message)
        else:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    return object_model, found


def session_started(
    config: ProbeConfig, values: Mapping[str, Any], method_name: str, scene: Scene
) -> SessionStarted:
    """The first event of the recording."""
    session = scene.session
    recorded = {key: value for key, value in values.items() if key not in _NOT_OF_THE_RESULT}
    recorded["session"] = without_clean_faults(values["session"])
    return SessionStarted(
        runner="probe",
        object=scene.object_name,
        session=str(config.session["kind"]),
        method=method_name,
        seed=config.seed,
        config=recorded,
        mesh=scene.mesh,
        sdf=scene.sdf,
        workspace=session.workspace,
        free_resolution=session.free_resolution,
        initial_points=session.initial_points,
        world_from_object=session.world_from_object,
        environment=environment(),
    )


def run(
    folder: Path,
    config: ProbeConfig,
    method: Method,
    scene: Scene,
    started: SessionStarted,
    interrupt: Interrupt,
    display: Display,
) -> bool:
    """Run the session to its end or to Ctrl-C; whether it was interrupted."""
    if started.session == "recorded":  # the title was printed before its object was known
        display.say(f"object: {started.object}")
    display.probes(scene.session.count)

    def show(stage: str, iteration: int, total: int) -> None:
        interrupt.check()
        display.working(stage, iteration, total)

    scene.watcher.show = show
    recorder = open_recorder(folder, config.recording)
    session_run = SessionRun(
        scene.session,
        scene.online(method.online, config.seed),
        method,
        recorder,
        symmetry=symmetry_for_errors(started),
        recording=config.recording,
        show=show,
        opening=scene.warnings,
    )
    display.warn(scene.warnings)
    rows: list[Row] = []
    try:
        recorder.record(started)
        recorder.flush()
        for _, row in session_run.steps():
            rows.append(row)
            display.probe(row)
            display.warn(session_run.warnings)
            interrupt.check()
        display.warn(session_run.warnings)
        outcome = "finished"
    except KeyboardInterrupt:
        outcome = "interrupted"
    except SystemExit:  # whoever read the output has had enough of it
        _finish(folder, recorder, session_run, started, rows, scene.report, "interrupted")
        raise
    except Exception as error:
        with suppress(OSError, WritingError):  # the first error is the one to tell
            _finish(folder, recorder, session_run, started, rows, scene.report, f"failed: {error}")
        raise
    finally:
        display.close()
    _finish(folder, recorder, session_run, started, rows, scene.report, outcome)
    if scene.report is not None:
        display.sensed(scene.report)
    display.table(rows)
    if outcome == "interrupted":
        display.say("interrupted: the recording holds everything up to here")
    display.written(folder, _sizes(folder))
    display.verdict(session_run.trust)
    return outcome == "interrupted"


def _finish(
    folder: Path,
    recorder: Recorder,
    session_run: SessionRun,
    started: SessionStarted,
    rows: list[Row],
    report: Report | None,
    outcome: str,
) -> None:
    """End the recording, and write the summary even if the recording is what has failed."""
    finished = outcome == "finished"
    try:
        with nullcontext() if finished else suppress(RecordingError):
            _end(recorder, session_run.step, "info" if finished else "warning", outcome)
    except RecordingError as error:
        with suppress(OSError, WritingError):  # the first error is the one to tell
            _summarise(folder, started, rows, session_run, report, f"failed: {error}")
        raise
    _summarise(folder, started, rows, session_run, report, outcome)


def _end(recorder: Recorder, step: int, level: str, outcome: str) -> None:
    try:
        recorder.record(Logged(step, level, f"session {outcome}"))
        recorder.record(SessionEnded(step, outcome))
    finally:
        recorder.close()


def _summarise(
    folder: Path,
    started: SessionStarted,
    rows: list[Row],
    session_run: SessionRun,
    report: Report | None,
    outcome: str,
) -> None:
    """Write summary.json: the outcome, warnings, and the numbers of every step, times included."""
    trust = session_run.trust
    sensors = report.total().items() if report else ()
    summary = {
        "runner": started.runner,
        "object": started.object,
        "session": started.session,
        "method": started.method,
        "seed": started.seed,
        "outcome": outcome,
        "recording_digest": recording_digest(folder / "recording.mcap"),
        "trust": None if trust is None else asdict(trust),  # of the last result
        "warnings": [asdict(warning) for warning in session_run.warnings],
        "sensors": {name: asdict(counts) for name, counts in sensors},
        "steps": rows,
        "bytes": _sizes(folder),
        "environment": dict(started.environment),
    }
    write_in_run_folder(folder / "summary.json", json.dumps(summary, indent=2) + "\n")


def _sizes(folder: Path) -> dict[str, int]:
    return {file.name: file.stat().st_size for file in sorted(folder.iterdir())}


if __name__ == "__main__":
    main()
