"""Probes in any direction, in both engines."""

from itertools import islice

import numpy as np
import pytest

from chsel.errors import SessionError
from chsel.next_probe.action_lattice import ActionSettings
from chsel.next_probe.decision_problem import WeightedPoses
from chsel.next_probe.first_contact import first_contacts
from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import SdfGrid, mesh_sdf
from runners.objects.loader import load_model
from runners.sessions.gripper import X_REST
from runners.sessions.physics_engine import ENGINES
from runners.sessions.probing import open_probing
from runners.sessions.probing_settings import ProbingSettings


@pytest.fixture(params=["kinematic", *ENGINES])
def session(request):
    kind, engine = "kinematic", None
    if request.param in ENGINES:
        pytest.importorskip(request.param, reason=f"{request.param} is not installed")
        kind, engine = "simulated", request.param
    settings = ProbingSettings(engine=engine)
    opened = open_probing(kind, _mustard(), configuration_name="mustard", settings=settings, seed=0)
    yield opened
    opened.close()


def _mustard():
    return load_model("mustard").apply_scale(2.5)


def test_a_probe_goes_straight_along_the_hand_and_meets_what_is_forecast(session):
    mesh = _mustard()
    actions = session.offer(ActionSettings())
    chosen = np.linspace(0, len(actions) - 1, 9).astype(int).tolist()
    taken = [(action, next(session.take(step, action))) for step, action in enumerate(chosen)]
    object_from_world = inverse(session.world_from_object)
    belief = WeightedPoses(object_from_world[None], np.ones(1))
    sdf = SdfGrid.from_mesh(mesh, 0.005, padding=0.02)
    first = first_contacts(sdf, belief, actions=actions, hand=session.hand)
    agreed = 0
    late = []
    off = []
    for step, (action, probe) in enumerate(taken):
        start = actions.world_from_hand[action]
        path = probe.gripper_path
        assert probe.step == step
        assert (path[:, :3, :3] == start[:3, :3]).all()
        way = path[:, :3, 3] - start[:3, 3]
        along = way @ start[:3, 2]
        assert np.abs(way - along[:, None] * start[:3, 2]).max() < 0.005
        assert np.abs(way[-1]).max() < 1e-3
        lowest = (session.hand.vertices @ start[2, :3]).min() + path[:, 2, 3].min()
        assert lowest > 0.003
        hit = probe.outcome == "contact"
        forecast = bool(np.isfinite(first.travel[0, action]))
        agreed += hit == forecast
        if hit and forecast:
            late.append(abs(along.max() - first.travel[0, action]))
            away = probe.contacts[:, None] - first.contact[0, action]
            off.append(np.sqrt((away**2).sum(axis=2)).min())
        on_object = mesh_sdf(mesh, apply(object_from_world, probe.contacts))[0]
        assert np.abs(on_object).max(initial=0.0) < 0.001
        if not hit:
            assert along.max() == pytest.approx(actions.length[action], abs=0.005)
        free = mesh_sdf(mesh, apply(object_from_world, probe.new_points.free))[0]
        assert free.min() > -(0.5 * np.sqrt(3.0) * 0.025 - 0.010)
    assert agreed >= 8  # of 9; the object is points some millimetres apart in a forecast
    assert len(off) >= 3
    assert np.median(late) < 0.006
    assert np.median(off) < 0.015


def test_an_action_is_taken_once(session):
    actions = session.offer(ActionSettings(choice="forward", spacing=0.2))
    assert session.available().all()
    next(iter(session.take(0, 2)))
    assert np.flatnonzero(~session.available()).tolist() == [2]
    with pytest.raises(SessionError, match="action 2 was taken before"):
        next(iter(session.take(1, 2)))
    with pytest.raises(SessionError, match=f"accepted: 0 to {len(actions) - 1}"):
        next(iter(session.take(1, len(actions))))


@pytest.mark.parametrize("choice", ["around", "forward"])
def test_of_an_object_of_real_size_more_actions_are_offered(choice):
    mesh = load_model("mustard")  # of 0.225 m
    session = open_probing(
        "kinematic", mesh, configuration_name="mustard", settings=ProbingSettings(), seed=0
    )
    assert 200 < len(session.offer(ActionSettings(choice=choice))) <= 440
    assert len(session.offer(ActionSettings(choice=choice, spacing=0.05))) <= 200


def test_the_grid_as_actions_has_the_outcomes_of_the_grid():
    paper = open_probing(
        "kinematic", _mustard(), configuration_name="mustard", settings=ProbingSettings(), seed=0
    )
    grid = list(islice(paper.probes(), 3))
    session = open_probing(
        "kinematic", _mustard(), configuration_name="mustard", settings=ProbingSettings(), seed=0
    )
    actions = session.offer(ActionSettings(choice="configuration"))
    assert len(actions) == session.count
    np.testing.assert_allclose(actions.length, 0.3)
    for step, before in enumerate(grid):
        probe = next(iter(session.take(step, step)))
        assert probe.outcome == before.outcome
        assert probe.gripper_path[0, 0, 3] == X_REST
        if len(before.contacts):
            away = probe.contacts[:, None] - before.contacts
            assert np.sqrt((away**2).sum(axis=2)).min() < 0.005


def test_a_hand_that_would_start_in_the_object_comes_from_behind(session):
    centre = apply(session.world_from_object, _mustard().center_mass[None])[0]
    actions = session.offer(ActionSettings())
    poses = np.array(actions.world_from_hand[:1])
    poses[0, :3, 3] = centre
    object.__setattr__(actions, "world_from_hand", poses)
    probe = next(iter(session.take(0, 0)))
    assert probe.outcome == "contact"
    back = (centre - probe.gripper_path[0, :3, 3]) @ poses[0, :3, 2]
    assert back == pytest.approx(round(back / 0.05) * 0.05)
    assert back > 0.1
