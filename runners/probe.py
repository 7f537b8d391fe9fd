"""`python -m runners.probe`: probe an object, register after every probe, record everything."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import trimesh
import yaml
from omegaconf import DictConfig

from chsel.errors import RecordingError, require_positive
from chsel.methods import build_method
from chsel.methods.method import Method
from chsel.sdf import SdfGrid
from chsel.settings import build_settings
from chsel.streams import StreamKey
from replay.environment import environment
from replay.events import Logged, Recorder, SessionEnded, SessionStarted
from replay.recording_info import recording_digest
from runners.cli import command, plain
from runners.display import Display, reading_bar
from runners.interrupt import Interrupt
from runners.objects.loader import ObjectConfig, load_object
from runners.objects.scans import AssetsConfig
from runners.recording import (
    RecordingConfig,
    make_run_folder,
    open_recorder,
    write_in_run_folder,
)
from runners.sensors.tally import Report
from runners.session_run import Row, SessionRun
from runners.sessions import open_session, session_settings
from runners.sessions.depth_frame import DepthFrameSession
from runners.sessions.recorded import RecordedSession
from runners.sessions.sensors import SensorsSession
from runners.sessions.session import Progress, Session, unwatched
from runners.whole_file import WritingError

_NOT_OF_THE_RESULT = ("assets", "logs", "recording", "threads")


@dataclass(frozen=True)
class PresetName:
    """The preset that the other choices followed."""

    name: str


@dataclass(frozen=True)
class ProbeConfig:
    """conf/probe.yaml, checked. session and method: checked by whoever they name."""

    object: ObjectConfig
    session: Any
    method: Any
    preset: PresetName
    recording: RecordingConfig
    assets: AssetsConfig
    logs: str
    seed: int = 0
    threads: int = 1
    configuration: str | None = None

    def __post_init__(self) -> None:
        StreamKey(self.seed, 0)
        require_positive("threads", self.threads)


@dataclass
class Watcher:
    """Hands progress on to whatever shows it at the time."""

    show: Progress = unwatched

    def __call__(self, stage: str, done: int, total: int) -> None:
        """See `Progress`."""
        self.show(stage, done, total)


@dataclass(frozen=True, eq=False)
class Scene:
    """The session and the object that it hides. watcher: is told of what the session reads."""

    session: Session
    object_name: str
    mesh: trimesh.Trimesh
    sdf: SdfGrid
    start: tuple[int, int]
    watcher: Watcher = field(default_factory=Watcher)

    @property
    def report(self) -> Report | None:
        """What became of sensors' images, once they are read."""
        session = self.session
        return session.report if isinstance(session, SensorsSession | DepthFrameSession) else None


@command("probe")
def main(config: DictConfig) -> None:
    """Run one session."""
    values = plain(config)
    checked = build_settings(ProbeConfig, values, "probe")
    torch.set_num_threads(checked.threads)
    method_config = dict(checked.method)
    method_name = str(method_config.pop("name", None))
    method = build_method(method_name, method_config)
    with reading_bar() as bar:
        scene = open_scene(checked, bar.show)
    try:
        folder = make_run_folder(Path(checked.logs) / "probe", scene.object_name, method_name)
        write_in_run_folder(folder / "config.yaml", yaml.safe_dump(values, sort_keys=False))
        started = session_started(checked, values, method_name, scene)
        with Interrupt() as interrupt:
            interrupted = run(folder, checked, method, scene, started, interrupt)
    finally:
        scene.session.close()
    if interrupted:
        sys.exit(130)


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
    object_model = load_object(config.object, config.assets.folder)
    session = open_session(kind, settings, object_model, config.seed, watcher)
    sdf = SdfGrid.from_mesh(
        object_model.mesh, settings.object_resolution, padding=settings.object_padding
    )
    start = (settings.start_contacts, settings.start_probe)
    return Scene(session, object_model.name, object_model.mesh, sdf, start, watcher)


def session_started(
    config: ProbeConfig, values: Mapping[str, Any], method_name: str, scene: Scene
) -> SessionStarted:
    """The first event of the recording."""
    session = scene.session
    return SessionStarted(
        runner="probe",
        object=scene.object_name,
        session=str(config.session["kind"]),
        method=method_name,
        seed=config.seed,
        config={key: value for key, value in values.items() if key not in _NOT_OF_THE_RESULT},
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
) -> bool:
    """Run the session to its end or to Ctrl-C; whether it was interrupted."""
    title = f"{started.object}, {started.session} session, {started.method}, "
    display = Display(
        title + f"preset {config.preset.name}, seed {config.seed}", scene.session.count
    )

    def show(stage: str, iteration: int, total: int) -> None:
        interrupt.check()
        display.working(stage, iteration, total)

    scene.watcher.show = show
    recorder = open_recorder(folder, config.recording)
    session_run = SessionRun(
        scene.session,
        method,
        scene.sdf,
        recorder,
        seed=config.seed,
        start=scene.start,
        recording=config.recording,
        show=show,
    )
    rows: list[Row] = []
    try:
        recorder.record(started)
        recorder.flush()
        for index, (_, row) in enumerate(session_run.steps()):
            rows.append(row)
            display.probe(index, row)
            interrupt.check()
        outcome = "finished"
    except KeyboardInterrupt:
        outcome = "interrupted"
    except SystemExit:  # whoever read the output has had enough of it
        _finish(folder, recorder, session_run.step, started, rows, "interrupted")
        raise
    except Exception as error:
        with suppress(OSError, WritingError):  # the first error is the one to tell
            _finish(folder, recorder, session_run.step, started, rows, f"failed: {error}")
        raise
    finally:
        display.close()
    _finish(folder, recorder, session_run.step, started, rows, outcome)
    if scene.report is not None:
        display.sensed(scene.report)
    display.table(rows)
    if outcome == "interrupted":
        display.say("interrupted: the recording holds everything up to here")
    display.written(folder, _sizes(folder))
    return outcome == "interrupted"


def _finish(
    folder: Path,
    recorder: Recorder,
    step: int,
    started: SessionStarted,
    rows: list[Row],
    outcome: str,
) -> None:
    """End the recording, and write the summary even if the recording is what has failed."""
    finished = outcome == "finished"
    try:
        with nullcontext() if finished else suppress(RecordingError):
            _end(recorder, step, "info" if finished else "warning", outcome)
    except RecordingError as error:
        with suppress(OSError, WritingError):  # the first error is the one to tell
            _summarise(folder, started, rows, f"failed: {error}")
        raise
    _summarise(folder, started, rows, outcome)


def _end(recorder: Recorder, step: int, level: str, outcome: str) -> None:
    try:
        recorder.record(Logged(step, level, f"session {outcome}"))
        recorder.record(SessionEnded(step, outcome))
    finally:
        recorder.close()


def _summarise(folder: Path, started: SessionStarted, rows: list[Row], outcome: str) -> None:
    """Write summary.json: the outcome and the numbers of every step, wall-clock times included."""
    summary = {
        "runner": started.runner,
        "object": started.object,
        "session": started.session,
        "method": started.method,
        "seed": started.seed,
        "outcome": outcome,
        "recording_digest": recording_digest(folder / "recording.mcap"),
        "steps": rows,
        "bytes": _sizes(folder),
        "environment": dict(started.environment),
    }
    write_in_run_folder(folder / "summary.json", json.dumps(summary, indent=2) + "\n")


def _sizes(folder: Path) -> dict[str, int]:
    return {file.name: file.stat().st_size for file in sorted(folder.iterdir())}


if __name__ == "__main__":
    main()
