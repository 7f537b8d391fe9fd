"""Beliefs, surprises, what actions are worth, by formulas and closed forms; what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from chsel.errors import PoseError, SettingError
from chsel.next_probe.decision_problem import HandShape, WeightedPoses
from chsel.next_probe.forecast import (
    BeliefSettings,
    Forecast,
    belief_after,
    belief_before,
    surprise,
)
from chsel.policies import POLICIES, build_policy
from chsel.problem.noise import FACET
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses, axis_angle, compose
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from tests.chsel.next_probe.decisions import RADIUS, WORKSPACE, along_x, at, ball, ball_problem

NOISE = 0.005
# Of three contacts, the two with a normal have a median noise of 0.2 radians.
TOUCHED = KnownPoints(
    known=np.ones((3, 3)),
    normals=[[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]],
    normal_noise=[0.1, 0.0, 0.3],
)
PLACES = [(0.0, 0.0), (0.06, 0.0), (-0.05, 0.03), (0.0, -0.1), (0.28, 0.28)]


def some_problem(seed, count, *, reach):
    """Poses around the middle of the workspace, some of weight 0."""
    stream = np.random.default_rng(seed)
    poses = at(*stream.uniform(-reach, reach, (count, 3)).tolist())
    weights = stream.integers(0, 4, count) + 1e-3 * (np.arange(count) == 0)
    return ball_problem(poses, along_x(PLACES), weights=weights / weights.sum())


def test_before_any_contact_the_object_stands_on_the_floor_outside_of_free_space():
    grid = np.stack(np.meshgrid(*[np.arange(-0.3, 0.31, 0.02)] * 3), axis=-1).reshape(-1, 3)
    left = KnownPoints(free=grid[grid[:, 0] < 0.1])
    settings = BeliefSettings(poses=40, floor=-0.1)
    belief = belief_before(
        ball(), left, workspace=WORKSPACE, key=StreamKey(3, 0), settings=settings
    )
    centres = Poses.of(belief.object_from_world).origins
    np.testing.assert_allclose(centres[:, 2], RADIUS - 0.1, atol=0.004)
    apart = np.sqrt(((centres[:, None] - left.free) ** 2).sum(axis=-1))
    assert apart.min() > RADIUS - ball().resolution - 1e-4  # of all free points
    anywhere = belief_before(
        ball(),
        left,
        workspace=WORKSPACE,
        key=StreamKey(3, 0),
        settings=replace(settings, floor=None),
    )
    assert np.ptp(Poses.of(anywhere.object_from_world).origins[:, 2]) > 0.3
    assert belief.weights.sum() == pytest.approx(1.0)


def test_after_a_registration_candidates_count_and_else_hypotheses():
    poses = at(*((0.01 * n, 0.0, 0.0) for n in range(30)))
    found = Hypotheses(
        poses[:3],
        np.zeros(3),
        duplicate=np.array([False, True, False]),
        cell=np.zeros(3, np.int64),
        elites=poses,
    )
    np.testing.assert_array_equal(
        belief_after(found, BeliefSettings()).object_from_world, poses[:3:2]
    )
    found = replace(found, candidates=poses)
    belief = belief_after(found, BeliefSettings(poses=10))
    np.testing.assert_array_equal(belief.object_from_world, poses[::3])
    np.testing.assert_allclose(belief.weights, 0.1)


def test_surprise_is_minus_the_logarithm_of_the_chance_of_what_happened():
    """Two of three balls are met, at places apart in all axes."""
    poses = at((0.0, 0.01, 0.0), (0.1, -0.01, 0.005), (0.0, 0.2, 0.2))
    weights = np.array([0.5, 0.3, 0.2])
    nowhere = np.full(3, 5.0)
    problem = ball_problem(poses, along_x([(0.0, 0.0)]), weights=weights)
    decision = build_policy("grid", {"stop": {"spread": 0.0, "gain": 0.0}}).decide(problem)
    places, share = decision.contacts[:2], weights[:2] / 0.8
    assert np.isnan(decision.contacts[2]).all()
    scatter = share @ ((places - share @ places) ** 2).sum(axis=1)
    for noise in (0.002, 0.03):
        for contact in (places[0], places[1] + (0.01, 0.02, -0.03), nowhere):
            squares = ((places - contact) ** 2).sum(axis=1)
            near = np.maximum(np.exp(-squares / (4.0 * noise**2 + scatter)), 0.001)
            expected = -np.log(0.95 * weights @ [*near, 0.001] + 0.05 * 0.01)
            assert surprise(problem, decision, noise=noise, contact=contact) == pytest.approx(
                expected
            )
        missed = -np.log(0.95 * weights @ [0.001, 0.001, 1.0] + 0.05 * 0.01)
        assert surprise(problem, decision, noise=noise, contact=None) == pytest.approx(missed)


def test_the_spread_is_the_root_mean_square_distance_of_surfaces():
    """Of two balls of radius r, d apart: the mean square of |r - |x + d|| over |x| = r."""
    apart, weight = 0.02, 0.25
    cosines = np.linspace(-1.0, 1.0, 20_001)
    between = np.sqrt(RADIUS**2 + apart**2 + 2.0 * RADIUS * apart * cosines) - RADIUS
    squares = 2.0 * weight * (1.0 - weight) * (between**2).mean()
    poses = at((0.0, 0.0, 0.0), (0.0, apart, 0.0))
    aside = along_x([(0.25, 0.25)])  # which misses both
    problem = ball_problem(poses, aside, weights=np.array([weight, 1.0 - weight]))
    decision = build_policy("expected_loss").decide(problem)
    assert decision.spread == pytest.approx(math.sqrt(squares), rel=0.05)
    assert decision.expected_spread == pytest.approx([decision.spread])


def normal_overlap(cosines, first, second):
    """The share of normals that two outcomes have in common, by angles and variances."""
    return 0.9 * np.exp(-0.5 * (1.0 - cosines) / (first + second)) + 0.1


@pytest.mark.parametrize("points", [KnownPoints(), TOUCHED])
@pytest.mark.parametrize(("seed", "count", "reach"), [(3, 10, 0.06), (0, 1, 0.0), (5, 25, 0.15)])
def test_gains_are_those_of_the_formulas(seed, count, reach, points):
    problem = replace(some_problem(seed, count, reach=reach), points=points)
    forecast = Forecast(problem, NOISE)
    weights = problem.belief.weights
    first = forecast.first
    distances = forecast.distances
    gains = forecast.gains
    hit = np.isfinite(first.travel)
    squared = ((first.contact[:, None] - first.contact[None]) ** 2).sum(axis=-1)  # (K, K, A)
    both = hit[:, None] & hit[None]
    neither = ~hit[:, None] & ~hit[None]
    near = np.exp(-squared / (8.0 * NOISE**2))
    if points.has_normals:
        centres = Poses.of(problem.belief.object_from_world).origins
        places = first.contact - centres[:, None]  # in the object's axes, as it is not turned
        gradients = problem.sdf.at(places.reshape(-1, 3), lookup="trilinear")[1]
        lengths = np.sqrt((gradients**2).sum(axis=1))
        units = (gradients / lengths[:, None]).reshape(places.shape)
        spread = (0.5 * 0.2**2 + FACET**2 + 1.0 - lengths).reshape(hit.shape)
        near *= normal_overlap(np.einsum("iac,jac->ija", units, units), spread[:, None], spread)
    alike = np.where(both, near, np.where(neither, 1.0, 0.01))
    with np.errstate(divide="ignore"):
        inner = np.log(np.einsum("j,ija->ia", weights, alike))
    expected = -np.einsum("i,ia->a", weights, np.where(weights[:, None] > 0.0, inner, 0.0))
    left = weights[:, None] * alike**2 / np.einsum("j,ija->ia", weights, alike**2)[:, None]
    loss, squares = (np.einsum("i,ija,ij->a", weights, left, distances**n) for n in (1, 2))
    surviving = np.einsum("i,ija,j->a", weights, alike**2, weights)
    assert forecast.hit_chance == pytest.approx(weights @ hit, abs=1e-12)
    assert (expected > 0.5).sum() >= 2 or count == 1
    assert (gains.information >= 0.0).all()
    assert gains.information == pytest.approx(expected, abs=1e-9)
    assert gains.surviving == pytest.approx(surviving, abs=1e-9)
    assert gains.expected_spread == pytest.approx(np.sqrt(squares), abs=1e-9)
    assert gains.loss == pytest.approx(loss, abs=1e-9)


@pytest.mark.parametrize("points", [KnownPoints(), TOUCHED])
def test_gains_of_an_action_have_the_same_bits_whatever_the_others_are(points):
    """As many are computed together; those that miss in every pose have the gains of one."""
    problem = replace(some_problem(5, 25, reach=0.1), points=points)
    stream = np.random.default_rng(0)
    places = stream.uniform(-0.18, 0.18, (75, 2)).tolist()
    every = replace(problem, actions=along_x(places), available=np.ones(75, dtype=bool))
    gains = Forecast(every, NOISE).gains
    met = Forecast(every, NOISE).hit.any(axis=0)
    assert 33 < met.sum() < 70
    for n, place in enumerate(places):
        alone = replace(problem, actions=along_x([place]), available=np.ones(1, dtype=bool))
        for values, value in zip(gains, Forecast(alone, NOISE).gains, strict=True):
            assert values[n] == value[0]


def test_a_start_behind_the_object_is_blocked():
    problem = ball_problem(at((-0.35, 0.0, 0.0), (0.1, 0.0, 0.0)), along_x([(0.0, 0.0)]))
    assert Forecast(problem, NOISE).blocked_chance == pytest.approx([0.5])
    assert build_policy("information").decide(problem).stop == "actions"


@pytest.mark.parametrize("name", POLICIES)
def test_one_pose_or_one_action_is_decided(name):
    problem = some_problem(1, 20, reach=0.1)
    sure = replace(problem, belief=WeightedPoses(at((0.0, 0.0, 0.0)), np.ones(1)))
    assert build_policy(name).decide(sure).stop == "spread"
    single = ball_problem(problem.belief.object_from_world, along_x([(0.0, 0.0)]))
    decision = build_policy(name).decide(single)
    assert (decision.chosen, decision.stop) == (0, "")


def weighted(poses, weight):
    return WeightedPoses(poses, np.array([weight]))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (
            lambda: WeightedPoses(at((1e300, 0.0, 0.0)), np.ones(1)),
            PoseError,
            "belief[0] is beyond 1e+06",
        ),
        (
            lambda: WeightedPoses(2.0 * at((0.0, 0.0, 0.0)), np.ones(1)),
            PoseError,
            "not a rigid transform",
        ),
        (
            lambda: WeightedPoses(at((0.0, 0.0, 0.0)), np.array([0.9])),
            SettingError,
            "a distribution",
        ),
        (lambda: along_x([(0.0, 0.0)], length=0.0), SettingError, "length of actions has 0.0"),
        (lambda: HandShape(np.eye(3) * 50.0, [[0, 1, 2]]), SettingError, "the hand reaches 50 m"),
    ],
)
def test_what_is_no_problem_is_refused(make, error, message):
    with pytest.raises(error) as caught:
        make()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_only_normals_tell_poses_apart_that_are_turned_about_the_contact():
    """A finger of 8 mm meets the middle of a box's face in both poses; one is turned by 0.6."""
    angle = 0.6
    sdf = SdfGrid.from_mesh(trimesh.creation.box((0.1, 0.1, 0.1)), 0.005)
    place = np.array([-0.05, 0.0, 0.0])  # of the contact on the object
    turns = axis_angle(np.tile([0.0, 0.0, 1.0], (2, 1)), np.array([0.0, angle]))
    finger = HandShape.of(trimesh.creation.box(bounds=[[-0.004] * 2 + [-0.1], [0.004] * 2 + [0.0]]))
    base = ball_problem(compose(turns, np.tile(place, (2, 1))), along_x([(0.0, 0.0)]))
    information = []
    for points in (KnownPoints(), TOUCHED):
        forecast = Forecast(replace(base, sdf=sdf, hand=finger, points=points), 0.02)
        assert forecast.hit.all()
        np.testing.assert_allclose(forecast.first.contact, 0.0, atol=0.006)
        information.append(float(build_policy("information").rate(forecast.problem, forecast)[0]))
    shared = normal_overlap(math.cos(angle), 0.0225, 0.0225)  # 0.2^2 / 2 + 0.05^2
    assert information[0] < 0.02
    assert information[1] == pytest.approx(-math.log(0.5 + 0.5 * shared), abs=0.05)
    assert information[1] > 0.3
