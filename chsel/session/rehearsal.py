"""Registrations of next to nothing, so that all kernels are there before the first real one."""

from __future__ import annotations

import dataclasses
import warnings
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from chsel.events import Probe
from chsel.methods.anchored.anchored import Anchored
from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.methods.method import Method
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.numerics.compiler import cache_directory
from chsel.plausible.pose_metrics import result_numbers
from chsel.policies.policy import Policy, StopSettings
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.trust import trust_in
from chsel.sensing.depth_camera import PinholeCamera, occlusion_edges
from chsel.sensing.free_space import FreeGrid
from chsel.session.loop import Loop

_RADIUS = 0.025
_MOST = 30  # iterations, hypotheses and so on: one compiles as much as a thousand do
_WORKSPACE = Workspace((-0.06, -0.06, -0.06), (0.06, 0.06, 0.06))


def warm_up(method: Method) -> None:
    """Compile every kernel that a session with `method` needs, or load it if it was compiled.

    Registers a small ball twice, first from contacts and free points, then from points of every
    class and with the first result as the previous one. Takes up to a minute if nothing is
    compiled, else a tenth of a second. It changes no bit of any registration, as these depend on
    their problems alone. Raises SettingError if the folder of compiled kernels cannot be used.
    """
    cache_directory()
    surface = _RADIUS * np.concatenate([np.eye(3), -np.eye(3)])
    free = 0.02 * np.argwhere(np.ones((6, 6, 6))) - 0.05
    touched = KnownPoints(free[(free**2).sum(axis=1) > 0.035**2], known=surface[:3])
    known = np.concatenate([surface[3:], 1.2 * surface])
    known_sdf = np.concatenate([np.zeros(3), np.full(6, 0.2 * _RADIUS)])
    others = KnownPoints(occupied=np.zeros((1, 3)), known=known, known_sdf=known_sdf)
    # Settings may fit no such ball, or another package's method fail on it: its kernels are
    # compiled when they are needed.
    with suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about a ball that nobody has asked for
        method = type(method)(_brief(method.settings))  # type: ignore[call-arg]
        loop = Loop(_ball(), _WORKSPACE, free_resolution=0.02, settings=method.online)
        probes = [
            Probe(step=step, outcome="points", new_points=points)
            for step, points in enumerate((touched, others))
        ]
        for problem in loop.problems(probes):
            hypotheses = method.register(problem)
            hypotheses = replace(hypotheses, trust=trust_in(problem, hypotheses))
            result_numbers(hypotheses, problem, world_from_object=np.eye(4), symmetry=None)
            Anchored(_brief(AnchoredSettings())).minima(problem)  # see trust_by
            loop.remember(hypotheses)


def warm_up_sensing() -> None:
    """Compile the kernels of depth images and swept solids, or load them. See `warm_up`."""
    grid = FreeGrid(_WORKSPACE, 0.02)
    camera = PinholeCamera(4, 3, fx=5.0, fy=5.0, cx=2.0, cy=1.5)
    depth = np.full((3, 4), 0.05)
    mask = np.ones((3, 4), dtype=bool)
    occlusion_edges(depth, mask, jump=0.1)
    grid.from_depth(depth, camera, world_from_camera=np.eye(4), mask=mask)
    grid.along_rays(np.zeros(3), np.ones((1, 3)))
    grid.at(np.zeros((1, 3)))


def warm_up_policy(policy: Policy) -> None:
    """Compile the kernels that decisions by `policy` need, or load them. See `warm_up`."""
    corners = np.array([[0.0, 0.0, 0.01], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [-0.01, -0.01, 0.0]])
    hand = HandShape(corners, [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    world_from_hand = np.eye(4)[None].repeat(2, axis=0)
    world_from_hand[:, :3, 3] = [[0.0, 0.0, -0.05], [0.01, 0.0, -0.05]]
    with suppress(Exception):  # as above
        settings = replace(_brief(policy.settings), stop=StopSettings(0.0, 0.0))
        policy = type(policy)(settings)  # type: ignore[call-arg]
        actions = Actions(world_from_hand, np.full(2, 0.1))
        loop = Loop(
            _ball(),
            _WORKSPACE,
            free_resolution=0.02,
            settings=OnlineSettings(),
            policy=policy,
            points=KnownPoints(free=np.full((1, 3), 0.05)),
        )
        loop.offer(actions, hand)
        loop.follow(loop.decide(np.ones(2, dtype=bool)))
        touch = np.zeros((1, 3))
        loop.perceive(Probe(step=0, outcome="contact", new_points=KnownPoints(), contacts=touch))


def _ball() -> SdfGrid:
    nodes = np.indices((9, 9, 9)) * 0.01 - 0.04
    radius = np.sqrt((nodes**2).sum(axis=0))
    gradients = np.moveaxis(nodes / np.maximum(radius, 1e-9), 0, -1)
    return SdfGrid(np.full(3, -0.04), 0.01, values=radius - _RADIUS, gradients=gradients)


def _brief(settings: Any) -> Any:
    """Return the settings with every count at most _MOST."""
    values = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    changes: dict[str, Any] = {
        name: _brief(value) if dataclasses.is_dataclass(value) else min(value, _MOST)
        for name, value in values.items()
        if dataclasses.is_dataclass(value) or type(value) is int
    }
    return replace(settings, **changes)
