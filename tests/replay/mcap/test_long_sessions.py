"""What a session of many steps costs grows with its steps, not with their square.

Counted are points copied and bytes digested, which are the same on every machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from chsel.problem import points as points_module
from chsel.problem.online_registration import OnlineRegistration, OnlineSettings, Start
from chsel.problem.points import GrowingPoints, KnownPoints
from replay.content.recording_info import recording_info
from replay.events import Event, Logged, Probe, SessionEnded, SessionStarted
from replay.mcap.reader import Recording, read_recording
from replay.mcap.recovery import recover
from replay.mcap.writer import McapRecorder
from replay.recorder import ListRecorder
from runners.run.recording import RecordingConfig
from runners.run.session_run import SessionRun
from runners.sessions.points import PointClass

STEPS, EACH = 150, 7
ALL = STEPS * EACH


@pytest.fixture
def long_session(make_events: Callable[..., list[Event]]) -> list[Event]:
    start = make_events(steps=0, free=0)[0]
    random = np.random.default_rng(0)
    events: list[Event] = [start]
    for step in range(STEPS):
        new = KnownPoints(free=random.normal(size=(EACH - 1, 3)), known=random.normal(size=(1, 3)))
        events += [Probe(step, "contact", new), Logged(step, "info", f"probe {step}")]
    return [*events, SessionEnded(STEPS - 1, "finished")]


@pytest.fixture
def costs(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    """Points that were joined, and bytes of points that were digested, since it was cleared."""
    counted = SimpleNamespace(points=0, bytes=0)
    joined, digest = KnownPoints.joined, points_module.digest

    def counting_joined(parts: Any) -> KnownPoints:
        counted.points += sum(part.count for part in parts)
        return joined(parts)

    def counting_digest(*arrays: np.ndarray) -> str:
        counted.bytes += sum(array.nbytes for array in arrays)
        return digest(*arrays)

    monkeypatch.setattr(KnownPoints, "joined", counting_joined)
    monkeypatch.setattr(points_module, "digest", counting_digest)
    yield counted
    # The check of the check: what was done before this was counted.
    counted.points = counted.bytes = 0
    two = KnownPoints(free=np.zeros((2, 3))).merged(KnownPoints(free=np.ones((3, 3))))
    assert (two.count, counted.points, len(two.digest)) == (5, 5, 32)
    assert counted.bytes == 5 * 24


def recorded(path: Path, events: list[Event]) -> Path:
    recorder = McapRecorder(path)
    for event in events:
        recorder.record(event)
        if isinstance(event, Logged):
            recorder.flush()
    recorder.close()
    return path


def all_events(path: Path) -> Recording:
    recording = read_recording(path)
    assert sum(1 for _ in recording.events()) == 2 * STEPS + 2
    return recording


def test_writing_reading_and_recovering_touch_every_point_a_few_times(
    long_session: list[Event], tmp_path: Path, costs: SimpleNamespace
) -> None:
    path = recorded(tmp_path / "a.mcap", long_session)
    data = path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 9 // 10])
    jobs: dict[str, Callable[[], Any]] = {
        "write": lambda: recorded(tmp_path / "b.mcap", long_session),
        "read": lambda: all_events(path),
        "recover": lambda: recover(path, tmp_path / "c.mcap"),
        "recover a cut one": lambda: recover(tmp_path / "cut.mcap", tmp_path / "d.mcap"),
        "check": lambda: recording_info(path),
    }
    for name, job in jobs.items():
        costs.points = costs.bytes = 0
        job()
        assert costs.points <= 2 * ALL, name
        assert costs.bytes <= 4 * ALL * 32, name  # read twice and written once at the most


def test_a_run_touches_every_point_once(long_session: list[Event], costs: SimpleNamespace) -> None:
    start = long_session[0]
    assert isinstance(start, SessionStarted)
    session: Any = SimpleNamespace(
        initial_points=start.initial_points,
        workspace=start.workspace,
        free_resolution=start.free_resolution,
        probes=lambda: iter(event for event in long_session if isinstance(event, Probe)),
    )
    never: Any = None
    online = OnlineRegistration(
        start.sdf,
        start.workspace,
        start.free_resolution,
        OnlineSettings(),
        points=start.initial_points,
        start=Start(step=STEPS),
    )
    run = SessionRun(
        session,
        online,
        never,
        ListRecorder(),
        recording=RecordingConfig(),
        symmetry=None,
        show=lambda *_: None,
    )
    rows = [row for _, row in run.steps()]
    assert (rows[-1]["contacts"], rows[-1]["free_points"]) == (STEPS, ALL - STEPS)
    assert costs.points <= ALL


def test_growing_points_are_those_merged_one_after_the_other() -> None:
    random = np.random.default_rng(1)

    def some(count: int) -> KnownPoints:
        sdf = np.array([0.0, 0.01] * count)[:count]
        return KnownPoints(
            random.normal(size=(count, 3)),
            random.normal(size=(2, 3)),
            random.normal(size=(count, 3)),
            sdf,
        )

    merged = some(3)
    growing = GrowingPoints(merged)
    for count in (0, 4, 1, 5):
        new = some(count)
        merged = merged.merged(new)
        growing.add(new)
        numbers = [growing.free, growing.occupied, growing.known, growing.contacts, growing.count]
        lengths = [len(p) for p in (merged.free, merged.occupied, merged.known, merged.contacts)]
        assert numbers == [*lengths, merged.count]
        if count != 4:
            assert growing.all().digest == merged.digest
            assert growing.all() is growing.all()


def test_points_of_a_step_keep_the_order_of_their_file() -> None:
    random = np.random.default_rng(2)
    steps = random.integers(0, 5, 40)
    every = PointClass(random.normal(size=(40, 3)), random.normal(size=40), steps)
    for step in (-1, 0, 3, 4, 9):
        part, now = every.at(step), steps == step
        assert part.points.tobytes() == every.points[now].tobytes()
        assert part.sdf.tobytes() == every.sdf[now].tobytes()
        assert (part.steps == step).all()
