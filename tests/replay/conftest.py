"""A small session whose events have everything that a recording can hold."""

import dataclasses
from contextlib import closing
from typing import Any

import numpy as np
import pytest
import trimesh

from chsel.events import (
    ActionsOffered,
    Decided,
    Event,
    HypothesesFound,
    Logged,
    Measured,
    Probe,
    ProblemPosed,
    RigDescribed,
    SensorImage,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
    Timed,
    Traced,
)
from chsel.next_probe.decision_problem import (
    Actions,
    Decision,
    DecisionProblem,
    HandShape,
    WeightedPoses,
)
from chsel.numerics.arrays import digest
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import compose, random_rotations
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.problem.streams import StreamKey
from replay.mcap.writer import McapRecorder
from tests.tools.small_recordings import coarse_grid, steered_session

WORKSPACE = Workspace((-0.3, -0.3, 0.0), (0.3, 0.3, 0.5))
FREE_RESOLUTION = 0.02


def example_events(*, steps=3, elites=12, free=40, snapshots=2):
    """Events of a session with a box; step 0 has a probe in free space and no registration."""
    random = np.random.default_rng(7)
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    start = SessionStarted(
        runner="probe",
        object="Bohrmaschine ½″ 电钻",
        session="kinematic",
        method="chsel",
        seed=2**64 - 1,
        config={"object": {"name": "电钻", "scale": 1.5}, "flags": [True, None, -1, 1e-300]},
        mesh=mesh,
        sdf=coarse_grid(mesh),
        workspace=WORKSPACE,
        free_resolution=FREE_RESOLUTION,
        initial_points=KnownPoints(free=random.normal(size=(free, 3))),
        world_from_object=_poses(random, 1)[0],
        environment={"torch": "2.13.0", "numpy": "2.4.6", "platform": "Linux"},
    )
    events: list[Event] = [start, Logged(-1, "info", text="ready — los geht's")]
    points = start.initial_points
    low_cost_set = np.zeros((0, 4, 4))
    for step in range(steps):
        probe = _probe(random, step, free=free)
        points = points.merged(probe.new_points)
        events.append(probe)
        if step > 0:
            problem = RegistrationProblem(
                sdf=start.sdf,
                points=points,
                initial_set=_poses(random, 5),
                workspace=WORKSPACE,
                free_resolution=FREE_RESOLUTION,
                key=StreamKey(start.seed, step),
                low_cost_set=low_cost_set,
            )
            found = _registration(random, problem, elites=elites, snapshots=snapshots)
            low_cost_set = found[-1].hypotheses.elites
            events += [*found, Timed(step, {"registration": random.uniform()})]
            events.append(Measured(step, {"best_cost": -0.0, "coverage_mm2": float("nan")}))
    return [*events, Logged(steps - 1, "warning", text=""), SessionEnded(steps - 1, "finished")]


def bare_events():
    """Events of a session in which all that can be absent or empty is."""
    start = dataclasses.replace(
        example_events(steps=0)[0],
        config={},
        initial_points=KnownPoints(),
        world_from_object=None,
        environment={},
        object="",
    )
    point = KnownPoints(occupied=[[0.0, -0.0, 5e-324]])
    problem = RegistrationProblem(
        sdf=start.sdf,
        points=point,
        initial_set=np.eye(4)[None],
        workspace=WORKSPACE,
        free_resolution=FREE_RESOLUTION,
        key=StreamKey(0, 0),
    )
    poses = np.zeros((0, 4, 4))
    flags = np.zeros(0, dtype=bool)
    cells = np.zeros(0, dtype=np.int64)
    nothing = Hypotheses(poses, np.zeros(0), duplicate=flags, cell=cells, elites=poses)
    empty_archive = _archive(np.random.default_rng(0), 0, elites=0)
    return [
        start,
        Probe(0, "free", new_points=KnownPoints()),
        Probe(1, "points", new_points=point),
        ProblemPosed(1, problem),
        SnapshotTaken(1, empty_archive),
        HypothesesFound(1, nothing),
        Measured(1, {}),
    ]


def with_sensors(events):
    """The same session of a robot with a camera and a pad: a rig, and images before each probe."""
    random = np.random.default_rng(11)
    hand = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
    made: list[Event] = []
    for event in events:
        if isinstance(event, Probe):
            for sensor, kind in (("camera", "depth"), ("pad_1", "deformation")) * 2:
                values = random.integers(0, 2**16, (5, 7), dtype=np.uint16)
                pose = _poses(random, 1)[0]
                intrinsics = np.array([500.0, 501.0, 3.5, -0.5])
                mask = random.uniform(size=values.shape) < 0.5
                made.append(
                    SensorImage(
                        step=event.step,
                        sensor=sensor,
                        kind=kind,
                        values=values,
                        unit=0.001,
                        mask=mask,
                        intrinsics=intrinsics,
                        world_from_camera=pose,
                    )
                )
        made.append(event)
        if isinstance(event, SessionStarted):
            made.append(RigDescribed(-1, "cabinet", source="sha256:0a1b", hand=hand))
    return made


