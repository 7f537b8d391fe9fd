"""`python -m tests.tools.kill_sessions --count N --seed S`: kills sessions, and recovers them.

Each session runs in a fork of this process, where all is imported and compiled, through the code
of `runners.probe`, and says on a pipe what its display says. At a random moment it gets SIGKILL.
Then every probe that it had reported must come back, with all its events, to the bit.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import hydra
import numpy as np
import torch
import trimesh

from chsel.errors import RecordingError
from chsel.methods import build_method
from chsel.problem.poses import apply, axis_angle, compose
from chsel.problem.settings import build_settings
from replay.events import Event, Probe, ProblemPosed, SessionEnded
from replay.mcap.reader import read_recording
from replay.mcap.recovery import recover, tells_loss
from runners.command.choices import CONF, store_choices
from runners.command.program import plain
from runners.probe import Interrupt, run
from runners.run.display import Display
from runners.run.recording import make_run_folder
from runners.run.scene import ProbeConfig, open_scene, session_started
from tests.replay.conftest import same_bits

METHODS = ("gradient_descent", "chsel")
PROBES = 6
_QUICK = ("method.descent.restarts=2", "method.descent.iterations=20", "recording=mcap")
_CHSEL = ("method.emitter.iterations=40", "recording.snapshot_interval=10")
_POSE = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.5)), np.array([0.1, 0.2, 0.3]))


@dataclass(frozen=True, eq=False)
class Reference:
    """A session that nobody disturbs. events: all it records. seconds: that a fork of it takes."""

    run: Callable[[Path], None]
    events: list[Event]
    seconds: float


def points_session(folder: Path, probes: int = PROBES) -> tuple[str, ...]:
    """A point file of a box in `folder`, and the overrides that select it."""
    box = trimesh.creation.box((0.1, 0.06, 0.2))
    box.export(folder / "box.ply")
    surface = apply(_POSE, trimesh.sample.sample_surface(box, 5 * probes, seed=0)[0])
    free = np.random.default_rng(0).uniform(0.3, 0.6, (10 * probes, 3))
    np.savez(
        folder / "box.npz",
        surface=surface,
        surface_step=np.arange(len(surface)) // 5,
        free=free,
        free_step=np.arange(len(free)) % probes,
        world_from_object=_POSE,
    )
    return (
        "session=points",
        f"session.path={folder / 'box.npz'}",
        "session.object_resolution=0.01",
        "object=mesh",
        f"object.path={folder / 'box.ply'}",
    )


def reported_probes(output: str) -> int:
    """How many whole lines of a session's output are about a probe that is done."""
    lines = output.splitlines(keepends=True)
    return sum(re.fullmatch(r"probe +\d+ .*\n", line) is not None for line in lines)


def kill_many(count: int, seed: int) -> str:
    """Run and kill `count` sessions. AssertionError at the first that does not come back right."""
    torch.set_num_threads(1)
    random = np.random.default_rng(seed)
    without = ended = reported = recovered = 0
    with tempfile.TemporaryDirectory(prefix="kill-") as name:
        folder = Path(name)
        references = [_reference(folder, method) for method in METHODS]
        for index in range(count):
            reference = references[index % len(references)]
            logs = folder / str(index)
            output, killed = _forked(reference, logs, random.uniform(0.0, reference.seconds))
            told = reported_probes(output)
            kept = _recovered_probes(reference.events, logs, told)
            ended += not killed
            without += kept is None
            reported += told
            recovered += kept or 0
            shutil.rmtree(logs, ignore_errors=True)  # there may be none yet
    return (
        f"{count} kills, {without} before there was a session, {ended} after its end; {reported} "
        f"probes reported, {recovered} recovered, every event equal"
    )


def _reference(folder: Path, method: str) -> Reference:
    """The session with a method; its kernels are compiled behind this."""
    session = quick_session(folder, method)
    logs = folder / f"reference_{method}"
    with redirect_stdout(io.StringIO()):
        session(logs)
    (path,) = logs.rglob("recording.mcap")
    events = list(read_recording(path).events())
    assert sum(isinstance(event, ProblemPosed) for event in events) == PROBES
    begun = time.perf_counter()
    output, killed = _forked(Reference(session, events, 60.0), folder / "timed", 60.0)
    assert not killed
    assert reported_probes(output) == PROBES
    return Reference(session, events, time.perf_counter() - begun)


def quick_session(folder: Path, method_name: str) -> Callable[[Path], None]:
    """What the command does, into the logs it is given, once its scene is open."""
    store_choices()
    chsel = _CHSEL if method_name == "chsel" else ()
    overrides = [*points_session(folder), f"method={method_name}", *_QUICK, *chsel]
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        values = plain(hydra.compose("probe", overrides))
    checked = build_settings(ProbeConfig, values, "probe")
    config = {name: value for name, value in checked.method.items() if name != "name"}
    method = build_method(method_name, config)
    scene = open_scene(checked)
    started = session_started(checked, values, method_name, scene)

    def session(logs: Path) -> None:
        folder = make_run_folder(logs / "probe", scene.object_name, method_name)
        run(folder, checked, method, scene, started, Interrupt(), Display("killed"))

    return session


def _forked(reference: Reference, logs: Path, moment: float) -> tuple[str, bool]:
    """What a session in a fork printed before it was killed or ended, and whether it was killed."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.close(reading)
            os.dup2(writing, 1)
            sys.stdout = os.fdopen(1, "w", encoding="utf-8")
            reference.run(logs)
            sys.stdout.flush()
            status = 0
        finally:
            os._exit(status)
    os.close(writing)
    killed = _killed(child, moment)
    with os.fdopen(reading, encoding="utf-8") as pipe:
        return pipe.read(), killed


def _killed(child: int, moment: float) -> bool:
    """Whether a child lived up to a moment, in seconds from now, and was killed then."""
    deadline = time.perf_counter() + moment
    while time.perf_counter() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            assert status == 0, "a session failed by itself"
            return False
        time.sleep(min(0.002, max(0.0, deadline - time.perf_counter())))
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


def _recovered_probes(expected: list[Event], logs: Path, reported: int) -> int | None:
    """How many probes come back, every event equal; None if there was no session yet."""
    paths = list(logs.rglob("recording.mcap"))
    out = logs / "recovered.mcap"
    try:
        if not paths:
            raise RecordingError("there is no file yet")
        found = recover(paths[0], out)
    except RecordingError:
        if reported > 0 or out.exists():
            raise
        return None
    events = list(read_recording(out).events())
    if not found.ended:
        assert isinstance(events[-1], SessionEnded)
        events = events[:-1]
        if tells_loss(events[-1]):  # killed within a write, of what was not yet reported
            events = events[:-1]
    for index, (event, wanted) in enumerate(zip(events, expected, strict=False)):
        assert same_bits(event, wanted), f"event {index}, {type(wanted).__name__}, differs"
    assert len(events) <= len(expected)
    assert len(events) >= _count_of_reported(expected, reported)
    return len(found.probes)


def _count_of_reported(events: list[Event], reported: int) -> int:
    """How many events there were when so many probes had been reported."""
    starts = [index for index, event in enumerate(events) if isinstance(event, Probe)]
    last_two = 2  # what the session's end adds
    return [*starts, len(events) - last_two][reported] if reported else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print(kill_many(given.count, given.seed))
