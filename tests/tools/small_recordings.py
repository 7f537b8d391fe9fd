"""Small recordings of real registrations, which fuzzing starts from."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from chsel.methods import build_method, trust_by
from chsel.methods.method import Method
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.plausible.pose_metrics import result_numbers
from chsel.policies import build_policy
from chsel.policies.steering import Steering
from chsel.problem.online_registration import OnlineRegistration, pose_problem
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import settings_mapping
from chsel.problem.streams import StreamKey
from replay.events import (
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
)
from replay.mcap.writer import McapRecorder
from replay.recorder import ListRecorder
from replay.registration import register_recorded, symmetry_for_errors

_SIDES = (0.1, 0.06, 0.04)
_DESCENT = {"restarts": 2, "iterations": 4, "stop_below": None}
_ONLINE = {"hypotheses": 4}
_COST = {"penetration_tolerance": -0.005}
STEERED = {
    "probes": 3,
    "stop": {"spread": 0.0, "gain": 0.0},
    "belief": {"poses": 8},
    "blocked": 1.0,
}
METHODS: dict[str, dict[str, Any]] = {
    "gradient_descent": {"descent": _DESCENT, "online": _ONLINE, "cost": _COST},
    "chsel": {
        "descent": _DESCENT,
        "online": _ONLINE,
        "cost": _COST,
        "emitter": {"iterations": 12},
        "archive": {"bins": 6},
    },
}


def registered_session(name: str, *, seed: int = 3) -> list[Event]:
    """The events of two steps of a box, each registered by a method of METHODS."""
    method = build_method(name, METHODS[name])
    random = np.random.default_rng(seed)
    start = _start(random, name, method, seed)
    recorder = ListRecorder()
    recorder.record(start)
    points = start.initial_points
    previous: Hypotheses | None = None
    for step in range(2):
        probe = _probe(random, step)
        recorder.record(probe)
        points = points.merged(probe.new_points)
        problem = pose_problem(
            start.sdf,
            points,
            start.workspace,
            start.free_resolution,
            StreamKey(seed, step),
            method.online,
            previous,
        )
        posed = ProblemPosed(step, problem)
        truth, symmetry = start.world_from_object, symmetry_for_errors(start)
        registered = register_recorded(
            posed, method, recorder, truth, symmetry, snapshot_interval=6
        )
        previous = registered.hypotheses
        recorder.record(Logged(step, "info", f"probe {step}: contact"))
    recorder.record(SessionEnded(1, "finished"))
    return recorder.events


def steered_session(
    name: str = "gradient_descent", *, policy: str = "information", seed: int = 3, **changes: Any
) -> list[Event]:
    """The events of up to three probes of a box that a policy steers; changes: of its settings."""
    method, random = build_method(name, METHODS[name]), np.random.default_rng(seed)
    steers = build_policy(policy, STEERED | changes)
    start = _start(random, name, method, seed)
    group = {"name": policy, **settings_mapping(steers.settings)}
    start = dataclasses.replace(start, config={**start.config, "policy": group})
    offered = ActionsOffered(-1, _actions(), HandShape.of(trimesh.creation.box((0.05, 0.04, 0.03))))
    given = (start.sdf, start.workspace, start.free_resolution)
    steering = Steering(steers, *given, offered.actions, offered.hand, seed=seed)
    online = OnlineRegistration(*given, method.online, seed=seed, points=start.initial_points)
    recorder = ListRecorder()
    recorder.record(start)
    recorder.record(offered)
    available, found = np.ones(len(offered.actions), dtype=bool), None
    for step in range(4):
        choice = steering.decide(step, online.points.all(), found, available)
        recorder.record(Decided(step - 1, *choice, steering.surprise))
        if choice.decision.stop:
            break
        available[choice.decision.chosen] = False
        probe = _probe(random, step)
        recorder.record(probe)
        online.points.add(probe.new_points)
        if steering.felt(probe.contacts):
            online.start_afresh(steers.settings.surprise.larger)
        truth, symmetry = start.world_from_object, symmetry_for_errors(start)
        posed = ProblemPosed(step, online.pose(step))
        found = register_recorded(
            posed, method, recorder, truth, symmetry, snapshot_interval=6
        ).hypotheses
        online.remember(found)
        recorder.record(Logged(step, "info", f"probe {step}: contact"))
    recorder.record(SessionEnded(step - 1, "finished"))
    return recorder.events


def robot_session(name: str) -> list[Event]:
    """The same events of a robot: a hand, and a depth and a deformation image before each probe."""
    random = np.random.default_rng(5)
    made: list[Event] = []
    for event in registered_session(name):
        if isinstance(event, Probe):
            for sensor, kind in (("camera", "depth"), ("pad", "deformation")):
                values = random.integers(0, 900, (6, 8), dtype=np.uint16)
                camera = np.array([9.0, 9.0, 3.5, 2.5])
                seen = (values, 0.001, values > 300, camera, np.eye(4))
                made.append(SensorImage(event.step, sensor, kind, *seen))
        made.append(event)
        if isinstance(event, SessionStarted):
            hand = trimesh.creation.box((0.05, 0.04, 0.03))
            made.append(RigDescribed(-1, "cabinet", "0a1b", hand))
    return made


def write_recording(path: Path, events: Iterable[Event]) -> bytes:
    """The bytes of a new recording of events, at a path."""
    recorder = McapRecorder(path)
    try:
        for event in events:
            recorder.record(event)
            if isinstance(event, Logged):
                recorder.flush()
    finally:
        recorder.close()
    return path.read_bytes()


def _start(random: np.random.Generator, name: str, method: Method, seed: int) -> SessionStarted:
    """The start of a session with a box."""
    mesh = trimesh.creation.box(_SIDES)
    return SessionStarted(
        runner="probe",
        object="box",
        session="points",
        method=name,
        seed=seed,
        config={"seed": seed, "method": {"name": name, **settings_mapping(method.settings)}},
        mesh=mesh,
        sdf=SdfGrid.from_mesh(mesh, 0.02, padding=0.03),
        workspace=Workspace((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2)),
        free_resolution=0.02,
        initial_points=KnownPoints(free=random.uniform(-0.2, 0.2, (6, 3))),
        world_from_object=np.eye(4),
        environment={"numpy": "2", "platform": "any"},
    )


def _actions() -> Actions:
    """Probes from two places each on four sides."""
    starts = np.tile(np.eye(4), (8, 1, 1))
    for index in range(8):
        turn = np.roll(np.eye(3), index // 2, axis=1)
        if index >= 6:
            turn = np.diag([1.0, -1.0, -1.0])
        starts[index, :3, :3] = turn
        starts[index, :3, 3] = -0.3 * turn[:, 2] + 0.02 * (index % 2)
    return Actions(starts, np.full(8, 0.4))


def _probe(random: np.random.Generator, step: int) -> Probe:
    surface = random.uniform(-0.5, 0.5, (5, 3)) * _SIDES
    surface[:, step] = 0.5 * _SIDES[step]
    normals = np.zeros((5, 3))
    normals[:, step] = 1.0
    new = KnownPoints(
        free=random.uniform(-0.2, 0.2, (4, 3)),
        occupied=np.zeros((1, 3)),
        known=np.concatenate([surface, surface + 0.01 * normals]),
        known_sdf=np.repeat([0.0, 0.01], 5),
    )
    return Probe(step, "contact", new, np.eye(4)[None].repeat(2, axis=0), surface, normals)


def measured_again(events: Iterable[Event], method: Method | None = None) -> list[Event]:
    """The events with the measured values that follow from their results by today's definition.

    method: that found them, for how far they are trusted; None: without.
    """
    found: list[Event] = []
    start: Any = None
    problem: Any = None
    hypotheses: Any = None
    for event in events:
        if isinstance(event, SessionStarted):
            start = event
        elif isinstance(event, ProblemPosed):
            problem = event.problem
        elif isinstance(event, HypothesesFound):
            hypotheses = event.hypotheses
        elif isinstance(event, Measured):
            truth, symmetry = start.world_from_object, symmetry_for_errors(start)
            trust = None if method is None else trust_by(method, problem, hypotheses)
            numbers = result_numbers(hypotheses, problem, truth, symmetry, trust)
            event = Measured(event.step, numbers)
        found.append(event)
    return found
