"""What recording adds to a step of `runners.probe`, against the same step with recording=none.

A step is all that a session waits for between two probes: a problem is posed and registered, its
result is judged (trust, errors), and all of it is in the file, to be read after a crash.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from chsel.problem.points import KnownPoints
from replay.environment import environment
from replay.events import Probe, ProblemPosed, Recorder, SessionStarted
from replay.registration import register_recorded, symmetry_for_errors
from runners.benchmarks.problems import PosedProblem, drill
from runners.benchmarks.registrations import Steps, method
from runners.benchmarks.timing import in_turn
from runners.run.recording import RecordingConfig, open_recorder

_PROBE = 0.1  # seconds: what a probe takes, in which a recorder may end what it has begun
NO_FILE = "none"
_FILES = {
    NO_FILE: RecordingConfig(mcap=False, rerun=False),
    "mcap": RecordingConfig(rerun=False),
    "both": RecordingConfig(),
}


def recorded_registrations(
    posed: PosedProblem, preset: str, steps: Steps, repeats: int
) -> dict[str, tuple[float, ...]]:
    """Milliseconds of steps by what is recorded, in turn: "none", "mcap", "both"."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        sessions: dict[str, Callable[[], float]] = {}
        for name, files in _FILES.items():
            (folder / name).mkdir()
            recorder = open_recorder(folder / name, files)
            stack.callback(recorder.close)
            sessions[name] = _session(recorder, posed, preset, steps, files.snapshot_interval)
        return in_turn(repeats, sessions)


def _session(
    recorder: Recorder, posed: PosedProblem, preset: str, steps: Steps, snapshot_interval: int
) -> Callable[[], float]:
    """Opens a recording, and returns what takes its next step in milliseconds.

    All points are those of the first probe; the others, without any, are recorded in their steps.
    """
    started = _started(posed, preset)
    symmetry = symmetry_for_errors(started)
    recorder.record(started)
    recorder.record(Probe(0, "points", posed.registration_problem().points))
    recorder.flush()
    step = 0

    def take_step() -> float:
        nonlocal step
        if step > 0:
            recorder.record(Probe(step, "points", KnownPoints()))
        begun = time.perf_counter()
        register_recorded(
            ProblemPosed(step, posed.registration_problem()),
            method(preset, steps, steps.search),
            recorder,
            started.world_from_object,
            symmetry,
            snapshot_interval=snapshot_interval,
        )
        recorder.flush()
        step += 1
        taken = 1000.0 * (time.perf_counter() - begun)
        time.sleep(_PROBE)
        return taken

    return take_step


def _started(posed: PosedProblem, preset: str) -> SessionStarted:
    mesh, _ = drill(1.0)
    return SessionStarted(
        runner="benchmark",
        object="drill",
        session="points",
        method="chsel",
        seed=0,
        config={},
        mesh=mesh,
        sdf=posed.sdf,
        workspace=posed.workspace,
        free_resolution=posed.free_spacing,
        initial_points=KnownPoints(),
        world_from_object=posed.world_from_object,
        environment=environment(),
    )
