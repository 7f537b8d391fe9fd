"""ICP beside that of trimesh, and the objects that it finds."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from chsel import KnownPoints, RegistrationProblem, SdfGrid
from chsel.methods import preset_settings
from chsel.methods.icp import Icp, IcpSettings
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.poses import apply, compose, inverse, random_rotations
from chsel.problem.search_space import SE3Space
from chsel.problem.streams import StreamKey
from tests.chsel.methods.scene import (
    GRID,
    MESH,
    TRUTH,
    WORKSPACE,
    Watcher,
    around_truth,
    contacts_on,
)
from tests.chsel.samples import box_distance

CONTACTS = contacts_on(MESH, 40)
DENSE = IcpSettings(surface_points=5000)
KEY = StreamKey(5, 2)


def posed(known=CONTACTS, initial_set=None, *, key=KEY, **points):
    initial_set = around_truth(angle=0.4) if initial_set is None else initial_set
    return RegistrationProblem(
        sdf=GRID,
        points=KnownPoints(known=known, **points),
        initial_set=initial_set,
        workspace=WORKSPACE,
        free_resolution=0.02,
        key=key,
    )


def after(problem, iterations):
    """The transforms (B, 4, 4) after so many iterations, in the order of E_0."""
    kept = Watcher()
    Icp(IcpSettings(iterations=iterations, stop_below=None)).register(problem, kept)
    return last_transforms(kept)


def last_transforms(kept):
    return SE3Space().poses(kept.traces[-1].vectors).matrices


def test_every_iteration_is_that_of_trimesh():
    problem = posed()
    model = Icp().surface(problem)
    tree = cKDTree(model)
    transforms = problem.initial_set
    for iteration in range(1, 13):
        matched = [model[tree.query(apply(transform, CONTACTS))[1]] for transform in transforms]
        transforms = np.array(
            [
                trimesh.registration.procrustes(CONTACTS, q, reflection=False, scale=False)[0]
                for q in matched
            ]
        )
        np.testing.assert_allclose(after(problem, iteration), transforms, rtol=0, atol=1e-9)


def test_where_it_converges_is_where_trimesh_does():
    problem = posed()
    model = Icp().surface(problem)
    kept = Watcher()
    found = Icp(IcpSettings(stop_below=0.0)).register(problem, kept)
    theirs = [
        trimesh.registration.icp(
            CONTACTS, model, start, threshold=0.0, max_iterations=100, reflection=False, scale=False
        )
        for start in problem.initial_set
    ]
    expected = np.array([matrix for matrix, _, _ in theirs])
    np.testing.assert_allclose(last_transforms(kept), expected, rtol=0, atol=1e-9)
    costs = sorted(np.sqrt(cost) for _, _, cost in theirs)
    np.testing.assert_allclose(found.cost, costs, rtol=1e-6)


def test_the_object_is_found_where_it_was_touched_all_over():
    found = Icp(DENSE).register(posed())
    position, rotation = pose_errors(found.object_from_world, TRUTH, symmetry=ObjectSymmetry())
    assert position[0] < 0.005
    assert rotation[0] < 0.05


def test_exact_touches_of_a_large_object_are_met_to_two_millimetres():
    """Their true residual is 0; with points of the surface too far apart it is 3.4 mm."""
    sides = np.array([0.2, 0.15, 0.22])
    box = trimesh.creation.box(sides)
    sdf = SdfGrid.from_mesh(box, 0.01)
    touches = KnownPoints(known=contacts_on(box, 40))
    method = Icp()
    residuals = []
    for seed in range(9):
        key = StreamKey(seed, 0)
        starts = around_truth(angle=0.1)
        found = method.register(
            RegistrationProblem(
                sdf=sdf,
                points=touches,
                initial_set=starts,
                workspace=WORKSPACE,
                free_resolution=0.02,
                key=key,
            )
        )
        touched = apply(found.object_from_world[0], touches.known)
        residuals.append(np.abs(box_distance(touched, sides)).mean())
    assert np.median(residuals) < 0.002


def test_it_stops_at_the_first_iteration_in_which_no_start_gains():
    problem, kept = posed(), Watcher()
    Icp(IcpSettings(stop_below=1e-3)).register(problem, kept)
    every = [after(problem, n) for n in range(1, kept.iterations[-1] + 1)]
    model = cKDTree(Icp().surface(problem))
    before = np.full(len(problem.initial_set), np.inf)
    gains = []
    poses = problem.initial_set
    for aligned in every:
        errors = []
        for pose, new in zip(poses, aligned, strict=True):
            matched = model.data[model.query(apply(pose, CONTACTS))[1]]
            errors.append(np.sqrt(((apply(new, CONTACTS) - matched) ** 2).sum(axis=1).mean()))
        gains.append((np.array(errors) < (1.0 - 1e-3) * before).any())
        before = np.array(errors)
        poses = aligned
    assert gains == [True] * (len(every) - 1) + [False]
    np.testing.assert_allclose(last_transforms(kept), every[-1], rtol=0, atol=1e-12)
    assert len(every) % 10 != 0  # so that the stop was within a block
    assert kept.iterations == [0, *range(10, len(every), 10), len(every)]
    assert [done for _, done, _ in kept.progressed] == kept.iterations[1:]


def test_contacts_alone_count():
    problem, method = posed(), Icp()
    first = method.register(problem).digest
    free = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    more = posed(free=free, occupied=free[:3])
    assert method.register(more).digest == first
    felt = np.concatenate([CONTACTS, free[:2]])
    problem = posed(felt, known_sdf=np.append(np.zeros(len(CONTACTS)), [0.1, 0.2]))
    assert method.register(problem).digest == first


def test_surface_points_stay_or_change_as_the_preset_says():
    first, later, other = (posed(key=StreamKey(key[0], key[1])) for key in ((5, 2), (5, 3), (6, 2)))
    presets = (("default", 2000, True), ("paper", 500, False), ("reference", 500, True))
    for preset, count, stays in presets:
        method = Icp(preset_settings("icp", preset))
        points = method.surface(first)
        assert points.shape == (count, 3)
        assert np.array_equal(points, method.surface(first))
        assert np.array_equal(points, method.surface(later)) == stays
        assert not np.array_equal(points, method.surface(other))


def test_what_contacts_leave_open_stays_as_it_was():
    problem = posed(CONTACTS[:1])
    np.testing.assert_allclose(
        after(problem, 5)[:, :3, :3], problem.initial_set[:, :3, :3], atol=1e-12
    )
    # Two contacts: the least turn that brings their line onto that of the points matched.
    problem = posed(CONTACTS[:2], around_truth(30, 0.4))
    model = Icp().surface(problem)
    aligned = after(problem, 1)
    for start, new in zip(problem.initial_set, aligned, strict=True):
        moved = apply(start, CONTACTS[:2])
        matched = model[cKDTree(model).query(moved)[1]]
        old_line, new_line = np.diff(moved, axis=0)[0], np.diff(matched, axis=0)[0]
        if np.sqrt((new_line**2).sum()) < 1e-9:
            continue
        cosine = old_line @ new_line / np.sqrt((old_line @ old_line) * (new_line @ new_line))
        turn = new[:3, :3] @ start[:3, :3].T
        assert np.trace(turn) == pytest.approx(1.0 + 2.0 * cosine, abs=1e-9)


def test_contacts_matched_with_one_point_do_not_turn_the_object():
    far = around_truth(30, 0.4)
    far[:, :3, 3] *= 1.0 + 2.0 * np.arange(30)[:, None]
    problem = posed(initial_set=far)
    tree = cKDTree(Icp().surface(problem))
    alone = [len(set(tree.query(apply(start, CONTACTS))[1])) == 1 for start in far]
    assert sum(alone) > 5
    turned = after(problem, 1)[alone, :3, :3]
    np.testing.assert_allclose(turned, far[alone, :3, :3], atol=1e-9)


def test_mirrored_contacts_are_not_met_by_a_reflection():
    mirrored = apply(TRUTH, apply(inverse(TRUTH), CONTACTS) * [1.0, 1.0, -1.0])
    turns = random_rotations(np.random.default_rng(0), 20)
    initial_set = inverse(compose(turns, np.tile(TRUTH[:3, 3], (20, 1))))
    found = Icp(DENSE).register(posed(mirrored, initial_set))
    np.testing.assert_allclose(np.linalg.det(found.object_from_world[:, :3, :3]), 1.0, atol=1e-9)
    assert found.cost[0] > 2.0 * Icp(DENSE).register(posed()).cost[0]


def test_without_contacts_the_initial_set_comes_back():
    problem = posed(np.zeros((0, 3)), free=[[0.0, 0.0, 0.0]])
    found = Icp().register(problem)
    np.testing.assert_array_equal(found.object_from_world, problem.initial_set)
    np.testing.assert_array_equal(found.cost, np.zeros(8))
