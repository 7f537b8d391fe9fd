"""Small recordings of real registrations, which fuzzing starts from."""

import dataclasses
import warnings

import numpy as np
import trimesh

from chsel.events import (
    ActionsOffered,
    Decided,
    ListRecorder,
    Logged,
    Probe,
    ProblemPosed,
    RigDescribed,
    SensorImage,
    SessionEnded,
    SessionStarted,
)
from chsel.methods import build_method
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.policies import build_policy
from chsel.policies.steering import Steering
from chsel.problem.online_registration import OnlineRegistration
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import settings_mapping
from chsel.registration import register_recorded, symmetry_for_errors
from replay.mcap.writer import McapRecorder

_SIDES = (0.1, 0.06, 0.04)
STEERED = {"probes": 3, "stop": {"spread": 0.0, "gain": 0.0}, "belief": {"poses": 8}}
STEERED["blocked"] = 1.0
_DESCENT = {
    "descent": {"restarts": 2, "iterations": 4, "stop_below": None},
    "online": {"hypotheses": 4},
    "cost": {"penetration_tolerance": -0.005},
}
_SEARCH = {"emitter": {"iterations": 12}, "archive": {"bins": 6}}
METHODS = {"gradient_descent": _DESCENT, "chsel": _DESCENT | _SEARCH}


def coarse_grid(mesh):
    """The grid of a box at 20 mm, with few nodes across, which is a warning elsewhere."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return SdfGrid.from_mesh(mesh, 0.02, padding=0.03)


def registered_session(name, *, seed=3):
    """The events of two steps of a box, each registered by a method of METHODS."""
    return _session(name, None, seed)


def steered_session(name="gradient_descent", *, policy="information", seed=3, **changes):
    """The events of up to three probes of a box that a policy steers; changes: of its settings."""
    return _session(name, policy, seed, changes)


def _session(name, policy, seed, changes=None):
    method, random = build_method(name, METHODS[name]), np.random.default_rng(seed)
    start, recorder = _start(random, name, method, seed), ListRecorder()
    given = (start.sdf, start.workspace, start.free_resolution)
    online = OnlineRegistration(*given, method.online, seed=seed, points=start.initial_points)
    found, steering = None, None
    if policy is not None:
        steers = build_policy(policy, STEERED | changes)
        group = {"name": policy, **settings_mapping(steers.settings)}
        start = dataclasses.replace(start, config={**start.config, "policy": group})
        hand = HandShape.of(trimesh.creation.box((0.05, 0.04, 0.03)))
        offered = ActionsOffered(-1, _actions(), hand)
        steering = Steering(steers, *given, offered.actions, hand, seed=seed)
        available = np.ones(len(offered.actions), dtype=bool)
    recorder.record(start)
    if steering is not None:
        recorder.record(offered)
    for step in range(2 if steering is None else 4):
        if steering is not None:
            choice = steering.decide(step, online.points, found, available)
            recorder.record(Decided(step - 1, *choice, steering.surprise))
            if choice.decision.stop:
                break
            available[choice.decision.chosen] = False
        probe = _probe(random, step)
        recorder.record(probe)
        online.points = online.points.merged(probe.new_points)
        if steering is not None and steering.felt(probe.contacts):
            online.start_afresh(steers.settings.surprise.larger)
        posed, symmetry = ProblemPosed(step, online.pose(step)), symmetry_for_errors(start)
        found = register_recorded(
            posed, method, recorder, start.world_from_object, symmetry, snapshot_interval=6
        ).hypotheses
        online.remember(found)
        recorder.record(Logged(step, "info", f"probe {step}: contact"))
        last = step
    recorder.record(SessionEnded(last, "finished"))
    return recorder.events


def robot_session(name):
    """The same events of a robot: a hand, and a depth and a deformation image before each probe."""
    random, made = np.random.default_rng(5), []
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


def write_recording(path, events):
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


def _start(random, name, method, seed):
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
        sdf=coarse_grid(mesh),
        workspace=Workspace((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2)),
        free_resolution=0.02,
        initial_points=KnownPoints(free=random.uniform(-0.2, 0.2, (6, 3))),
        world_from_object=np.eye(4),
        environment={"numpy": "2", "platform": "any"},
    )


def _actions():
    """Probes from two places each on four sides."""
    starts = np.tile(np.eye(4), (8, 1, 1))
    for index in range(8):
        turn = np.roll(np.eye(3), index // 2, axis=1)
        if index >= 6:
            turn = np.diag([1.0, -1.0, -1.0])
        starts[index, :3, :3] = turn
        starts[index, :3, 3] = -0.3 * turn[:, 2] + 0.02 * (index % 2)
    return Actions(starts, np.full(8, 0.4))


def _probe(random, step):
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