def with_decisions(events):
    """The same session steered: actions are offered, and a decision follows each step's results."""
    random = np.random.default_rng(13)
    actions = 4
    poses = 3
    starting = sum(isinstance(event, SessionStarted | RigDescribed) for event in events)
    start = events[0]
    start = dataclasses.replace(start, config={**start.config, "policy": {"name": "dice"}})
    hand = HandShape.of(trimesh.creation.icosphere(subdivisions=1, radius=0.05))
    length = random.uniform(0.1, 0.5, actions)
    offered = Actions(_poses(random, actions), length, seconds=length + 1.0)
    points, probed = start.initial_points, -1
    made: list[Event] = [start, *events[1:starting], ActionsOffered(-1, offered, hand=hand)]

    def decided(*, stop=""):
        belief = WeightedPoses(_poses(random, poses), np.full(poses, 1.0 / poses))
        available = np.arange(actions) != probed
        chosen = -1 if stop else (probed + 1) % actions
        contacts = random.normal(size=(poses, 3))
        contacts[0] = np.nan
        chances = random.uniform(size=(3, actions))
        decision = Decision(
            chosen=chosen,
            stop=stop,
            spread=random.uniform(),
            score=np.where(available, random.normal(size=actions), -np.inf),
            hit_chance=chances[0],
            blocked_chance=chances[1],
            expected_spread=chances[2],
            contacts=np.zeros((0, 3)) if stop else contacts,
        )
        key = StreamKey(start.seed, probed + 1)
        problem = DecisionProblem(
            sdf=start.sdf,
            points=points,
            workspace=start.workspace,
            free_resolution=start.free_resolution,
            belief=belief,
            actions=offered,
            available=available,
            hand=hand,
            key=key,
        )
        return Decided(probed, problem, decision=decision, surprise=random.uniform(0.0, 9.0))

    for event in events[starting:]:
        if event.step > probed or isinstance(event, SessionEnded):
            made.append(decided(stop="spread" if isinstance(event, SessionEnded) else ""))
            probed = event.step
        if isinstance(event, Probe):
            points = points.merged(event.new_points)
        made.append(event)
    return made


def nth(events, kind, *, number=0):
    """One of the events of a kind."""
    return [event for event in events if isinstance(event, kind)][number]


def changed(events, old, **values):
    """The events with other values of one of them."""
    return [dataclasses.replace(event, **values) if event is old else event for event in events]


def same_bits(a, b):
    """Whether two values are equal down to the types and bytes of their arrays."""
    if hasattr(a, "faces") and hasattr(b, "faces"):  # a mesh, or the shape of a hand
        pairs = [(of.vertices.view(np.ndarray), of.faces.view(np.ndarray)) for of in (a, b)]
        return same_bits(*pairs)
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if type(a) is not type(b):
        return False
    if isinstance(a, float):
        return np.float64(a).tobytes() == np.float64(b).tobytes()
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(same_bits, a, b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same_bits(a[name], b[name]) for name in a)
    if dataclasses.is_dataclass(a):
        names = [field.name for field in dataclasses.fields(a)]
        return all(same_bits(getattr(a, name), getattr(b, name)) for name in names)
    return bool(a == b)


def _poses(random, count):
    return compose(random_rotations(random, count), random.normal(size=(count, 3)))


def _probe(random, step, *, free):
    contacts = random.normal(size=(step, 3))
    known = np.concatenate([contacts, random.normal(size=(step, 3))])
    new = KnownPoints(
        free=random.normal(size=(free, 3)),
        occupied=random.normal(size=(2, 3)),
        known=known,
        known_sdf=np.repeat([0.0, 0.01], step),
    )
    outcome = "contact" if step else "free"
    return Probe(
        step,
        outcome,
        new_points=new,
        gripper_path=_poses(random, 4),
        contacts=contacts,
        contact_normals=-contacts,
    )


def _registration(random, problem, *, elites, snapshots):
    step = problem.key.step
    events: list[Any] = [
        ProblemPosed(step, problem),
        Traced(
            step,
            "descent",
            iteration=100,
            digest=digest(problem.initial_set),
            lowest_cost=0.1,
            median_cost=np.pi,
            highest_cost=1e9,
        ),
    ]
    archives = [_archive(random, 10 * i, elites=elites) for i in range(snapshots)]
    events += [SnapshotTaken(step, archive) for archive in archives]
    found = Hypotheses(
        object_from_world=_poses(random, 5),
        cost=np.sort(random.uniform(size=5)),
        duplicate=np.array([False, False, True, False, True]),
        cell=np.array([3, -1, 5, 1599, 0]),
        elites=_poses(random, elites),
        archive=dataclasses.replace(archives[-1]),
    )
    return [*events, HypothesesFound(step, found)]


def _archive(random, iteration, *, elites):
    return ArchiveSnapshot(
        iteration=iteration,
        refinement=1,
        measure_names=("x (m)", "y (m)"),
        shape=(40, 40),
        lower=np.array([-0.3, -0.3]),
        upper=np.array([0.3, 0.3]),
        cells=np.sort(random.choice(1600, elites, replace=False)),
        solutions=random.normal(size=(elites, 9)),
        objectives=-random.uniform(size=elites),
        measures=random.uniform(-0.3, 0.3, size=(elites, 2)),
    )


@pytest.fixture
def events():
    return example_events()


@pytest.fixture
def sensor_events():
    return with_sensors(example_events())


@pytest.fixture
def steered_events():
    return with_decisions(example_events())


@pytest.fixture(params=["all", "bare", "start alone"])
def any_events(request):
    if request.param == "all":
        return with_decisions(with_sensors(example_events(steps=2)))
    return bare_events() if request.param == "bare" else example_events()[:1]


@pytest.fixture
def assert_same():
    """Asserts that two lists of events are equal to the bit."""

    def check(read, written):
        read, written = list(read), list(written)
        assert [type(e).__name__ for e in read] == [type(e).__name__ for e in written]
        for index, (a, b) in enumerate(zip(read, written, strict=True)):
            assert same_bits(a, b), f"event {index} of type {type(a).__name__} differs"

    return check


@pytest.fixture
def write(tmp_path):
    """Records events to a new file."""

    def record(events):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap"
        with closing(McapRecorder(path)) as recorder:
            for event in events:
                recorder.record(event)
        return path

    return record


@pytest.fixture(scope="module")
def steered():
    """The events of three probes; a surprise starts the last registration afresh."""
    return steered_session()
