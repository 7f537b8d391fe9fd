"""Small recordings of real registrations, which fuzzing starts from."""

import dataclasses
import warnings

import numpy as np
import trimesh

from chsel.events import (
    ListRecorder,
    Logged,
    Probe,
    ProblemPosed,
    RigDescribed,
    SensorImage,
    SessionEnded,
    SessionStarted,
    Start,
)
from chsel.methods import build_method
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.policies import build_policy
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import settings_mapping
from chsel.session.loop import Loop
from chsel.session.recording import register_recorded, symmetry_for_errors
from replay.mcap.writer import McapRecorder

_SIDES = (0.1, 0.06, 0.04)
STEERED = {"probes": 3, "stop": {"spread": 0.0, "gain": 0.0}, "belief": {"poses": 8}}
STEERED["blocked"] = 1.0
_DESCENT = {
    "descent": {"restarts": 2, "iterations": 4, "stop_below": None},
    "online": {"hypotheses": 4},
    "cost": {"penetration_tolerance": -0.005},
}
_SIDEWAYS = np.eye(4)[None, [2, 0, 1, 3]].repeat(2, axis=0)  # poses whose z axis is horizontal
_SEARCH = {"emitter": {"iterations": 12}, "archive": {"bins": 6}}
METHODS = {"gradient_descent": _DESCENT, "chsel": _DESCENT | _SEARCH}


def coarse_grid(mesh):
    """The grid of a box at 20 mm, with few nodes across, which is a warning elsewhere."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return SdfGrid.from_mesh(mesh, 0.02, padding=0.03)


def registered_session(name, *, seed=3):
    """The events of two steps of a box, each registered by a method of METHODS."""
    return _session(name, None, seed=seed)


def steered_session(name="gradient_descent", *, policy="information", seed=3, **changes):
    """The events of up to three probes of a box that a policy steers; changes: of its settings."""
    return _session(name, policy, seed=seed, changes=changes)


def pushing_session(name="gradient_descent", *, seed=3, **of_start):
    """Events of three touches that push a box, of which the last two register by themselves."""
    start = {"start": Start(contacts=6), "moves": 0.02}
    return _session(name, None, seed=seed, probes=3, path=_SIDEWAYS, **(start | of_start))


def _session(name, policy_name, *, seed, changes=None, probes=2, path=None, **of_start):
    method = build_method(name, METHODS[name])
    random = np.random.default_rng(seed)
    start = dataclasses.replace(_start(random, name, method=method, seed=seed), **of_start)
    recorder = ListRecorder()
    policy = None
    if policy_name is not None:
        policy = build_policy(policy_name, STEERED | changes)
        group = {"name": policy_name, **settings_mapping(policy.settings)}
        start = dataclasses.replace(start, config={**start.config, "policy": group})
    loop = Loop.of_session(start, method.online, policy=policy, seed=seed)
    recorder.record(start)
    if policy is not None:
        hand = HandShape.of(trimesh.creation.box((0.05, 0.04, 0.03)))
        offered = loop.offer(_actions(), hand)
        recorder.record(offered)
        available = np.ones(len(offered.actions), dtype=bool)
    for step in range(probes if policy is None else 4):
        if policy is not None:
            decided = loop.decide(available)
            recorder.record(decided)
            loop.follow(decided)
            if decided.decision.stop:
                break
            available[decided.decision.chosen] = False
        probe = _probe(random, step)
        if path is not None:
            probe = dataclasses.replace(probe, gripper_path=path)
        recorder.record(probe)
        loop.perceive(probe)
        if not loop.enough:
            continue
        found = register_recorded(
            ProblemPosed(step, loop.problem()),
            method,
            recorder=recorder,
            world_from_object=start.world_from_object,
            symmetry=symmetry_for_errors(start),
            snapshot_interval=6,
        ).hypotheses
        loop.remember(found)
        recorder.record(Logged(step, "info", text=f"probe {step}: contact"))
        last = step
    recorder.record(SessionEnded(last, "finished"))
    return recorder.events


def robot_session(name):
    """The same events of a robot: a hand, and a depth and a deformation image before each probe."""
    random = np.random.default_rng(5)
    made = []
    for event in registered_session(name):
        if isinstance(event, Probe):
            for sensor, kind in (("camera", "depth"), ("pad", "deformation")):
                values = random.integers(0, 900, (6, 8), dtype=np.uint16)
                camera = np.array([9.0, 9.0, 3.5, 2.5])
                made.append(
                    SensorImage(
                        step=event.step,
                        sensor=sensor,
                        kind=kind,
                        values=values,
                        unit=0.001,
                        mask=values > 300,
                        intrinsics=camera,
                        world_from_camera=np.eye(4),
                    )
                )
        made.append(event)
        if isinstance(event, SessionStarted):
            hand = trimesh.creation.box((0.05, 0.04, 0.03))
            made.append(RigDescribed(-1, "cabinet", source="0a1b", hand=hand))
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


def _start(random, name, *, method, seed):
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
    return Probe(
        step,
        "contact",
        new_points=new,
        gripper_path=np.eye(4)[None].repeat(2, axis=0),
        contacts=surface,
        contact_normals=normals,
    )
