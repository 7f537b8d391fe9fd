"""Poses sampled on contacts, and starts from them."""

from dataclasses import replace

import numpy as np
import pytest

from chsel.methods import build_method, preset_settings
from chsel.methods.anchor_sampling import (
    AnchoredStarts,
    AnchorSampler,
    AnchorSettings,
    anchored_starts,
    most_informative_first,
)
from chsel.methods.chsel import Chsel
from chsel.numerics.threads import threads
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses, apply, compose, inverse
from chsel.problem.search_space import PlaneSettings, origin_bounds, search_space
from chsel.problem.surface import has_surface
from tests.chsel.methods.scene import BOX, BOX_GRID, WORKSPACE, Watcher, box_problem, contacts_on

CONTACTS = contacts_on(BOX, 12)
PAIRS, SINGLES = AnchorSettings(1.0, 0.0), AnchorSettings(0.0, 1.0)
UNIFORM = AnchorSettings(0.0, 0.0)


def drawn(points, settings, *, samples=3000, most=3000, plane=None, index=0, left_out=0):
    """The best poses (K, 12); all of them where most is as many."""
    space = search_space(plane, BOX_GRID)
    known = most_informative_first(points)
    sampler = AnchorSampler(box_problem(points), known, space=space, settings=settings)
    return sampler.best(samples, most, index=index, left_out=left_out).numbers


def distances(poses, points, *, lookup="trilinear"):
    """Signed distances (B, M) at world points."""
    rotations = poses[:, :9].reshape(-1, 3, 3)
    moved = np.einsum("nij,mj->nmi", rotations, points) + poses[:, None, 9:]
    s = BOX_GRID.at(moved.reshape(-1, 3), lookup=lookup)[0]
    return s.reshape(len(poses), len(points))


def test_pairs_put_the_surface_onto_two_contacts():
    contacts = CONTACTS[[0, 1]]
    poses = drawn(KnownPoints(known=contacts), PAIRS)
    assert len(poses) > 300
    off = np.abs(distances(poses, contacts)).max(axis=1)
    assert off.max() < 0.006
    assert np.median(off) < 0.002
    uniform = np.abs(distances(drawn(KnownPoints(known=contacts), UNIFORM), contacts)).max(axis=1)
    assert np.median(uniform) > 0.03


@pytest.mark.parametrize("value", [0.0, 0.02, -0.01])
def test_a_point_of_known_distance_is_met_at_that_distance(value):
    poses = drawn(KnownPoints(known=CONTACTS[:1], known_sdf=np.array([value])), SINGLES)
    assert len(poses) > 300
    off = np.abs(distances(poses, CONTACTS[:1]) - value)
    assert np.quantile(off, 0.8 if value else 1.0) < 0.003


def test_rotations_are_rigid_and_objects_within_bounds():
    lower, upper = origin_bounds(WORKSPACE, search_space(None, BOX_GRID), margin=0.15)
    np.testing.assert_allclose(lower, np.array(WORKSPACE.lower) - 0.15)
    poses = drawn(KnownPoints(known=CONTACTS), AnchorSettings())
    rotations = poses[:, :9].reshape(-1, 3, 3)
    products = np.einsum("nij,nkj->nik", rotations, rotations)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-9)
    origins = -np.einsum("nij,ni->nj", rotations, poses[:, 9:])
    assert ((origins >= lower) & (origins <= upper)).all()


def test_the_best_are_the_first_of_all_and_do_not_depend_on_threads():
    free = np.random.default_rng(0).uniform(-0.1, 0.5, (3000, 3))
    points = KnownPoints(free=free, known=CONTACTS)
    count = 70_000  # more than are drawn at once
    every = drawn(points, AnchorSettings(), samples=count, most=count)
    with threads(1):
        one = drawn(points, AnchorSettings(), samples=count, most=40)
    with threads(2):
        two = drawn(points, AnchorSettings(), samples=count, most=40)
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one, every[:40])
    assert (
        np.abs(drawn(points, AnchorSettings(), samples=count, most=40, index=1) - one).max() > 1e-3
    )


