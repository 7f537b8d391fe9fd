"""`python -m runners.probe`: probe an object, register after every probe, record everything."""

from __future__ import annotations

import json
import signal
import sys
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import asdict, replace
from pathlib import Path
from types import FrameType
from typing import Self

import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from chsel.errors import RecordingError
from chsel.events import SessionStarted
from chsel.methods import build_method
from chsel.methods.method import Method
from chsel.numerics.compiler import watched
from chsel.numerics.threads import set_threads
from chsel.problem.settings import build_settings
from chsel.session.rehearsal import warm_up, warm_up_policy, warm_up_sensing
from chsel.session.run import Run
from replay.console import Console
from replay.files import WritingError, file_digest
from replay.recorder import open_recorder
from runners.command.choices import calls_for_anchored
from runners.command.program import command, plain, require_used
from runners.run.display import Display, compiling_line
from runners.run.grasps import Grasps
from runners.run.recording import make_run_folder, write_in_run_folder
from runners.run.session_run import Row, steps
from runners.run.setup import GRID, ProbeConfig, RunSetup, open_setup, session_started
from runners.sessions import kinds_of, source_kind
from runners.sessions.physics_engine import with_engine
from runners.sessions.recorded import RecordedSource
from runners.sessions.source import ObjectOrigin


@command("probe")
def main(config: DictConfig) -> None:
    """Run one session."""
    values = plain(config)
    values["session"] = with_engine(values["session"])
    named = {"from_step" if name == "from" else name: value for name, value in values.items()}
    checked = build_settings(ProbeConfig, named, where="probe")
    _require_used_settings(checked)
    method_config = dict(checked.method)
    kind = checked.session.get("kind")
    method_name = str(method_config.pop("name", None))
    title = f"{_session_title(checked)}, {method_name}, preset {checked.preset.name}"
    title += f", seed {checked.seed}"
    if source_kind(kind).object is not ObjectOrigin.RECORDED:  # that is known once it is read
        title = f"{checked.object.name}, {title}"
    display = Display(title)
    if why := _default_because():
        display.say(f"method={method_name} (the default for {why}; method=chsel is the paper's)")
    set_threads(checked.threads)
    grasps = checked.grasp.grasps()
    method = build_method(method_name, method_config)
    with ExitStack() as stack:
        with Console().status("opening the session"), watched(lambda _: None):
            setup = open_setup(checked)
        stack.callback(setup.source.close)
        with compiling_line():
            warm_up(method)
            if setup.policy is not None:
                warm_up_policy(setup.policy)
            if setup.report is not None:  # of sensors
                warm_up_sensing()
        folder = make_run_folder(Path(checked.logs) / "probe", setup.object_name, method_name)
        write_in_run_folder(folder / "config.yaml", yaml.safe_dump(values, sort_keys=False))
        started = session_started(checked, values, method_name=method_name, setup=setup)
        if isinstance(setup.source, RecordedSource) and checked.from_step is not None:
            setup.source.require_step(checked.from_step)
            started = replace(started, start=None, source=setup.source.digest)
        with Interrupt() as interrupt:
            interrupted = run_session(
                folder,
                checked,
                method=method,
                setup=setup,
                started=started,
                grasps=grasps,
                interrupt=interrupt,
                display=display,
            )
    if interrupted:
        sys.exit(130)


def _session_title(config: ProbeConfig) -> str:
    """Return what a session is called, a simulated one with its engine."""
    kind = config.session.get("kind")
    return f"{kind} session" + (f" in {config.session['engine']}" if kind == "simulated" else "")


def _require_used_settings(config: ProbeConfig) -> None:
    """Raise SettingError for a setting that would change nothing, as another choice is made."""
    kind = config.session.get("kind")
    origin = source_kind(kind).object
    recording = config.recording
    if config.policy.get("name") == GRID:
        reason = "without policy=NAME, or with grid, a session probes in its own order"
        require_used("policy.", reason=reason, accepted="policy=expected_loss, or another, with it")
    else:
        starts = (f"session.{name}" for name in ("start_contacts", "start_probe"))
        reason = "a session with a policy registers from its first contact on"
        require_used(*starts, reason=reason, accepted="policy=grid with it")
    if kind == "kinematic":
        reason, accepted = "a kinematic session has no physics engine", "session=simulated with it"
        require_used("session.engine", reason=reason, accepted=accepted)
    if origin is not ObjectOrigin.RECORDED:
        reason, accepted = "a session of its own begins at its start", "session=recorded with it"
        require_used("from", reason=reason, accepted=accepted)
    if origin is ObjectOrigin.RECORDED:
        reason, accepted = "a recorded session brings its own object", "another session with it"
        require_used("object", "configuration", reason=reason, accepted=accepted)
    elif origin is not ObjectOrigin.PLACED:
        accepted = f"session={' or '.join(kinds_of(ObjectOrigin.PLACED))} with it"
        reason = f"a session of kind {kind} has its own place of the object"
        require_used("configuration", "object.configuration", reason=reason, accepted=accepted)
    if config.grasp.path is None:
        require_used("grasp", reason="grasp.path is not given", accepted="grasp.path=FILE with it")
    if not (recording.mcap or recording.rerun or recording.live):
        reason, accepted = "nothing is recorded", "recording=both, mcap or rerun with it"
        unused = (f"recording.{name}" for name in ("snapshot_interval", "timings"))
        require_used(*unused, reason=reason, accepted=accepted)


