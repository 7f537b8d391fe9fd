"""A recorded grid offers its probes as actions, in any order."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chsel.errors import SessionError
from chsel.next_probe.action_lattice import ActionSettings, ReachBall
from chsel.problem.points import Lattice
from runners.objects.loader import load_model
from runners.sessions.configurations import CONFIGURATIONS
from runners.sessions.probing import open_probing, swept_voxels
from runners.sessions.probing_hand import ROTATION
from runners.sessions.probing_settings import ProbingSettings
from runners.sessions.recorded import RecordedActions, RecordedSettings, RecordedSource

REPLAYS = Path(__file__).resolve().parents[2] / "replays"
GRIDS = [
    ("mustard_medial_constraint", "mustard"),
    ("spam_can_gradient_descent", "can"),
    ("mustard_medial_constraint_cma_me", "mustard"),
]


def opened(name):
    session = RecordedSource(RecordedSettings(path=str(REPLAYS / f"{name}.mcap")))
    return session, list(session.probes())


@pytest.mark.parametrize(("name", "configuration"), GRIDS)
def test_a_recorded_grid_is_offered_as_its_probes(name, configuration):
    session, probes = opened(name)
    reach = ReachBall((0.0, 0.0, 0.0), 1e-6)
    actions = session.offer(ActionSettings(choice="forward", reach=reach, speed=0.1))
    assert len(actions) == len(probes)
    places = [(-0.05, y, z) for y, z in CONFIGURATIONS[configuration].grid]
    np.testing.assert_allclose(actions.world_from_hand[:, :3, 3], places, atol=0.003)
    turned = np.broadcast_to(ROTATION, (len(probes), 3, 3))
    np.testing.assert_allclose(actions.world_from_hand[:, :3, :3], turned)
    np.testing.assert_allclose(actions.length, 0.3, atol=0.001)
    assert actions.seconds is not None
    np.testing.assert_allclose(session.hand.bounds[1, 2], 0.1123)


def test_in_the_recorded_order_all_points_are_as_recorded():
    session, probes = opened(GRIDS[0][0])
    session.offer(ActionSettings())
    for step, before in enumerate(probes):
        (probe,) = session.take(step, step)
        assert (probe.step, probe.new_points.digest) == (step, before.new_points.digest)


@pytest.mark.parametrize("name", [name for name, _ in GRIDS])
def test_in_any_order_the_same_is_known_in_the_end(name):
    session, probes = opened(name)
    session.offer(ActionSettings())
    order = np.random.default_rng(0).permutation(len(probes)).tolist()
    free, larger = [], 0
    for step, action in enumerate(order):
        (probe,) = session.take(step, action)
        np.testing.assert_array_equal(probe.contacts, probes[action].contacts)
        np.testing.assert_array_equal(probe.new_points.known, probes[action].new_points.known)
        free.append(probe.new_points.free)
        larger += len(probe.new_points.free) > len(probes[action].new_points.free)
    assert larger > 3
    assert not session.available().any()
    with pytest.raises(SessionError, match="action 0 was taken before"):
        list(session.take(0, 0))
    recorded = np.concatenate([probe.new_points.free for probe in probes])
    np.testing.assert_array_equal(in_order(np.concatenate(free)), in_order(recorded))


def in_order(points):
    return points[np.lexsort(points.T)]


def test_a_probe_that_is_taken_first_shows_nearly_all_that_it_swept():
    mesh = load_model("mustard").apply_scale(2.5)
    session = open_probing(
        "kinematic", mesh, configuration_name="mustard", settings=ProbingSettings(), seed=0
    )
    probes, swept = [], []
    for probe in session.probes():
        path = np.array(session._gripper.path)
        lattice = session._voxels.lattice
        probes.append(probe)
        swept.append(swept_voxels(lattice, session._interior, positions=path))
        if len(probes) == 4:
            break
    initial = session.initial_points.free
    every = RecordedActions(probes, session.hand, lattice=lattice, depth=0.010)
    shown = np.concatenate([initial, every.take(0, 3).new_points.free])
    new, true, initially = (
        set(map(tuple, np.rint(points / 0.0125).astype(int).tolist()))
        for points in (shown, swept[3], initial)
    )
    assert len(true - new) < 0.02 * len(true)
    assert len(new - initially - true) < 0.02 * len(true)


def test_what_cannot_be_steered_is_an_error(tmp_path):
    session, _ = opened("points_mustard")
    with pytest.raises(SessionError, match=r"points_mustard.mcap does not describe the hand"):
        session.offer(ActionSettings())
    session, probes = opened("mustard_anchored")
    lattice = Lattice(session.workspace.lower, session.free_resolution)
    short = [replace(probe, gripper_path=probe.gripper_path[:1]) for probe in probes]
    with pytest.raises(SessionError, match="probe 0 has 1 poses of the hand; accepted"):
        RecordedActions(short, session.hand, lattice=lattice, depth=0.0)
    still = [replace(probe, gripper_path=probe.gripper_path[[-1, -1]]) for probe in probes]
    with pytest.raises(SessionError, match=r"no probe goes 0.01 m along the z axis of the hand"):
        RecordedActions(still, session.hand, lattice=lattice, depth=0.0)
