"""What is decided: every policy in scenes of stored numbers, and the parts of their forecasts."""

from dataclasses import replace

import numpy as np

from chsel.next_probe.decision_problem import Actions, DecisionProblem, HandShape, WeightedPoses
from chsel.next_probe.forecast import BeliefSettings, Forecast, belief_before, surprise
from chsel.policies import OURS, build_policy
from chsel.problem.poses import axis_angle, compose, inverse, product, random_rotations
from chsel.problem.streams import Purpose, StreamKey, normals, uniforms
from tests.determinism.stages import keep, scene

SCENES = ("bracket", "mallet")
KEY = StreamKey(11, 3)
_POSES = 30
_STARTS = 25  # by each of two directions
_FACES = ((0, 1, 2), (0, 2, 3), (0, 4, 1), (1, 4, 2), (2, 4, 3), (3, 4, 0))  # of a pyramid
_HAND = ((-0.03, -0.01, 0.0), (0.03, -0.01, 0.0), (0.03, 0.01, 0.0), (-0.03, 0.01, 0.0))


def decision_stages(place, sdf):
    """By case: the forecast of a scene, then the decision of every policy about it."""
    problem = posed(place, sdf)
    stages, belief = {}, problem.belief
    parts = {"poses": belief.object_from_world.copy(), "weights": belief.weights.copy()}
    keep(stages, "belief before", arrays=parts)
    problem = replace(problem, belief=_scattered(problem.workspace))
    forecast = Forecast(problem, 0.005)
    keep(stages, "hand", arrays={"heights": problem.hand.front.heights.copy()})
    keep(stages, "first contacts", arrays=forecast.first._asdict())
    keep(stages, "chances", arrays={"hit": forecast.hit_chance, "blocked": forecast.blocked_chance})
    spread = {"between": forecast.distances, "spread": np.array([forecast.spread])}
    keep(stages, "distances", arrays=spread)
    keep(stages, "gains", arrays=forecast.gains._asdict())
    cases = {f"forecast, {place}": stages}
    for name in OURS:
        policy = build_policy(name, {"stop": {"spread": 0.0, "gain": 0.0}})
        decision = policy.decide(problem)
        names = ("score", "expected_spread", "contacts")
        arrays = {name: getattr(decision, name) for name in names}
        first = decision.contacts[0]
        outcomes = (None, np.nan_to_num(first), np.nan_to_num(first + 0.02))
        nats = [surprise(problem, decision, noise=0.005, contact=outcome) for outcome in outcomes]
        arrays |= {"chosen": np.array([float(decision.chosen)]), "surprise": np.array(nats)}
        cases[f"{name}, {place}"] = {"decision": arrays}
    return cases


def posed(place, sdf):
    """A scene before any registration: actions along an axis and obliquely, a pyramid as hand."""
    points, workspace, resolution = scene(place, ("contacts", "free"))
    belief = belief_before(
        sdf, points, workspace=workspace, key=KEY, settings=BeliefSettings(poses=_POSES)
    )
    lower, upper = workspace.bounds
    stream = KEY.stream(Purpose.PLAUSIBLE_ROTATIONS)
    starts = uniforms(stream, lower, upper=upper, shape=(2 * _STARTS, 3))
    turned = axis_angle(np.array([0.36, 0.48, 0.8]), np.array(0.7))
    turns = np.repeat([np.eye(3), turned], _STARTS, axis=0)
    starts = starts - 0.5 * (upper - lower).max() * turns[:, :, 2]
    lengths = uniforms(stream, 0.2, upper=0.8, shape=len(starts))
    actions = Actions(
        compose(turns, starts), lengths, seconds=uniforms(stream, 1.0, upper=3.0, shape=len(starts))
    )
    return DecisionProblem(
        sdf=sdf,
        points=points,
        workspace=workspace,
        free_resolution=resolution,
        belief=belief,
        actions=actions,
        available=np.arange(len(starts)) % 5 != 1,
        hand=HandShape((*_HAND, (0.0, 0.0, 0.03)), _FACES),
        key=KEY,
    )


def _scattered(workspace):
    """Poses around one in the middle of the workspace, of unequal weights."""
    stream = KEY.stream(Purpose.WALKS)
    middle = 0.5 * (workspace.bounds[0] + workspace.bounds[1])
    few = axis_angle(np.array([0.0, 0.6, 0.8]), uniforms(stream, -0.4, upper=0.4, shape=_POSES))
    turns = product(few, random_rotations(stream, 1))
    poses = inverse(compose(turns, middle + 0.02 * normals(stream, (_POSES, 3))))
    weights = np.arange(_POSES) % 4 / 1.0
    return WeightedPoses(poses, weights / float(int(weights.sum())))