def _default_because() -> str:
    """Return the choice for which `anchored` was taken as the default; else ""."""
    chosen = HydraConfig.get()
    choices = chosen.runtime.choices
    if choices["method"] == "chsel" or any(w.startswith("method=") for w in chosen.overrides.task):
        return ""
    return calls_for_anchored(choices["session"], choices["policy"])


class Interrupt:
    """Within this context the first Ctrl-C is remembered, and the second takes effect at once."""

    def __init__(self) -> None:
        self._asked = False
        self._previous = signal.getsignal(signal.SIGINT)

    def __enter__(self) -> Self:
        signal.signal(signal.SIGINT, self._remember)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def check(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C was pressed."""
        if self._asked:
            raise KeyboardInterrupt

    def _remember(self, _: int, __: FrameType | None) -> None:
        self.check()
        self._asked = True


def run_session(
    folder: Path,
    config: ProbeConfig,
    *,
    method: Method,
    setup: RunSetup,
    started: SessionStarted,
    grasps: Grasps | None,
    interrupt: Interrupt,
    display: Display,
) -> bool:
    """Run the session to its end or to Ctrl-C; return whether it was interrupted."""
    if setup.source.recorded is not None:
        display.say(f"object: {started.object}")
    policy = setup.policy
    display.probes(setup.source.count if policy is None else policy.settings.probes)
    settings = config.recording
    run = Run(
        method,
        open_recorder(
            folder / "recording.mcap" if settings.mcap else None,
            folder / "recording.rrd" if settings.rerun else None,
            live=settings.live,
        ),
        policy=policy,
        with_belief=True,
        opening=setup.warnings,
        snapshot_interval=settings.snapshot_interval,
        show=lambda *_: interrupt.check(),
    )
    setup.begin(run, started)
    if config.from_step is not None:
        assert isinstance(setup.source, RecordedSource)
        setup.source.retrace(run, config.from_step)
    display.warn(setup.warnings)
    rows: list[Row] = []
    outcome = "finished"
    try:
        try:
            for row in steps(run, setup.source, timings=settings.timings, grasps=grasps):
                rows.append(row)
                display.probe(row)
                display.warn(run.warnings)
                interrupt.check()
            run.check_moved()
            display.warn(run.warnings)
        except KeyboardInterrupt:
            outcome = "interrupted"
        except SystemExit:  # the reader of the output has closed it
            outcome = "interrupted"
            raise
        except Exception as error:
            outcome = f"failed: {error}"
            raise
        finally:
            with _first_error_alone(outcome):
                run.end(outcome)
    except RecordingError as error:
        outcome = f"failed: {error}"
        raise
    finally:
        with _first_error_alone(outcome):
            _summarise(folder, setup, run=run, rows=rows, outcome=outcome)
    if setup.report is not None:
        display.sensed(setup.report)
    display.table(rows)
    if outcome == "interrupted":
        display.say("interrupted: the recording holds everything up to here")
    if run.stop == "grasp":
        display.grasped(run)
    elif run.loop.state.decided is not None:
        display.stopped(run.loop.state.decided)
    display.written(folder)
    display.pose(rows)
    display.verdict(run.trust)
    return outcome == "interrupted"


def _first_error_alone(outcome: str) -> suppress | nullcontext[None]:
    """Suppress errors of writing where a run has failed or was interrupted."""
    if outcome == "finished":
        return nullcontext()
    return suppress(OSError, RecordingError, WritingError)


def _summarise(folder: Path, setup: RunSetup, *, run: Run, rows: list[Row], outcome: str) -> None:
    """Write the outcome, warnings, and the numbers of every step, times included."""
    started = run.started
    trust = run.trust
    recording = folder / "recording.mcap"
    sensors = setup.report.total().items() if setup.report else ()
    names = ("runner", "object", "session", "method", "seed")
    summary = {
        **{name: getattr(started, name) for name in names},
        "outcome": outcome,
        "recording_digest": file_digest(recording) if recording.is_file() else None,
        "trust": None if trust is None else asdict(trust),  # of the last result
        "warnings": [asdict(warning) for warning in run.warnings],
        "sensors": {name: asdict(counts) for name, counts in sensors},
        "steps": rows,
        "environment": dict(started.environment),
    }
    write_in_run_folder(folder / "summary.json", json.dumps(summary, indent=2) + "\n")


if __name__ == "__main__":
    main()