@pytest.mark.parametrize(("axis", "value"), [((0.0, 0.0, 1.0), 0.02), ((0.48, 0.6, 0.64), 0.0)])
def test_on_a_plane_poses_stand_on_it_and_still_meet_contacts(axis, value):
    plane = PlaneSettings(axis=axis, offset=-0.3)
    space = search_space(plane, BOX_GRID)
    standing = inverse(space.poses(np.array([[0.5, 0.05, -0.1]])).matrices)[0]
    contact = apply(standing, np.array([[0.1 + value, 0.02, 0.01]]))
    points = KnownPoints(known=contact, known_sdf=[value])
    poses = drawn(points, SINGLES, plane=plane)
    assert len(poses) > 300
    np.testing.assert_allclose(space.poses(space.encode(Poses(poses))).numbers, poses, atol=1e-9)
    off = np.abs(distances(poses, contact) - value)
    assert np.quantile(off, 0.8 if value else 1.0) < 0.006


def test_known_points_come_far_apart_first_and_none_is_lost():
    random = np.random.default_rng(2)
    known = random.standard_normal((200, 3))
    values = random.standard_normal(200)
    normals = known / np.linalg.norm(known, axis=1, keepdims=True)
    noise = random.uniform(0.1, 0.2, 200)
    points = KnownPoints(known=known, known_sdf=values, normals=normals, normal_noise=noise)
    ordered = most_informative_first(points)
    rows = np.lexsort(known.T), np.lexsort(ordered.known.T)
    np.testing.assert_array_equal(known[rows[0]], ordered.known[rows[1]])
    np.testing.assert_array_equal(values[rows[0]], ordered.sdf[rows[1]])
    np.testing.assert_array_equal(normals[rows[0]], ordered.normals[rows[1]])
    np.testing.assert_array_equal(noise[rows[0]], ordered.normal_noise[rows[1]])
    first = ordered.known[:8]
    gaps = np.sqrt(((first[:, None] - first[None]) ** 2).sum(axis=2)) + 9.0 * np.eye(8)
    assert gaps.min() > 2.0


def test_poses_come_in_the_order_of_their_plain_scores():
    """Mean distance of contacts up to 60 mm, and depths of nodes inside that are in free voxels."""
    lattice = np.stack(np.meshgrid(*[np.arange(-0.1, 0.7, 0.03)] * 3, indexing="ij"), -1)
    free = lattice.reshape(-1, 3)
    free = free[free[:, 0] < 0.18]
    poses = drawn(KnownPoints(free=free, known=CONTACTS), AnchorSettings())
    contacts = np.minimum(np.abs(distances(poses, CONTACTS, lookup="nearest")), 0.06).mean(axis=1)
    nodes = np.argwhere(BOX_GRID.values <= 0.3 * BOX_GRID.values.min())
    depths = -BOX_GRID.values[tuple(nodes.T)]
    costs = 5.0 * depths + 20.0 * np.maximum(depths - min(0.015, 0.5 * depths.max()), 0.0)
    inside = BOX_GRID.origin + nodes * BOX_GRID.resolution
    back = inside - poses[:, None, 9:]
    world = np.einsum("nji,nmj->nmi", poses[:, :9].reshape(-1, 3, 3), back)
    taken = (world[..., 0] < 0.185) & (world > -0.115).all(axis=2) & (world < 0.695).all(axis=2)
    scores = contacts + (taken * costs).mean(axis=1)
    assert np.ptp(scores) > 0.05
    assert np.corrcoef(scores, np.sort(scores))[0, 1] > 0.97  # the kernel takes some nodes
    assert (scores[:30] < np.quantile(scores, 0.1)).all()


def test_the_worst_contact_can_be_left_out():
    """One of six points is 80 mm off: the poses come in the order of what the others cost."""
    contacts = CONTACTS[:6] + np.array([[0.0, 0.0, 0.08]] + [[0.0, 0.0, 0.0]] * 5)
    values = np.array([0.0, 0.0, 0.01, -0.01, 0.005, 0.0])
    points = KnownPoints(known=contacts, known_sdf=values)
    poses = drawn(points, AnchorSettings(), samples=20_000, most=300, left_out=1)
    costs = np.minimum(np.abs(distances(poses, contacts, lookup="nearest") - values), 0.06)
    trimmed = costs.sum(axis=1) - costs.max(axis=1)
    np.testing.assert_allclose(trimmed, np.sort(trimmed), atol=1e-6)
    others = drawn(points, AnchorSettings(), samples=20_000, most=3000)
    costs = np.minimum(np.abs(distances(others, contacts, lookup="nearest") - values), 0.06)
    total = costs.sum(axis=1)
    np.testing.assert_allclose(total, np.sort(total), atol=0.002)  # many are out of the grid
    assert trimmed[0] < (costs.sum(axis=1) - costs.max(axis=1))[0]


