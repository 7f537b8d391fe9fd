from __future__ import annotations

import numpy as np
import pytest
import trimesh

from chsel.errors import RecordingError
from chsel.methods import build_method
from chsel.numerics.arrays import digest
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from replay.events import Event, Recorder, SnapshotTaken, Traced
from replay.recorder import ListRecorder
from replay.registration import StepObserver
from runners.run.recording import make_run_folder


@pytest.mark.parametrize("name", ["ycb/drill", "../../x", "a\0b", "x" * 5000, "a b\n"])
def test_run_folders_differ_and_stay_in_the_log_folder(tmp_path, name):
    folders = {make_run_folder(tmp_path, name, "chsel") for _ in range(3)}
    assert len(folders) == 3
    assert {folder.parent for folder in folders} == {tmp_path}
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match=r"cannot be made .*; accepted: a writable logs=DIR"):
        make_run_folder(tmp_path / "file", "drill")


class Keeping(Recorder):
    """Keeps events, and the digests of their arrays at the moment they came."""

    def __init__(self):
        self.events: list[Event] = []
        self.digests: list[str] = []

    def record(self, event):
        if isinstance(event, SnapshotTaken):
            self.events.append(event)
            self.digests.append(digest(*arrays(event.archive)))


def arrays(archive):
    return [value for value in vars(archive).values() if isinstance(value, np.ndarray)]


def test_what_is_handed_over_is_never_changed():
    """A recorder may write a snapshot while the search goes on."""
    box = trimesh.creation.box((0.1, 0.06, 0.2))
    surface = np.asarray(trimesh.sample.sample_surface(box, 10, seed=0)[0])
    problem = RegistrationProblem(
        SdfGrid.from_mesh(box, 0.02),
        KnownPoints(known=surface),
        np.eye(4)[None].repeat(4, axis=0),
        Workspace((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3)),
        0.02,
        StreamKey(0, 0),
    )
    settings = {"descent": {"restarts": 1, "iterations": 5}, "emitter": {"iterations": 20}}
    recorder = Keeping()
    observer = StepObserver(recorder, 0, 5, lambda *_: None)
    build_method("chsel", settings).register(problem, observer)
    assert len(recorder.events) >= 5
    assert len(set(recorder.digests)) > 1
    kept = [digest(*arrays(event.archive)) for event in recorder.events]
    assert kept == recorder.digests


@pytest.mark.parametrize("count", [4, 5])
def test_a_trace_is_of_the_moment_at_which_it_was_handed_over(count):
    recorder = ListRecorder()
    random = np.random.default_rng(count)
    vectors, cost = random.normal(size=(count, 9)), random.uniform(size=count)
    expected = digest(vectors, cost), cost.min(), np.median(cost), cost.max()
    StepObserver(recorder, 0, 5, lambda *_: None).trace("descent", 10, vectors, cost)
    vectors[:], cost[:] = 0.0, 0.0
    assert recorder.events == [Traced(0, "descent", 10, *expected)]
