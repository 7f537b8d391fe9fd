"""The lattice of actions around a workspace: places, directions, reach and spacing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.errors import SettingError
from chsel.next_probe.action_lattice import (
    CLEARANCE,
    ActionSettings,
    ReachBall,
    around_actions,
    forward_actions,
)
from chsel.next_probe.decision_problem import HandShape
from chsel.problem.points import Workspace
from runners.objects.loader import MODELS, OBJECTS, load_model

# A box of 4 x 10 x 12 cm, its origin 2 cm from its back.
LOWER = np.array([-0.02, -0.05, -0.02])
UPPER = np.array([0.02, 0.05, 0.10])
CORNERS = np.array([[(LOWER, UPPER)[i][k] for k, i in enumerate(at)] for at in np.ndindex(2, 2, 2)])
FACES = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
HAND = HandShape(CORNERS, FACES)
WORKSPACE = Workspace((-0.1, -0.3, -0.075), (0.5, 0.3, 0.625))
FORWARD = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])

sides = st.floats(0.05, 3.0)
workspaces = st.builds(
    lambda x, y, z, a, b, c: Workspace((x, y, -0.05), (x + a, y + b, z + c)),
    st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.0, 0.3), sides, sides, sides,
)  # fmt: skip


def corners(actions, share):
    """The hand's corners (A, 8, 3) in the world, a share of the way."""
    poses = actions.world_from_hand
    placed = np.einsum("aij,nj->ani", poses[:, :3, :3], CORNERS) + poses[:, None, :3, 3]
    return placed + share * actions.length[:, None, None] * poses[:, None, :3, 2]


@settings(deadline=None, max_examples=40)
@given(workspaces, st.floats(0.02, 0.5), st.integers(6, 300))
def test_actions_around_start_outside_cross_the_workspace_and_stay_above_the_floor(
    workspace, spacing, most
):
    try:
        actions = around_actions(ActionSettings(spacing=spacing, most=most), workspace, hand=HAND)
    except SettingError:  # too low for the hand
        assert workspace.upper[2] < 0.12
        return
    lower, upper = workspace.bounds
    assert 0 < len(actions) <= most
    starts = corners(actions, 0.0)
    apart = (starts.max(axis=1) < lower) | (starts.min(axis=1) > upper)
    assert apart.any(axis=1).all()
    for share in (0.0, 0.5, 1.0):
        assert corners(actions, share)[..., 2].min() >= CLEARANCE - 1e-6
    directions = actions.world_from_hand[:, :3, 2]
    tips = actions.world_from_hand[:, :3, 3] + (actions.length[:, None] + UPPER[2]) * directions
    far_side = np.where(directions > 0.0, upper, lower)
    horizontal = directions[:, 2] == 0.0
    beyond = ((tips - far_side) * directions).sum(axis=1)[horizontal]
    np.testing.assert_allclose(beyond, 0.0, atol=1e-9)
    np.testing.assert_allclose(tips[~horizontal, 2], CLEARANCE, atol=1e-9)


def test_each_direction_covers_the_workspace_with_no_gap_wider_than_a_spacing():
    actions = around_actions(ActionSettings(spacing=0.1), WORKSPACE, hand=HAND)
    directions = actions.world_from_hand[:, :3, 2]
    views = np.unique(directions.round(6), axis=0)
    assert len(views) == 5
    for view in views:
        places = actions.world_from_hand[(directions == view).all(axis=1), :3, 3]
        for axis in np.flatnonzero(view == 0.0):
            nodes = np.unique(places[:, axis].round(9))
            low, high = WORKSPACE.lower[axis], WORKSPACE.upper[axis]
            if axis == 2:  # the lowest row is just above the floor
                low = nodes[0] + 0.02 - CLEARANCE
                assert nodes[0] == pytest.approx(0.02 + CLEARANCE)
            np.testing.assert_allclose(np.diff(nodes), 0.1)
            assert nodes[0] - low < 0.1
            assert high - nodes[-1] < 0.1


