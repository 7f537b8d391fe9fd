"""The numbers of one row of the table, of hypotheses made up around the true pose of a session."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from chsel.numerics.arrays import FloatArray
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_set import PlausibleSet
from chsel.problem.poses import compose, inverse, product, rotation_vector
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.streams import StreamKey
from runners.evaluation.contenders import MOST_REPEATS, repeat_seed
from runners.evaluation.metrics import HypothesisMetrics, MetricsConfig
from runners.evaluation.plan import Task
from runners.evaluation.run_method import ResultRows
from runners.evaluation.trial_session import open_recorded, problems
from runners.sessions.recorded import RecordedSource
from tests.runners.in_process import do_task
from tests.runners.test_evaluation import TRIAL, plan_in

EPSILON = 0.0003  # metres, that of the mustard bottle


@dataclass(frozen=True)
class Scene:
    """The rows of a trial, with the problem of one step and its plausible set."""

    rows: ResultRows
    session: RecordedSource
    truth: FloatArray  # world_from_object (4, 4)
    problem: RegistrationProblem
    members: PlausibleSet
    cost: EvaluationCost


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    plan = plan_in(tmp_path_factory.mktemp("session"))
    assert do_task(plan, Task(TRIAL)) == ""
    session = open_recorded(plan, TRIAL)
    truth = session.world_from_object
    rows = ResultRows(plan, TRIAL, session=session, label="made_up")
    problem = list(problems(plan, TRIAL, session=session))[-1]
    members, _ = rows.members(problem)
    cost = EvaluationCost(problem, plan.plausible_settings(EPSILON).cost)
    return Scene(rows, session, truth=truth, problem=problem, members=members, cost=cost)


def hypotheses(world_from_object):
    """These poses (B, 4, 4), the best first."""
    count = len(world_from_object)
    poses = inverse(world_from_object)
    cell = np.full(count, -1)
    return Hypotheses(
        poses,
        np.arange(float(count)),
        duplicate=np.zeros(count, dtype=bool),
        cell=cell,
        elites=poses,
    )


def moved(truth, shifts, *, turns):
    """The true pose moved by shifts (B, 3) and turned by rotation vectors (B, 3)."""
    rotation = product(rotation_vector(turns), truth[:3, :3])
    return compose(rotation, truth[:3, 3] + shifts)


def test_errors_are_those_of_the_best_hypothesis(scene):
    shifts = np.array([[0.012, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.0, 0.1]])
    turns = np.array([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0], [0.3, 0.0, 0.0]])
    shifted = hypotheses(moved(scene.truth, shifts, turns=turns))
    row = scene.rows.row(scene.problem, shifted)
    assert row["position_error"] == pytest.approx(0.012)
    assert row["rotation_error"] == pytest.approx(0.0, abs=1e-6)
    turned = hypotheses(moved(scene.truth, shifts[::-1], turns=turns[::-1]))
    row = scene.rows.row(scene.problem, turned)
    assert row["rotation_error"] == pytest.approx(0.3)
    assert (row["best_cost"], row["mean_cost"]) == (0.0, 1.0)
    assert (row["hypotheses"], row["distinct"]) == (3, 3)


def test_exact_members_are_those_within_one_epsilon_of_the_true_cost(scene):
    stream = np.random.default_rng(0)
    shifts, turns = stream.normal(0.0, 0.003, (4000, 3)), stream.normal(0.0, 0.02, (4000, 3))
    poses = moved(scene.truth, shifts, turns=turns)
    above = scene.cost.evaluate(inverse(poses)) - scene.members.true_cost
    inside = poses[above < 0.95 * EPSILON][:3]
    near = poses[(above > 1.05 * EPSILON) & (above < 2.5 * EPSILON)][:5]
    far = poses[above > 5.0 * EPSILON][:4]
    assert (len(inside), len(near), len(far)) == (3, 5, 4)
    found = hypotheses(np.concatenate([inside, near, far]))
    row = scene.rows.row(scene.problem, found)
    assert row["exact_members"] == pytest.approx(3.0 / 12.0)


def test_all_steps_of_a_session_are_measured_by_the_same_points_on_the_surface(scene):
    stream = np.random.default_rng(1)
    found = hypotheses(moved(scene.truth, stream.normal(0.0, 0.02, (5, 3)), turns=np.zeros((5, 3))))
    mesh = scene.session.recorded.mesh

    def measured(metrics, seed, *, step):
        return metrics.compute(
            replace(scene.problem, key=StreamKey(seed, step)), scene.members, found=found
        )

    def fresh():
        return HypothesisMetrics(MetricsConfig(points=50), mesh, world_from_object=scene.truth)

    one = fresh()
    first = measured(one, 0, step=4)
    assert measured(one, 0, step=5) == first
    assert measured(fresh(), 0, step=5) == first  # of a run that went on at this step
    assert measured(fresh(), 1, step=4)["diversity"] != first["diversity"]


def test_seeds_of_draws_are_no_seeds_of_other_sessions():
    seeds = range(50)
    assert [repeat_seed(seed, 0) for seed in seeds] == list(seeds)
    drawn = {repeat_seed(seed, draw) for seed in seeds for draw in range(20)}
    assert len(drawn) == 50 * 20
    others = {repeat_seed(seed, draw) for seed in seeds for draw in (1, 2, MOST_REPEATS - 1)}
    assert min(others) > 2**31  # nobody counts sessions up to there
