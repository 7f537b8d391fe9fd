"""The loop of Algorithm 2: when it registers, what follows from what, decisions and surprises."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from chsel import KnownPoints, Loop, Probe, SdfGrid, Workspace
from chsel.errors import ChselError, PoseError, SettingError
from chsel.events import Decided, Start
from chsel.policies import build_policy
from chsel.policies.policy import PolicySettings
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.streams import StreamKey
from chsel.session.loop import Phase
from tests.chsel.next_probe import decisions
from tests.chsel.next_probe.decisions import along_x, ball, box_hand
from tests.chsel.samples import hypotheses_at, pose_problem

GRID = SdfGrid.from_mesh(trimesh.creation.box((0.1, 0.06, 0.04)), 0.02)
WORKSPACE = Workspace((-0.1, -0.3, 0.0), (0.5, 0.3, 0.6))
SETTINGS = OnlineSettings(hypotheses=4)
NEW_POINTS = [KnownPoints(known=[[0.1 * step, 0.0, 0.1]]) for step in range(4)]
NOTHING = hypotheses_at(np.zeros((0, 4, 4)))


def touch(step, points, *, contacts=()):
    contacts = np.reshape(contacts, (-1, 3))
    outcome = "contact" if len(contacts) else "free"
    return Probe(step=step, outcome=outcome, new_points=points, contacts=contacts)


PROBES = [touch(step, points) for step, points in enumerate(NEW_POINTS)]


def loop_of(**options):
    return Loop(GRID, WORKSPACE, free_resolution=0.01, settings=SETTINGS, **options)


def starts_as_found(problem):
    """E_0 at ascending costs, the last pose first."""
    return hypotheses_at(problem.initial_set[::-1])


def walk(loop, probes=PROBES):
    """Register every problem by `starts_as_found`; return the problems by step."""
    posed = {}
    for problem in loop.problems(probes):
        posed[problem.key.step] = problem
        loop.remember(starts_as_found(problem))
    return posed


def test_every_problem_has_all_points_and_follows_from_the_result_before():
    points = KnownPoints(free=[[0.3, 0.3, 0.3]])
    previous = None
    for step, problem in walk(loop_of(seed=7, points=points)).items():
        points = points.merged(NEW_POINTS[step])
        key = StreamKey(7, step)
        expected = pose_problem(
            GRID,
            points,
            workspace=WORKSPACE,
            free_resolution=0.01,
            key=key,
            settings=SETTINGS,
            previous=previous,
        )
        assert problem.digest == expected.digest
        previous = starts_as_found(expected)
    assert points.count == 5


@pytest.mark.parametrize(
    ("start", "registered"),
    [
        (None, [0, 1, 2, 3]),
        (Start(contacts=2), [1, 2, 3]),
        (Start(step=3), [3]),
        (Start(steps=(0, 2)), [0, 2]),
        (Start(contacts=3, steps=(0, 2)), [2]),
    ],
)
def test_steps_before_the_start_and_those_not_chosen_register_nothing(start, registered):
    posed = walk(loop_of(start=start))
    assert list(posed) == registered
    last = registered[-1]
    assert posed[last].points.count == last + 1  # those of skipped steps, too


def test_nothing_is_registered_while_no_point_is_known():
    assert list(walk(loop_of(), [touch(0, KnownPoints()), PROBES[1]])) == [1]


def test_without_a_result_the_next_problem_follows_from_the_one_before():
    loop = loop_of()
    sizes = []
    for problem in loop.problems(PROBES[:3]):
        sizes.append(len(problem.low_cost_set))
        if problem.key.step == 0:
            loop.remember(starts_as_found(problem))
            kept = loop.state.previous.elites
    assert sizes == [0, len(kept), len(kept)]


def test_a_result_without_poses_cannot_be_followed():
    loop = loop_of(previous=NOTHING)
    loop.perceive(PROBES[0])
    with pytest.raises(PoseError, match="has no hypotheses; accepted: at least one"):
        loop.problem()


NOWHERE = np.zeros((0, 3))
STARTS = [(-0.06, 0.0), (0.06, 0.0), (0.0, 0.0)]
ALL = np.ones(3, dtype=bool)


class Somebody:
    """A policy of another package, which returns what it likes."""

    settings = PolicySettings()

    def __init__(self, **changes):
        self._changes = changes

    def decide(self, problem):
        stop = {"stop": {"spread": 0.0, "gain": 0.0}}
        return replace(build_policy("grid", stop).decide(problem), **self._changes)


def steered(policy):
    loop = Loop(ball(), decisions.WORKSPACE, free_resolution=0.01, settings=SETTINGS, policy=policy)
    loop.offer(along_x(STARTS), box_hand())
    return loop


def test_a_step_goes_from_open_to_ended():
    loop = steered(build_policy("grid"))
    phases = [loop.state.phase]
    loop.perceive(PROBES[0])
    phases.append(loop.state.phase)
    problem = loop.problem()
    phases.append(loop.state.phase)
    loop.remember(starts_as_found(problem))
    phases.append(loop.state.phase)
    loop.follow(loop.decide(ALL))
    phases.append(loop.state.phase)
    loop.end()
    phases.append(loop.state.phase)
    open_, posed, answered, decided, ended = Phase
    assert phases == [open_, open_, posed, answered, decided, ended]


def test_what_a_probe_touches_first_is_what_surprises():
    surprises = []
    for places in ([0.0], [0.0, 5.0], [5.0, 0.0]):
        loop = steered(Somebody())
        decided = loop.decide(ALL)
        loop.follow(decided)
        contacts = decided.decision.contacts
        near = contacts[np.isfinite(contacts[:, 0])][0]
        touched = [near + place for place in places]
        loop.perceive(touch(0, KnownPoints(), contacts=touched))
        surprises.append(loop.state.surprise)
    assert surprises[0] == surprises[1] < surprises[2]


def surprised_by(outcome, decided_step, *, forecast=True):
    """The surprise of a contact far off the forecast, as the outcome of a decision."""
    loop = steered(Somebody())
    decided = loop.decide(ALL)
    decision = decided.decision if forecast else replace(decided.decision, contacts=NOWHERE)
    loop.follow(Decided(decided_step, decided.problem, decision=decision, surprise=0.0))
    loop.perceive(replace(touch(0, KnownPoints(), contacts=[9.0, 9.0, 9.0]), outcome=outcome))
    return loop.state.surprise


def test_a_surprise_is_of_the_probe_that_was_chosen_last_and_is_made_by_the_hand():
    assert surprised_by("contact", -1) > 1.0
    assert surprised_by("points", -1) == 0.0  # as of a camera
    assert surprised_by("contact", -2) == 0.0  # a probe came between
    assert surprised_by("contact", -1, forecast=False) == 0.0
    loop = steered(Somebody())
    loop.perceive(touch(0, KnownPoints(), contacts=[9.0, 9.0, 9.0]))
    assert loop.state.surprise == 0.0  # nothing was chosen


@pytest.mark.parametrize(("limit", "size"), [(1.0, 8), (99.0, 4)])
def test_after_a_surprise_the_next_problem_is_a_larger_first_one(limit, size):
    policy = Somebody()
    surprise = replace(policy.settings.surprise, limit=limit, larger=2)
    policy.settings = replace(policy.settings, surprise=surprise)
    loop = steered(policy)
    loop.perceive(PROBES[0])
    loop.remember(starts_as_found(loop.problem()))
    loop.follow(loop.decide(ALL))
    loop.perceive(touch(1, NEW_POINTS[1], contacts=[9.0, 9.0, 9.0]))
    problem = loop.problem()
    assert len(problem.initial_set) == size
    assert (len(problem.low_cost_set) == 0) is (limit == 1.0)
    loop.remember(starts_as_found(problem))
    loop.perceive(PROBES[2])
    assert len(loop.problem().initial_set) == 4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"chosen": 3}, "action 3 with stop ''"),
        ({"chosen": 1}, "action 1 with stop ''"),  # it is not available
        ({"chosen": -1}, "action -1 with stop ''"),
        ({"stop": "gain"}, "action 0 with stop 'gain'"),
        ({"score": np.zeros(2)}, r"shapes \[\(2,\), .*; accepted"),
        ({"contacts": NOWHERE}, r"\(0, 3\)\]; accepted"),
    ],
)
def test_what_is_no_decision_is_refused(changes, message):
    available = np.array([True, False, True])
    with pytest.raises(ChselError, match=message):
        steered(Somebody(**changes)).decide(available)


def test_before_a_point_on_the_object_a_decision_weighs_poses_all_over_the_workspace():
    """A result by free space alone, of a single pose far away, is not what it weighs."""
    policy = build_policy("information")
    far = hypotheses_at(np.array([[[1, 0, 0, 9.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]]))
    loop = loop_of(policy=policy, points=KnownPoints(free=[[0.4, 0.0, 0.5]]))
    before = loop.belief(policy.settings.belief)
    loop.remember(far)
    assert loop.belief(policy.settings.belief).digest == before.digest
    assert len(before) > 20
    loop.perceive(touch(0, KnownPoints(known=[[0.1, 0.0, 0.1]]), contacts=[0.1, 0.0, 0.1]))
    np.testing.assert_array_equal(
        loop.belief(policy.settings.belief).object_from_world, far.object_from_world
    )


def test_a_floor_above_the_workspace_is_an_error():
    loop = steered(build_policy("grid", {"belief": {"floor": 7.0}}))
    with pytest.raises(
        SettingError, match=r"policy\.belief\.floor is 7, above .*; accepted: .* null"
    ):
        loop.decide(ALL)


def test_a_decision_needs_a_policy_and_actions():
    with pytest.raises(SettingError, match="policy is missing"):
        loop_of().decide(ALL)
    loop = Loop(GRID, WORKSPACE, free_resolution=0.01, settings=SETTINGS, policy=Somebody())
    with pytest.raises(SettingError, match="no action was offered"):
        loop.decide(ALL)
