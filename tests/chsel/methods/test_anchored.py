"""The contact-anchored search: what it finds, and that odd problems have results.

The scene (scene.py): an L of 20 x 14 x 10 cm (GRID) is at TRUTH, world_from_object.
POINTS are 40 contacts all over it and the free voxels (SIDE) of the workspace around it, ODD odd
sets of points by name. `posed(method, points, ...)` is the problem that a method gets, with E_0
anywhere, or from a previous result; `around_truth` are poses near the true one. A Watcher keeps
what an observer sees. `plain_energies` is the formula of chsel/problem/noise.py in numpy.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from chsel.errors import ChselError
from chsel.methods import build_method
from chsel.methods.anchor_sampling import AnchorSampler, most_informative_first
from chsel.methods.anchored.anchored import Anchored
from chsel.methods.anchored.anchored_settings import AnchoredSettings, Effort
from chsel.methods.anchored.energy import Energy
from chsel.methods.anchored.search import Search
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.basins import basin_bests
from chsel.problem.noise import LATER, WRONG, noise_model
from chsel.problem.points import KnownPoints
from chsel.problem.pose_prior import PosePrior
from chsel.problem.poses import (
    Poses,
    apply,
    axis_angle,
    check_rigid,
    compose,
    inverse,
    rotation_angle,
)
from chsel.problem.pushes import Pushes
from chsel.problem.registration_problem import NullObserver, check_prior
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import PlaneSettings, search_space
from chsel.problem.subset import surface_descriptors
from chsel.problem.surface import outline_distances_to
from chsel.problem.trust import pose_energies, trust_in
from chsel.session.judging import trust_by
from tests.chsel.methods.scene import (
    BOX_GRID,
    GRID,
    MESH,
    ODD,
    POINTS,
    SIDE,
    TRUTH,
    Watcher,
    around_truth,
    known_points,
    posed,
)
from tests.chsel.samples import box_with_knob, hypotheses_at, plain_energies

EFFORT = Effort(
    samples=4000,
    kept=24,
    first_steps=5,
    refined=12,
    steps=8,
    descents=8,
    descent_moves=30,
    chains=12,
    moves=150,
    polished=4,
    polish_moves=40,
)
FEW = POINTS.with_known(slice(2))
INEXACT = replace(  # by 2 mm
    POINTS, known=POINTS.known + np.random.default_rng(1).normal(0.0, 0.002, POINTS.known.shape)
)
INEXACT_FEW = INEXACT.with_known(slice(3))


def anchored(effort=EFFORT, **changes):
    return Anchored(AnchoredSettings(effort=effort, **changes))


def registered(method, problem, *, observer=None):
    """The result, found to be whole: as many rigid poses as E_0 has, with their energies."""
    search = Search(problem, method.settings, observer=observer or NullObserver())
    found = search.choose(search.spread(search.minima()))
    assert found.digest == method.register(problem).digest
    assert len(found.object_from_world) == len(problem.initial_set)
    check_rigid("hypotheses", found.object_from_world)
    check_rigid("elites", found.elites)
    assert np.isfinite(found.cost).all()
    assert (np.diff(found.cost) >= 0.0).all()
    energies = search.energy.of(Poses.of(found.object_from_world))
    np.testing.assert_allclose(found.cost, energies, rtol=1e-9, atol=1e-9)
    assert found.archive is not None
    energies = search.energy.of(Poses.of(found.elites))
    np.testing.assert_allclose(-found.archive.objectives, energies, rtol=1e-9, atol=1e-9)
    assert found.cost[0] <= -found.archive.objectives.max() + 1e-9  # the best is among them
    return found


def assert_found(found):
    position, rotation = pose_errors(found.object_from_world[:1], TRUTH, symmetry=ObjectSymmetry())
    assert position[0] < 0.005
    assert rotation[0] < 0.05


@pytest.mark.parametrize("name", ODD)
def test_odd_points_have_results(name):
    method = anchored()
    registered(method, posed(method, ODD[name]))


@pytest.mark.parametrize("contacts", [64, 5])
def test_poses_are_rated_by_some_contacts_that_are_far_apart(contacts):
    method = anchored() if contacts == 64 else anchored(replace(EFFORT, contacts=contacts))
    points = most_informative_first(ODD["hundreds"])
    few = points.with_known(slice(contacts))
    poses = Poses.of(posed(method).initial_set[:4])
    found = Search(posed(method, points), method.settings, observer=NullObserver()).energy.of(poses)
    expected = Energy(posed(method, few), few, noise=noise_model(method.settings.noise)).of(poses)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_an_observer_is_shown_poses_of_three_stages_and_one_archive():
    watcher, method = Watcher(), anchored()
    found = method.register(posed(method), watcher)
    stages = [(trace.stage, trace.iteration) for trace in watcher.traces]
    assert stages == [("fit", 0), ("descend", 0), ("spread", 0)]
    search = Search(posed(method), method.settings, observer=NullObserver())
    for trace in watcher.traces:
        energies = search.energy.of(search_space(None, GRID).poses(trace.vectors))
        np.testing.assert_allclose(trace.cost, energies, rtol=1e-9, atol=1e-9)
    assert watcher.progressed == [
        ("sample", 4000, 4000),
        ("fit", 1, 1),
        ("search", 0, 0),
        ("descend", 1, 1),
        ("spread", 1, 1),
    ]
    assert found.archive is not None
    assert [archive.digest for archive in watcher.archives] == [found.archive.digest]
    assert (found.archive.iteration, found.archive.refinement) == (0, 0)


def test_few_contacts_leave_many_distinct_poses():
    method = anchored()
    found = registered(method, posed(method, FEW))
    assert found.distinct == 30
    spread = np.ptp(inverse(found.object_from_world)[:, :3, 3], axis=0)
    assert spread.max() > 0.03


@pytest.mark.parametrize(("states", "chains"), [(6, 12), (2, 30), (1, 60)])
def test_candidates_are_minima_and_states_of_walks_twice_as_many_as_hypotheses(states, chains):
    """Twelve walks by the settings, and more where they would give too few."""
    method = anchored(replace(EFFORT, states=states), limit=1e6)
    search = Search(posed(method, FEW), method.settings, observer=NullObserver())
    minima = search.minima()
    candidates = search.spread(minima)
    assert len(candidates.energies) == len(minima.energies) + states * chains


@pytest.mark.parametrize("points", [FEW, INEXACT], ids=["few", "inexact"])
def test_candidates_are_below_the_limit_and_costs_the_plain_formula(points):
    method = anchored(limit=4.0)
    problem = posed(method, points)
    search = Search(problem, method.settings, observer=NullObserver())
    minima = search.minima()
    candidates = search.spread(minima)
    assert candidates.energies[0] == candidates.energies.min()
    assert 2.0 < candidates.energies.max() - minima.energies.min() <= 4.0
    found = search.choose(candidates)
    assert found.cost[0] == pytest.approx(candidates.energies[0], abs=1e-9)
    poses = Poses.of(found.object_from_world[::3])
    expected = plain_energies(noise_model(method.settings.noise), GRID, points=points, poses=poses)
    np.testing.assert_allclose(found.cost[::3], expected, atol=0.01 * len(points.known))


def test_the_archive_leads_on_to_the_next_step():
    method = anchored()
    first = method.register(posed(method, FEW))
    assert first.archive is not None
    space = search_space(None, GRID)
    np.testing.assert_array_equal(first.elites, space.poses(first.archive.solutions).matrices)
    problem = posed(method, previous=first)
    np.testing.assert_array_equal(problem.low_cost_set, first.elites)
    np.testing.assert_array_equal(problem.initial_set, first.object_from_world)
    again = posed(method, FEW, previous=first)
    assert method.register(again).cost[0] <= first.cost[0] + 1e-12


def test_a_good_pose_of_the_last_step_is_not_lost():
    """It is in E_l alone, and nothing else is searched: a sample, without a fit."""
    few = Effort(
        samples=1,
        kept=1,
        first_steps=0,
        refined=1,
        steps=0,
        descents=1,
        descent_moves=1,
        chains=1,
        moves=1,
        polished=1,
        polish_moves=1,
        evaluations=0,
    )
    method = anchored(few)
    problem = posed(method, low_cost_set=inverse(TRUTH)[None])
    assert_found(method.register(problem))
    without = method.register(posed(method))
    position, _ = pose_errors(without.object_from_world[:1], TRUTH, symmetry=ObjectSymmetry())
    assert position[0] > 0.02


def test_as_many_hypotheses_come_as_are_wanted():
    method = anchored()
    initial = np.tile(np.eye(4), (700, 1, 1))
    assert registered(method, posed(method, FEW, initial_set=initial)).distinct == 700


def test_on_a_plane_starts_off_it_count_by_where_they_stand():
    """One that fits where the object cannot be does not keep those out that fit on the plane."""
    method = anchored(plane=PlaneSettings(plane_height=0.2))
    problem = posed(method, initial_set=np.tile(inverse(TRUTH), (5, 1, 1)))
    found = registered(method, problem)
    np.testing.assert_allclose(inverse(found.elites)[:, 2, 3], 0.2, atol=1e-3)


def rounds_of(method, problem):
    watcher = Watcher()
    method.register(problem, watcher)
    return [stage for stage, _, _ in watcher.progressed].count("search")


def test_rounds_go_on_while_there_are_new_modes_and_stop_at_the_budget():
    one = EFFORT.samples + 24 * 5 + 12 * 8 + 8 * 30
    for points, budget, most, rounds in (
        (POINTS, 0, 12, 1),
        (POINTS, 12 * one, 12, 2),  # of one mode, which the second round confirms
        (FEW, 2 * one + 1, 12, 3),
        (FEW, 2 * one + 1, 2, 2),
    ):
        method = anchored(replace(EFFORT, evaluations=budget, rounds=most))
        assert rounds_of(method, posed(method, points)) == rounds


@pytest.mark.parametrize(("contacts", "spacing"), [(12, 5000), (40, 60)])
def test_wrong_free_points_do_not_move_the_best(contacts, spacing):
    """1 or 77 voxels that a sensor took for free, up to half a voxel inside of the object."""
    inner = np.stack(np.meshgrid(*[np.arange(-0.05, 0.3, 0.005)] * 3, indexing="ij"), -1)
    inner = inner.reshape(-1, 3)
    depths = -GRID.at(inner, lookup="trilinear")[0]
    wrong = apply(TRUTH, inner[(depths > 0.002) & (depths < 0.5 * SIDE)])[::spacing]
    method = anchored()
    points = known_points(TRUTH, contacts)
    right = registered(method, posed(method, points))
    points = replace(points, free=np.concatenate([points.free, wrong]))
    found = registered(method, posed(method, points))
    assert_found(found)
    most = WRONG * (1.0 + LATER * (len(wrong) - 1))
    assert 0.1 * most < found.cost[0] - right.cost[0] <= most


@pytest.mark.parametrize("contacts", [5, 6, 9])
def test_the_truth_stays_beside_a_foreign_contact_among_few(contacts):
    """Among the hypotheses, or the rivals of the best, which is not determined if it is wrong."""
    method = Anchored(AnchoredSettings())
    points = known_points(TRUTH, contacts)
    foreign = apply(TRUTH, np.array([[0.03, 0.03, 0.16]]))
    known = np.concatenate([points.known, foreign])
    problem = posed(method, KnownPoints(free=points.free, known=known))
    found = method.register(problem)
    poses = Poses.joined([Poses.of(found.object_from_world), method.minima(problem)])
    off = outline_distances_to(GRID, poses, other=Poses.of(inverse(TRUTH)[None]))
    assert off.min() < 0.01
    trust = trust_by(method, problem, hypotheses=found)
    assert trust is not None
    assert off[0] < 0.01 or trust.verdict != "determined"


@pytest.mark.parametrize(("contacts", "expected"), [(3, {0}), (4, {0, 1})])
def test_rounds_of_more_than_three_contacts_leave_one_out_in_turn(monkeypatch, contacts, expected):
    left_out = set()
    best = AnchorSampler.best

    def watched(*arguments, **named):
        left_out.add(named["left_out"])
        return best(*arguments, **named)

    monkeypatch.setattr(AnchorSampler, "best", watched)
    method = anchored(replace(EFFORT, evaluations=100_000))
    method.register(posed(method, KnownPoints(known=POINTS.known[:contacts])))
    assert left_out == expected


def test_the_twin_of_a_nearly_symmetric_object_is_found_from_the_other():
    """Contacts lie half way between a box and the same box turned; one pose is sampled."""
    centre = np.array([0.15, -0.1, 0.05])
    mesh = trimesh.creation.box((0.1, 0.106, 0.16)).apply_translation(centre)
    sdf = SdfGrid.from_mesh(mesh, 0.005)
    between = trimesh.creation.box((0.103, 0.103, 0.16))
    contacts = apply(TRUTH, centre + trimesh.sample.sample_surface(between, 40, seed=1)[0])
    turn = axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.5 * np.pi))
    quarter = compose(turn, centre - turn @ centre)
    both = Poses.of(inverse(np.stack([TRUTH, TRUTH @ quarter])))
    assert outline_distances_to(sdf, both[:1], other=both[1:])[0] > 0.002
    method = anchored(replace(EFFORT, samples=1))
    start = np.repeat(both.matrices[:1], 9, axis=0)
    problem = posed(method, KnownPoints(known=contacts), sdf=sdf, initial_set=start)
    found = Poses.of(registered(method, problem).object_from_world)
    for one in (both[:1], both[1:]):
        assert outline_distances_to(sdf, found, other=one).min() < 0.001
    alone = hypotheses_at(start[:1])
    assert trust_in(problem, alone).verdict == "determined"
    trust = trust_by(build_method("icp"), problem, hypotheses=alone)  # which searches for rivals
    assert trust is not None
    assert str(trust).startswith("determined up to a turn of ")


def test_the_better_poses_are_fitted_and_the_others_stay():
    method = anchored(replace(EFFORT, refined=2))
    search = Search(posed(method), method.settings, observer=NullObserver())
    before = search.rated(Poses.of(around_truth(6)))
    after = search.refined(before)
    assert (np.diff(after.energies) >= 0.0).all()
    assert after.energies[1] < before.energies[0]
    np.testing.assert_array_equal(after.energies[2:], before.energies[2:])
    np.testing.assert_array_equal(after.poses.numbers[2:], before.poses.numbers[2:])


def test_poses_are_held_that_errors_shared_by_all_points_explain():
    """All points are 3.5 mm beside where they were, as by a wrong calibration."""
    shift = np.array([0.0, 0.0, 0.0035])
    points = KnownPoints(known=POINTS.known + shift, free=POINTS.free + shift)
    beside = np.stack([TRUTH, TRUTH])
    beside[1, 0, 3] += 0.02
    for shared, holds in ((0.004, True), (0.0, False)):
        method = anchored(shared_error=shared)
        problem = posed(method, points)
        flags = method.holds(problem, method.register(problem), inverse(beside))
        assert flags.tolist() == [holds, False]


def test_a_foreign_contact_does_not_move_the_best():
    foreign = POINTS.known[20:22] + np.array([[0.0, 0.0, 0.4], [1000.0, 0.0, 0.0]])
    points = KnownPoints(free=POINTS.free, known=np.concatenate([POINTS.known[:20], foreign]))
    method = anchored()
    problem = posed(method, points)
    found = registered(method, problem)
    assert_found(found)
    beside = np.stack([inverse(TRUTH), found.object_from_world[0]])
    far = beside[1:].copy()
    far[:, 2, 3] += 0.1
    flags = method.holds(problem, found, np.concatenate([beside, far]))
    assert flags.tolist() == [True, True, False]


def test_updates_on_the_same_points_never_lose_the_best():
    """With a sensor as inexact as the points, so that all energies are of one noise."""
    method = anchored(noise=0.003)
    previous = None
    lowest = []
    for _ in range(5):
        previous = method.register(posed(method, INEXACT, previous=previous))
        lowest.append(previous.cost[0])
    assert (np.diff(lowest) <= 1e-12).all()


def test_a_limit_that_excludes_nearly_all_still_gives_hypotheses():
    method = anchored(limit=1e-9)
    registered(method, posed(method))


def test_an_object_of_few_nodes_inside_has_results():
    plate = trimesh.creation.box((0.1, 0.08, 0.011))
    method = anchored()
    grid = SdfGrid.from_mesh(plate, 0.01)
    contacts = apply(TRUTH, np.asarray(trimesh.sample.sample_surface(plate, 5, seed=1)[0]))
    registered(method, posed(method, KnownPoints(known=contacts, free=POINTS.free), sdf=grid))


@pytest.mark.filterwarnings("ignore:no node of the SDF:UserWarning")
def test_a_grid_without_a_node_inside_is_one_clear_error():
    grid = SdfGrid(
        GRID.origin, 0.01, values=np.maximum(GRID.values, 0.001), gradients=GRID.gradients
    )
    method = anchored()
    with pytest.raises(ChselError, match="no node of the SDF grid is inside") as raised:
        method.register(posed(method, sdf=grid))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("modes", "reach"), [(3, 1.0), (1, 2.0)])
def test_hypotheses_are_chosen_for_the_least_expected_plausible_diversity(modes, reach):
    count = 6
    problem = posed(anchored(), INEXACT_FEW, initial_set=np.tile(inverse(TRUTH), (count, 1, 1)))
    settings = AnchoredSettings(effort=EFFORT, modes=modes, reach=reach)
    search = Search(problem, settings, observer=NullObserver())
    every = search.spread(search.minima())
    candidates = every.chosen(np.arange(40) * len(every.energies) // 40)
    energies = candidates.energies
    descriptors = surface_descriptors(problem.sdf, candidates.poses)
    apart = ((descriptors[:, None] - descriptors) ** 2).sum(axis=2)

    def expected_diversity(chosen):
        """Of hypotheses, over all candidates that may be the true pose."""
        total = 0.0
        for truth in energies:
            between = apart[np.ix_(energies <= truth + reach, chosen)]
            total += between.min(axis=1).mean() + between.min(axis=0).sum() / count
        return total

    likely = candidates.poses[: int((energies <= energies[0] + 3.0).sum())]
    chosen = basin_bests(problem.sdf, likely, most=modes).tolist()
    while len(chosen) < count:
        others = [i for i in range(len(energies)) if i not in chosen]
        chosen.append(min(others, key=lambda i: expected_diversity([*chosen, i])))
    found = search.choose(candidates).object_from_world
    np.testing.assert_allclose(found, candidates.poses.matrices[sorted(chosen)], atol=1e-9)


def touched(chosen, *, noise=0.1):
    """Contacts (N, 3) of the L at TRUTH with the normals of its faces, some of 400."""
    places, faces = trimesh.sample.sample_surface(MESH, 400, seed=1)
    known = apply(TRUTH, np.asarray(places)[chosen])
    normals = np.asarray(MESH.face_normals)[faces][chosen] @ TRUTH[:3, :3].T
    return KnownPoints(known=known, normals=normals, normal_noise=np.full(len(known), noise))


def test_normals_of_three_contacts_rule_out_most_poses_that_fit_them_and_keep_the_true_one():
    method = anchored()
    left = []
    for seed in range(3):
        points = touched(np.random.default_rng(seed).choice(400, 3, replace=False))
        problem = posed(method, points)
        bare = replace(problem, points=points.without_normals())
        found, others = method.register(problem), method.register(bare)
        assert method.holds(bare, others, others.object_from_world).all()
        left.append(method.holds(problem, found, others.object_from_world).mean())
        assert method.holds(problem, found, inverse(TRUTH)[None]).all()
        assert method.holds(problem, found, found.object_from_world).all()
    assert np.mean(left) < 0.2


def test_the_side_of_a_box_that_was_touched_is_known_by_normals_alone():
    """Four contacts on its top; without normals it lies above them as well as below."""
    top = np.array([[0.07, 0.04, 0.04], [-0.06, 0.03, 0.04], [0.0, -0.05, 0.04], [0.01, 0.0, 0.04]])
    up = np.tile(TRUTH[:3, 2], (4, 1))
    points = KnownPoints(known=apply(TRUTH, top), normals=up, normal_noise=np.full(4, 0.1))
    method = anchored()
    problem = posed(method, points, sdf=BOX_GRID)
    for given, shares in ((points, (0.0, 0.0)), (points.without_normals(), (0.2, 0.8))):
        found = method.register(replace(problem, points=given))
        heights = (found.world_from_object[:, :3, 3] - points.known[3]) @ TRUTH[:3, 2]
        assert np.abs(heights).min() > 0.035  # half of the least side
        assert shares[0] <= (heights > 0.0).mean() <= shares[1]


def test_a_foreign_contact_with_any_normal_among_eight_moves_nothing():
    for seed in (17, 18, 20, 22):
        random = np.random.default_rng(seed)
        points = touched(random.choice(400, 8, replace=False))
        normal = random.standard_normal(3)
        known, normals = points.known.copy(), points.normals.copy()
        known[-1] += 0.05 * normals[-1]
        normals[-1] = normal / np.linalg.norm(normal)
        method = anchored()
        foreign = replace(points, known=known, normals=normals)
        position, rotation = pose_errors(
            method.register(posed(method, foreign)).object_from_world[:1],
            TRUTH,
            symmetry=ObjectSymmetry(),
        )
        assert position[0] < 0.002
        assert rotation[0] < 0.02


def test_a_hundred_contacts_with_normals_are_found_exactly():
    method = anchored()
    found = registered(method, posed(method, touched(slice(0, 100))))
    position, rotation = pose_errors(found.object_from_world[:1], TRUTH, symmetry=ObjectSymmetry())
    assert position[0] < 0.0003
    assert rotation[0] < 0.002


def test_normals_count_in_beliefs_and_verdicts_as_in_the_search():
    """By the formula in numpy, of a result of few contacts and of one with a prior."""
    points = touched(np.random.default_rng(2).choice(400, 5, replace=False))
    prior = PosePrior(axis=[0, 0, 1], along=TRUTH[:3, 2], axis_noise=0.1)
    method = anchored()
    for given in (None, prior):
        problem = replace(posed(method, points), prior=given)
        found = method.register(problem)
        poses = Poses.of(found.object_from_world)
        noise = noise_model(method.settings.noise)
        plain = plain_energies(noise, GRID, points=points, poses=poses)
        plain += 0.0 if given is None else given.energies(poses, GRID)
        np.testing.assert_allclose(found.cost, plain, atol=0.1)  # tables of densities
        np.testing.assert_allclose(pose_energies(problem, poses, noise=noise), plain, atol=1e-6)


KNOB_SIDES = np.array([0.2, 0.12, 0.08])
KNOB, KNOB_PLACES = box_with_knob(KNOB_SIDES)
"""A box with a knob, of which the contacts leave two modes, turned by pi about its z axis."""


def knob_problem(method, prior):
    points = KnownPoints(known=apply(TRUTH, KNOB_PLACES))
    grid = SdfGrid.from_mesh(KNOB, 0.005)
    return replace(posed(method, points, sdf=grid), prior=prior)


def turns_off(found):
    """Angles (B,), radians, between the hypotheses and the true pose."""
    return rotation_angle(found.object_from_world[:, :3, :3] @ TRUTH[:3, :3])


def test_a_prior_on_an_axis_chooses_between_two_modes():
    method = anchored()
    for prior, modes in (
        (None, [True, True]),
        (PosePrior(axis=[1, 0, 0], along=TRUTH[:3, 0], axis_noise=0.3), [True, False]),
        (PosePrior(axis=[1, 0, 0], along=-TRUTH[:3, 0], axis_noise=0.3), [False, True]),
    ):
        off = turns_off(method.register(knob_problem(method, prior)))
        assert [(off < 0.1).any(), (off > np.pi - 0.1).any()] == modes


def test_a_prior_of_poses_chooses_between_two_modes():
    """A pose near the other one, off by 1 cm and 0.1 rad as it says."""
    other = compose(axis_angle(TRUTH[:3, 2], np.pi + 0.1) @ TRUTH[:3, :3], TRUTH[:3, 3] + 0.006)
    spread = np.diag([0.01**2] * 3 + [0.1**2] * 3)
    prior = PosePrior(object_from_world=inverse(other)[None], covariances=spread)
    method = anchored()
    off = turns_off(method.register(knob_problem(method, prior)))
    assert off[0] > np.pi - 0.1
    assert (off > np.pi - 0.1).mean() > 0.9  # a prior may be wrong: so is one in e^7


def test_points_overrule_a_prior_that_is_20_cm_off():
    prior = PosePrior(centre=TRUTH[:3, 3] + [0.2, 0.0, 0.0], centre_noise=0.02, point=np.zeros(3))
    method = anchored()
    points = touched(np.random.default_rng(1).choice(400, 12, replace=False))
    problem = replace(posed(method, points), prior=prior)
    found = method.register(problem)
    assert_found(found)
    (warning,) = check_prior(problem, found)
    assert warning.code == "prior"
    assert "19." in warning.text or "20." in warning.text  # centimetres


def test_poses_of_a_prior_are_searched_from():
    """One that nothing else leads to: two samples are drawn, and E_0 is anywhere else."""
    effort = replace(EFFORT, samples=2, kept=2, rounds=1, descents=2)
    near = TRUTH @ compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.2)), np.full(3, 0.01))
    spread = np.diag([0.02**2] * 3 + [0.3**2] * 3)
    prior = PosePrior(object_from_world=inverse(near)[None], covariances=spread)
    method = anchored(effort)
    problem = posed(method, POINTS)
    assert_found(method.register(replace(problem, prior=prior)))
    energies = [method.register(replace(problem, prior=p)).cost[0] for p in (prior, None)]
    assert energies[0] < energies[1] - 10.0


def test_a_prior_is_on_the_pose_before_the_pushes_that_are_found():
    """Five pushes by 4 mm along x, each after eight contacts: a prior on where it is now is off."""
    pushed = TRUTH.copy()
    pushed[0, 3] += 0.02
    points = touched(slice(0, 48))
    known = points.known + np.repeat(np.arange(6), 8)[:, None] * [0.004, 0.0, 0.0]
    before = np.array([[0, 0, 8 * n] for n in range(1, 6)])
    along = Pushes(np.tile([1.0, 0.0, 0.0], (5, 1)), before, largest=0.008)
    method = anchored()
    problem = replace(posed(method, replace(points, known=known)), pushes=along)
    for truth, warned in ((TRUTH, False), (pushed, True)):
        prior = PosePrior(centre=truth[:3, 3], centre_noise=0.002, point=np.zeros(3))
        found = method.register(replace(problem, prior=prior))
        assert found.push_distance == pytest.approx(0.004, abs=1e-4)
        np.testing.assert_allclose(found.world_from_object[0], pushed, atol=2e-3)
        assert bool(check_prior(replace(problem, prior=prior), found)) is warned