def test_lattices_of_opposite_sides_are_half_a_spacing_apart():
    actions = around_actions(ActionSettings(spacing=0.1), WORKSPACE, hand=HAND)
    starts, directions = actions.world_from_hand[:, :3, 3], actions.world_from_hand[:, :3, 2]
    for along, across in ((0, 1), (1, 0)):
        first, second = (starts[directions[:, along] == sign, across][0] for sign in (-1.0, 1.0))
        assert (first - second) / 0.1 % 1.0 == pytest.approx(0.5, abs=1e-9)


def test_a_forward_lattice_keeps_its_start_and_length():
    settings = ActionSettings(speed=0.1, setup=2.0)
    actions = forward_actions(
        settings, WORKSPACE, hand=HAND, rotation=FORWARD, start=-0.05, length=0.3
    )
    assert len(actions) == 12 * 12
    np.testing.assert_array_equal(actions.world_from_hand[:, 0, 3], -0.05)
    np.testing.assert_array_equal(actions.length, 0.3)
    np.testing.assert_allclose(actions.seconds, 2.0 + 2.0 * 0.3 / 0.1)
    assert corners(actions, 0.0)[..., 2].min() == pytest.approx(CLEARANCE)


@pytest.mark.parametrize("radius", [0.3, 0.6, 0.9])
def test_the_hand_stays_within_its_reach(radius):
    reach = ReachBall((-0.2, 0.1, 0.2), radius)
    every = around_actions(ActionSettings(), WORKSPACE, hand=HAND)
    actions = around_actions(ActionSettings(reach=reach), WORKSPACE, hand=HAND)
    assert 0 < len(actions) < len(every)
    start, z = actions.world_from_hand[:, :3, 3], actions.world_from_hand[:, :3, 2]
    for share in (0.0, 1.0):
        away = start + share * actions.length[:, None] * z - reach.center
        assert np.sqrt((away**2).sum(axis=1)).max() <= radius + 1e-9


def test_a_reach_or_workspace_without_any_action_is_an_error():
    nowhere = ActionSettings(reach=ReachBall((9.0, 0.0, 0.0), 1.0))
    with pytest.raises(SettingError, match="leaves no action; accepted: a workspace above"):
        around_actions(nowhere, WORKSPACE, hand=HAND)
    cellar = Workspace((-1.0, -1.0, -2.0), (1.0, 1.0, -1.0))
    with pytest.raises(SettingError, match="leaves no action"):
        around_actions(ActionSettings(), cellar, hand=HAND)


def test_a_tiny_spacing_costs_no_more_than_what_is_offered():
    actions = around_actions(ActionSettings(spacing=1e-9, most=2_000), WORKSPACE, hand=HAND)
    assert 1_800 < len(actions) <= 2_000


def test_of_a_small_object_actions_are_denser_up_to_1000():
    table = Workspace((0.0, 0.0, 0.0), (0.3, 0.3, 0.3))
    actions = around_actions(ActionSettings(), table, hand=HAND, diameter=0.2)
    above = actions.world_from_hand[actions.world_from_hand[:, 2, 2] == -1.0, :2, 3]
    for axis in above.T:
        np.testing.assert_allclose(np.diff(np.unique(axis.round(9))), 0.15 * 0.2)
    assert 200 < len(actions) <= 200 * (0.05 / 0.03) ** 2
    assert 900 < len(around_actions(ActionSettings(), table, hand=HAND, diameter=0.02)) <= 1000


@pytest.mark.parametrize("name", MODELS)
def test_of_the_enlarged_objects_actions_are_50_mm_apart_and_at_most_200(name):
    diameter = float(np.linalg.norm(load_model(name, OBJECTS[name].scale).extents))
    usual = around_actions(ActionSettings(), WORKSPACE, hand=HAND, diameter=diameter)
    stated = ActionSettings(spacing=0.05, most=200)
    for other in (None, 0.1):
        expected = around_actions(stated, WORKSPACE, hand=HAND, diameter=other)
        assert usual.digest == expected.digest
    assert around_actions(ActionSettings(), WORKSPACE, hand=HAND).digest == usual.digest
