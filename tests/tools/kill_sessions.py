"""`python -m tests.tools.kill_sessions --count N --seed S`: kills sessions, and recovers them.

Each session is `runners.probe` in a fork of this process, where all is imported and compiled, and
says on a pipe what its display says. At a random moment it gets SIGKILL.
Then every probe that it had reported must come back, with all its events, to the bit.
"""

import argparse
import math
import os
import re
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
import trimesh

from chsel.errors import RecordingError
from chsel.events import Probe, ProblemPosed, SessionEnded
from chsel.problem.poses import apply, axis_angle, compose
from replay.mcap.reader import read_recording
from replay.mcap.recovery import recover, tells_loss
from runners import probe
from tests.replay.conftest import same_bits
from tests.runners.in_process import run

METHODS = ("gradient_descent", "chsel")
PROBES = 6
_QUICK = ("method.descent.restarts=2", "method.descent.iterations=20", "recording=mcap")
_CHSEL = ("method.emitter.iterations=40", "recording.snapshot_interval=10")
_POSE = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.5)), np.array([0.1, 0.2, 0.3]))


def points_session(folder, probes=PROBES):
    """A point file of a box in `folder`, and the overrides that select it."""
    box = trimesh.creation.box((0.1, 0.06, 0.2))
    box.export(folder / "box.ply")
    np.savez(
        folder / "box.npz",
        surface=apply(_POSE, trimesh.sample.sample_surface(box, 5 * probes, seed=0)[0]),
        surface_step=np.arange(5 * probes) // 5,
        free=np.random.default_rng(0).uniform(0.3, 0.6, (10 * probes, 3)),
        free_step=np.arange(10 * probes) % probes,
        world_from_object=_POSE,
    )
    return (
        "session=points",
        f"session.path={folder / 'box.npz'}",
        "session.object_resolution=0.01",
        "object=mesh",
        f"object.path={folder / 'box.ply'}",
    )


def reported_probes(output):
    """How many whole lines of a session's output are about a probe that is done."""
    return len(re.findall(r"^probe +\d+ .*\n", output, re.MULTILINE))


def kill_many(count, seed):
    """Run and kill `count` sessions. AssertionError at the first that does not come back right."""
    torch.set_num_threads(1)
    random = np.random.default_rng(seed)
    without = ended = reported = recovered = 0
    with tempfile.TemporaryDirectory(prefix="kill-") as name:
        folder = Path(name)
        references = [_reference(folder, method) for method in METHODS]
        for index in range(count):
            overrides, events, seconds = references[index % len(references)]
            logs = folder / str(index)
            output, killed, _ = _forked(overrides, logs, random.uniform(0.0, seconds))
            told = reported_probes(output)
            kept = _recovered_probes(events, logs, told)
            ended += not killed
            without += kept is None
            reported += told
            recovered += kept or 0
    return (
        f"{count} kills, {without} before there was a session, {ended} after its end; {reported} "
        f"probes reported, {recovered} recovered, every event equal"
    )


def _reference(folder, method):
    """Overrides of a session, all that it records, and the seconds that its file is open."""
    more = _CHSEL if method == "chsel" else ()
    overrides = [*points_session(folder), f"method={method}", *_QUICK, *more]
    logs = folder / f"reference_{method}"
    assert run(probe.main, *overrides, f"logs={logs}").returncode == 0  # compiles its kernels, too
    (path,) = logs.rglob("recording.mcap")
    events = list(read_recording(path).events())
    assert sum(isinstance(event, ProblemPosed) for event in events) == PROBES
    output, killed, seconds = _forked(overrides, folder / "timed", 60.0)
    assert (killed, reported_probes(output)) == (False, PROBES)
    return overrides, events, seconds


def _forked(overrides, logs, moment):
    """What a session in a fork printed, whether it was killed, and seconds that it had a file.

    It is killed a moment, in seconds, after it has made its file.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.close(reading)
            os.dup2(writing, 1)
            sys.stdout = os.fdopen(1, "w", encoding="utf-8")
            sys.argv = ["probe", *overrides, f"logs={logs}"]
            probe.main()
            sys.stdout.flush()
            status = 0
        finally:
            os._exit(status)
    os.close(writing)
    done, made = 0, math.inf
    while not done and time.perf_counter() < made + moment:
        time.sleep(0.002)
        if made == math.inf and any(logs.rglob("recording.mcap")):
            made = time.perf_counter()
        done, status = os.waitpid(child, os.WNOHANG)
    lived = time.perf_counter() - made
    if not done:
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    assert status in (0, signal.SIGKILL), "a session failed by itself"
    with os.fdopen(reading, encoding="utf-8") as pipe:
        return pipe.read(), os.WIFSIGNALED(status), lived


def _recovered_probes(expected, logs, reported):
    """How many probes come back, every event equal; None if there was no session yet."""
    paths, out = list(logs.rglob("recording.mcap")), logs / "recovered.mcap"
    try:
        found = recover(paths[0], out) if paths else None
    except RecordingError:
        found = None
    if found is None:
        assert reported == 0
        assert not out.exists()
        return None
    events = list(read_recording(out).events())
    if not found.ended:
        assert isinstance(events.pop(), SessionEnded)
        if tells_loss(events[-1]):  # killed within a write, of what was not yet reported
            events.pop()
    for index, (event, wanted) in enumerate(zip(events, expected, strict=False)):
        assert same_bits(event, wanted), f"event {index}, {type(wanted).__name__}, differs"
    starts = [index for index, event in enumerate(expected) if isinstance(event, Probe)]
    last_two = 2  # what the session's end adds
    least = [0, *starts[1:], len(expected) - last_two][reported]  # when so many were reported
    assert least <= len(events) <= len(expected)
    return len(found.probes)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print(kill_many(given.count, given.seed))