def test_poses_whose_normals_fit_come_first():
    """A normal costs 20 mm (1 - cos), at most 30 mm; of six contacts, one has none."""
    contacts = CONTACTS[:6]
    random = np.random.default_rng(5)
    normals = random.standard_normal((6, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[2] = 0.0
    noise = np.where(np.arange(6) == 2, 0.0, [0.1, 0.3, 0.2, 3.0, 1e-6, 0.2])
    points = KnownPoints(known=contacts, normals=normals, normal_noise=noise)
    poses = drawn(points, AnchorSettings(), samples=20_000, most=300)
    distance = np.minimum(np.abs(distances(poses, contacts, lookup="nearest")), 0.06)
    rotations = poses[:, :9].reshape(-1, 3, 3)
    moved = np.einsum("nij,mj->nmi", rotations, contacts) + poses[:, None, 9:]
    gradients = BOX_GRID.at(moved.reshape(-1, 3), lookup="nearest")[1].reshape(-1, 6, 3)
    cosines = (np.einsum("nij,mj->nmi", rotations, normals) * gradients).sum(axis=2)
    off = np.minimum(0.02 * (1.0 - cosines), 0.03) * (noise > 0.0)
    total = (distance + off).sum(axis=1)
    np.testing.assert_allclose(total, np.sort(total), atol=1e-6)
    assert np.ptp(total) > 0.01
    without = drawn(replace(points, normals=None, normal_noise=None), AnchorSettings())
    assert np.abs(without[:20] - poses[:20]).max() > 0.1


FAR = inverse(compose(np.tile(np.eye(3), (5, 1, 1)), np.tile([0.5, 0.4, 0.0], (5, 1))))
STARTS = AnchoredStarts(samples=3000, kept=8)


def posed(points=None, sdf=BOX_GRID):
    """A box touched on all sides, of which E_0 (5, 4, 4) knows nothing."""
    points = points or KnownPoints(known=contacts_on(BOX, 40))
    return replace(box_problem(points), sdf=sdf, initial_set=FAR)


def starts_of(problem):
    return anchored_starts(
        problem, search_space(None, problem.sdf), settings=STARTS, index=0
    ).matrices


def test_starts_are_nearer_to_the_contacts_than_e_0():
    problem = posed()
    starts = starts_of(problem)
    assert starts.shape == (8, 4, 4)
    known = problem.points.known
    away = [np.abs(BOX_GRID.at(apply(pose, known))[0]).mean() for pose in starts]
    assert max(away) < 0.03
    before = [np.abs(BOX_GRID.at(apply(pose, known))[0]).mean() for pose in FAR]
    assert min(before) > 0.2


def test_without_contacts_starts_are_anywhere_in_the_workspace():
    free = np.stack(np.meshgrid(*[np.arange(0.025, 0.2, 0.05)] * 3), axis=-1).reshape(-1, 3)
    position = inverse(starts_of(posed(KnownPoints(free=free))))[:, :3, 3]
    assert (position > np.array(WORKSPACE.lower) - 0.15).all()
    assert (position < np.array(WORKSPACE.upper) + 0.15).all()
    assert position.std(axis=0).min() > 0.1


def test_there_are_none_of_an_object_without_a_surface():
    thin = replace(BOX_GRID, values=np.abs(BOX_GRID.values) + 0.01)
    assert has_surface(BOX_GRID)
    assert not has_surface(thin)
    assert starts_of(posed(sdf=thin)).shape == (0, 4, 4)
    assert len(build_method("chsel").register(posed(sdf=thin)).cost) == 5


@pytest.mark.parametrize("name", ["chsel", "chsel_cma_me"])
def test_default_finds_what_e_0_is_too_far_from(name):
    settings = preset_settings(name)
    assert settings.starts is not None
    quick = replace(settings, emitter=replace(settings.emitter, iterations=5))
    observer, problem = Watcher(), posed()
    found = Chsel(replace(quick, starts=STARTS)).register(problem, observer)
    firsts = [trace for trace in observer.traces if trace[:2] == ("descent", 0)]
    assert [len(first.vectors) for first in firsts] == [5 + 8]
    assert len(found.cost) == len(FAR)
    alone = Chsel(replace(quick, starts=None)).register(problem)
    assert found.cost[0] < 0.5 * alone.cost[0]
