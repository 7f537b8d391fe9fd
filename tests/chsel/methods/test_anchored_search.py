"""The kernels of anchored: walks and fits.

A box of 20 x 12 x 8 cm (BOX_GRID) is at TRUTH, world_from_object, or upright at STANDING.
`on_faces(count, height)` are points over its faces in its frame, `poses_around_truth` poses off by
a length and an angle, `energy_of` the kernel's energy by points and noise, and `plain_energies` the
formula of chsel/problem/noise.py in numpy.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from chsel.methods.anchor_sampling import most_informative_first
from chsel.methods.anchored.energy import Energy
from chsel.methods.anchored.fitting import fitted, twists_of
from chsel.methods.anchored.walking import stride_of, walked
from chsel.problem.noise import (
    EXTENT,
    FACET,
    LEVELS,
    SHARE,
    WRONG_NORMALS,
    NoiseModel,
    noise_model,
)
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse, rotation_angle
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import PlaneSettings, SE3Space, origin_bounds, search_space
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import object_centre
from tests.chsel.methods.scene import (
    BOX,
    BOX_GRID,
    BOX_SIDES,
    STANDING,
    TRUTH,
    WORKSPACE,
    box_problem,
    energy_of,
    on_faces,
    poses_around_truth,
)
from tests.chsel.samples import plain_energies


def turned(angle, shift=0.0):
    """world_from_object: TRUTH after a turn about the box's x axis, and a shift along it."""
    turn = axis_angle(np.array([1.0, 0.0, 0.0]), np.array(angle))
    return np.asarray(TRUTH @ compose(turn, np.array([shift, 0.0, 0.0])))


def poses_of(*world_from_object):
    return Poses.of(inverse(np.array(world_from_object)))


PLANE = PlaneSettings(plane_height=0.3 - 0.5 * BOX_SIDES[2])  # on which the box is at STANDING
NORMAL = NoiseModel((0.001,) * LEVELS, (1.0 / LEVELS,) * LEVELS)
AROUND = KnownPoints(
    known=apply(TRUTH, on_faces(24)),
    free=apply(TRUTH, on_faces(60, 0.004)),
    occupied=apply(TRUTH, on_faces(6, -0.002)),
)


def chains_of(energy, poses, *, floor, moves, kept=0, plane=None):
    space = search_space(plane, BOX_GRID)
    stream = StreamKey(5, 2).kernel_stream(Purpose.WALKS, 3)
    stride = stride_of(
        space, object_centre(BOX_GRID), bounds=origin_bounds(WORKSPACE, space, margin=0.15)
    )
    return walked(
        energy,
        stride,
        poses=poses,
        energies=energy.of(poses),
        floor=floor,
        moves=moves,
        stream=stream,
        kept=kept,
    )


def repeated(world_from_object, count):
    return Poses.of(np.tile(inverse(world_from_object), (count, 1, 1)))


@pytest.mark.parametrize(("plane", "dimension", "contacts"), [(None, 6, 60), (PLANE, 3, 24)])
def test_kept_states_are_drawn_from_the_likelihood(plane, dimension, contacts):
    """Of a normal distribution in d dimensions, energies are d / 2 above the least on average."""
    truth = TRUTH if plane is None else STANDING
    energy = energy_of(KnownPoints(known=apply(truth, on_faces(contacts))), NORMAL)
    chains = chains_of(energy, repeated(truth, 100), floor=50.0, moves=1500, kept=15, plane=plane)
    above = chains.kept_energies[:, 5:] - energy.of(repeated(truth, 1))
    assert above.mean() == pytest.approx(0.5 * dimension, rel=0.08)
    assert above.var() == pytest.approx(0.5 * dimension, rel=0.25)
    space = search_space(plane, BOX_GRID)
    again = space.poses(space.encode(Poses(chains.poses)))
    np.testing.assert_allclose(again.numbers, chains.poses, atol=1e-9)


@pytest.mark.parametrize("points", [AROUND, KnownPoints(known=AROUND.known[:2])])
def test_energies_that_walks_carry_along_are_those_of_their_poses(points):
    """Walks gather free points once for many moves. None ends above the floor, or out of bounds."""
    energy = energy_of(points, noise_model(0.0005))
    starts = repeated(TRUTH, 12)
    floor = float(energy.of(starts).max()) + 4.0
    chains = chains_of(energy, starts, floor=floor, moves=300, kept=4)
    for numbers, energies in (
        (chains.poses, chains.energies),
        (chains.kept.reshape(-1, 12), chains.kept_energies.reshape(-1)),
    ):
        poses = Poses(numbers)
        np.testing.assert_allclose(energy.of(poses), energies, rtol=1e-12, atol=1e-9)
        assert energies.max() <= floor
        products = np.einsum("nij,nkj->nik", poses.rotations, poses.rotations)
        np.testing.assert_allclose(products, np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-10)
        assert (poses.origins >= np.array(WORKSPACE.lower) - 0.15).all()
        assert (poses.origins <= np.array(WORKSPACE.upper) + 0.15).all()
    assert np.abs(chains.kept - starts.numbers[:1]).max(axis=(0, 2)).min() > 1e-3


def test_walks_on_an_oblique_plane_slide_on_it_and_turn_about_its_normal():
    normal = np.array([0.48, 0.6, 0.64])
    plane = PlaneSettings(axis=tuple(normal), offset=-0.4)
    there = compose(np.eye(3), 0.4 * normal)  # world_from_object
    energy = energy_of(KnownPoints(known=apply(there, on_faces(24))), noise_model(0.002))
    found = Poses(
        chains_of(energy, repeated(there, 40), floor=50.0, moves=200, kept=3, plane=plane).poses
    )
    np.testing.assert_allclose(found.rotations @ normal, np.tile(normal, (40, 1)), atol=1e-12)
    np.testing.assert_allclose(found.translations @ normal, -0.4, atol=1e-12)
    assert found.translations.std(axis=0).min() > 1e-4
    assert rotation_angle(found.rotations).std() > 1e-3


def test_walks_from_above_come_down_to_a_floor_and_stop():
    energy = energy_of(AROUND, noise_model(0.0005))
    starts = poses_around_truth(12, 0.02, turn=0.2)
    before = energy.of(starts)
    floor = float(np.sort(before)[3])
    down = chains_of(energy, starts, floor=floor, moves=200)
    assert (down.energies <= before).all()
    assert (down.energies <= floor).mean() > 0.7
    np.testing.assert_array_equal(down.poses[before <= floor], starts.numbers[before <= floor])
    assert chains_of(energy, starts, floor=0.0, moves=200).energies.mean() < floor
    kept = chains_of(energy, starts, floor=-100.0, moves=20, kept=2)
    assert np.isinf(kept.kept_energies).all()


NOISE = noise_model(0.0005)
CENTRE = object_centre(BOX_GRID)
TWISTS = twists_of(SE3Space(), CENTRE)
X, Y, Z = 0.5 * BOX_SIDES
FOREIGN = apply(TRUTH, np.array([[0.0, 0.0, Z + 0.03]]))
HEIGHTS = np.linspace(-0.002, 0.006, 24)
FREE = np.array([[X - 0.004, 0.02, 0.01], [X - 0.003, -0.02, 0.01], [X - 0.006, 0.0, -0.01]])
OCCUPIED = np.array([[0.02, 0.01, -Z - 0.003], [-0.02, 0.01, -Z - 0.004]])
AT_ODDS = KnownPoints(
    free=apply(TRUTH, np.concatenate([FREE, [[0.03, Y - 0.004, 0.01], [0.04, Y - 0.015, -0.01]]])),
    occupied=apply(TRUTH, OCCUPIED),
    known=np.concatenate(
        [
            apply(TRUTH, on_faces(24, HEIGHTS + 0.001 * np.random.default_rng(1).normal(size=24))),
            FOREIGN,
        ]
    ),
    known_sdf=[*HEIGHTS, 0.0],
)
"""Known points off by 1 mm, one on another object, and free and occupied voxels that are wrong."""


MANY_AT_ODDS = KnownPoints(
    free=AT_ODDS.free,
    occupied=AT_ODDS.occupied,
    known=np.concatenate([AT_ODDS.known[:24]] * 3 + [AT_ODDS.known[24:]])
    + 0.001 * np.random.default_rng(2).normal(size=(73, 3)),
    known_sdf=[*HEIGHTS, *HEIGHTS, *HEIGHTS, 0.0],
)
"""The same with 73 known points, of which the energy counts 30."""


def with_normals(points, *, noise=0.2):
    """The points with normals of the box at TRUTH, off by their noise; one of them is flipped.

    Points near an edge have none, as fits leave out how gradients turn there.
    """
    gradients = BOX_GRID.at(apply(inverse(TRUTH), points.known), lookup="trilinear")[1]
    flat = np.linalg.norm(gradients, axis=1) > 0.97
    off = 0.5**0.5 * noise * np.random.default_rng(3).normal(size=gradients.shape)
    normals = (gradients + off) @ TRUTH[:3, :3].T
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[4] *= -1.0
    normals[~flat] = 0.0
    return replace(points, normals=normals, normal_noise=np.where(flat, noise, 0.0))


DISAGREEING = {
    "25": AT_ODDS,
    "73": MANY_AT_ODDS,
    "25 normals": with_normals(AT_ODDS),
    "73 normals": with_normals(MANY_AT_ODDS),
}


def off_truth(poses):
    """Metres and radians (B,)."""
    off = Poses.of(poses.matrices @ TRUTH)
    return np.sqrt((off.translations**2).sum(axis=1)), rotation_angle(off.rotations)


@pytest.mark.parametrize("points", DISAGREEING.values(), ids=DISAGREEING)
def test_a_fit_ends_where_no_motion_lowers_the_plain_formula(points):
    """Points of all classes disagree there, so that each must have its weight and its sign."""
    poses = poses_around_truth(6, 0.01, turn=0.1)
    found = fitted(energy_of(points, NOISE), TWISTS, poses=poses, steps=60)
    before = plain_energies(NOISE, BOX_GRID, points=points, poses=poses)
    after = plain_energies(NOISE, BOX_GRID, points=points, poses=found)
    assert (after < before - 10.0).all()

    def moved(twist):
        angle = np.sqrt((twist[:3] ** 2).sum())
        turn = axis_angle(twist[:3] / max(angle, 1e-9), angle / 0.1)
        pose = Poses.of((compose(turn, twist[3:]) @ found.matrices[0])[None])
        return float(plain_energies(NOISE, BOX_GRID, points=points, poses=pose)[0])

    options = {"xtol": 1e-5, "ftol": 1e-6, "direc": 1e-3 * np.eye(6)}
    least = minimize(moved, np.zeros(6), method="Powell", options=options)
    assert least.nfev > 60
    assert after[0] - least.fun < 0.01
    known = BOX_GRID.at(apply(found.matrices[0], points.known), lookup="trilinear")[0]
    assert np.abs(known - points.sdf)[:-1].max() < 0.006
    assert abs(known[-1] - 0.03) < 0.003  # the foreign contact moves nothing


def test_a_step_that_goes_far_counts_free_points_that_were_not_near_at_first():
    """Contacts draw the box by 36 mm onto free points that were 32 mm in front of it."""
    rough = NoiseModel((0.015,) * LEVELS, (1.0 / LEVELS,) * LEVELS, softness=0.01, wrong=50.0)
    grid = SdfGrid.from_mesh(BOX, 0.004)
    halves = np.array([X, Y, Z])
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces = [signs * np.where(np.arange(3) == axis, 1.0, 0.4) * halves for axis in range(3)]
    across = np.random.default_rng(0).uniform(-0.8, 0.8, (300, 2)) * [Y, Z]
    free = np.column_stack([np.full(300, X - 0.004), across])
    points = KnownPoints(known=apply(TRUTH, np.concatenate(faces)), free=apply(TRUTH, free))
    start = poses_of(turned(0.0, -0.036))
    energy = Energy(
        replace(box_problem(points), sdf=grid), most_informative_first(points), noise=rough
    )
    before, there = (
        plain_energies(rough, grid, points=points, poses=p)[0] for p in (start, poses_of(TRUTH))
    )
    assert there > before + 2.0
    for steps in (1, 2, 4, 8, 30):
        found = fitted(energy, TWISTS, poses=start, steps=steps)
        assert plain_energies(rough, grid, points=points, poses=found)[0] <= before
    shift = inverse(found.matrices)[0, :3, 3] - inverse(start.matrices)[0, :3, 3]
    assert np.sqrt((shift**2).sum()) == pytest.approx(0.032, abs=0.001)  # up to the free points


def test_fits_by_rough_then_exact_noise_come_from_afar():
    rough = NoiseModel((0.015,) * LEVELS, (1.0 / LEVELS,) * LEVELS, softness=0.01, wrong=50.0)
    points = KnownPoints(known=np.concatenate([apply(TRUTH, on_faces(24)), FOREIGN]))
    energy = energy_of(points, NOISE)
    poses = poses_around_truth(40, 0.03, turn=0.3)
    shift, turn = off_truth(
        fitted(
            energy, TWISTS, poses=fitted(energy.by(rough), TWISTS, poses=poses, steps=20), steps=30
        )
    )
    arrived = (shift < 0.001) & (turn < 0.01)
    assert arrived.mean() > 0.8
    assert (np.array(off_truth(poses)) > [[0.029], [0.29]]).all()


def test_no_fit_raises_an_energy_and_none_of_no_steps_moves():
    energy = energy_of(AT_ODDS, NOISE)
    poses = poses_around_truth(40, 0.1, turn=1.5)
    assert (energy.of(fitted(energy, TWISTS, poses=poses, steps=4)) <= energy.of(poses)).all()
    np.testing.assert_array_equal(
        fitted(energy, TWISTS, poses=poses, steps=0).numbers, poses.numbers
    )


def test_on_a_plane_fits_stay_on_it_and_come_to_where_the_object_stands():
    space = search_space(PLANE, BOX_GRID)
    off = np.array([[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [-0.01, 0.01, 0.0]])
    turned_by = axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.1)) @ STANDING[:3, :3]
    starts = compose(np.tile(turned_by, (3, 1, 1)), STANDING[:3, 3] + off)
    energy = energy_of(KnownPoints(known=apply(STANDING, on_faces(24))), NOISE)
    found = fitted(energy, twists_of(space, CENTRE), poses=Poses.of(inverse(starts)), steps=30)
    there = np.tile(STANDING, (3, 1, 1))
    np.testing.assert_allclose(inverse(found.matrices), there, atol=1e-3)
    again = space.poses(space.encode(found))
    np.testing.assert_allclose(again.numbers, found.numbers, atol=1e-9)


def test_a_step_of_a_fit_is_at_most_80_mm_and_half_a_radian():
    """About the centre; by Cayley, a turn of twice the arctangent of a quarter."""
    rough = NoiseModel((0.3,) * LEVELS, (1.0 / LEVELS,) * LEVELS)
    energy = energy_of(KnownPoints(known=apply(TRUTH, on_faces(24))), rough)
    far = poses_of(turned(0.0, 0.25), turned(1.4))
    steps = fitted(energy, TWISTS, poses=far, steps=1).matrices @ inverse(far.matrices)
    shift = apply(steps[0], CENTRE[None])[0] - CENTRE
    assert np.sqrt((shift**2).sum()) == pytest.approx(0.08)
    assert rotation_angle(steps[1:, :3, :3])[0] == pytest.approx(2.0 * math.atan(0.25))


@pytest.mark.parametrize("known_points", DISAGREEING.values(), ids=DISAGREEING)
def test_a_step_of_a_fit_is_that_of_levenberg_and_marquardt(known_points):
    """By the normal equations in numpy, of turns by 1 rad and shifts by 0.15 m about a point."""
    sigma = 0.3
    softness = 0.2
    pivot = np.array([0.03, -0.05, 0.02])
    wide = NoiseModel((sigma,) * LEVELS, (1.0 / LEVELS,) * LEVELS, softness=softness)
    poses = poses_around_truth(5, 0.005, turn=0.05)
    found = fitted(
        energy_of(known_points, wide), twists_of(SE3Space(), pivot), poses=poses, steps=1
    )
    points = np.concatenate([known_points.known, known_points.free, known_points.occupied])
    known, free = len(known_points.known), len(known_points.free)
    for before, after in zip(poses.matrices, found.matrices, strict=True):
        places = apply(before, points)
        residuals, normals = BOX_GRID.at(places, lookup="trilinear")
        residuals[:known] -= known_points.sdf
        bell = np.exp(-0.5 * (residuals / sigma) ** 2) / (math.sqrt(2.0 * math.pi) * sigma)
        lengths = np.linalg.norm(normals[:known], axis=1)
        faces = normals[:known] / lengths[:, None]
        measured = known_points.normals @ before[:3, :3].T
        b = 0.5 / (0.5 * known_points.normal_noise**2 + FACET**2 + 1.0 - lengths)
        off = 1.0 + b * (1.0 - (measured * faces).sum(axis=1))
        likely = (1.0 - WRONG_NORMALS) * (1.0 + 2.0 * b) ** 2 / ((1.0 + b) * off**3)
        has = known_points.normal_noise > 0.0
        bell[:known] *= np.where(has, likely + WRONG_NORMALS, 1.0)
        own = (1.0 - SHARE) * bell / ((1.0 - SHARE) * bell + SHARE / EXTENT)  # not foreign
        weights = np.where(np.arange(len(points)) < known, own / sigma**2, 1.0 / softness**2)
        weights[known : known + free] *= residuals[known : known + free] < 0.0
        weights[known + free :] *= residuals[known + free :] > 0.0
        rates = np.hstack([np.cross(places - pivot, normals) / 0.15, normals])
        normal = rates.T @ (weights[:, None] * rates)
        right = rates.T @ (weights * residuals)
        pulls = own[:known] * has * likely / (likely + WRONG_NORMALS) * 3.0 * b / off
        for m, face, pull in zip(measured, faces, pulls, strict=True):  # pull (1 - m . g)
            normal[:3, :3] += pull * (np.eye(3) - np.outer(m, m)) / 0.15**2
            right[:3] -= pull * np.cross(m, face) / 0.15
        step = -np.linalg.solve(normal + 0.01 * np.trace(normal) / 6.0 * np.eye(6), right)
        turn, shift = step[:3] / 0.15, step[3:]
        half = math.sqrt(turn @ turn) / 2.0
        turning = axis_angle(turn / (2.0 * half), np.array(2.0 * math.atan(half)))
        moved = compose(turning, pivot + shift - turning @ pivot) @ before
        np.testing.assert_allclose(after, moved, atol=1e-4)  # tables of slopes
        assert np.abs(after - before).max() > 0.01


def test_moves_turn_about_a_contact_or_the_centre_and_shift():
    """By normal sizes times 10^U(-0.9, 0.3); 6 rad go with a metre, 3 of 5 turn about a contact."""
    contacts = np.array([[0.1, 0.0, 0.0], [-0.1, 0.05, 0.0], [0.0, 0.0, 0.3]])
    flat = NoiseModel((1e3,) * LEVELS, (1.0 / LEVELS,) * LEVELS)
    energy = energy_of(KnownPoints(known=apply(TRUTH, contacts)), flat)
    count = 40_000
    space = SE3Space()
    middle = TRUTH[:3, 3]
    stride = stride_of(space, CENTRE, bounds=(middle - 9.0, middle + 9.0))
    starts = repeated(TRUTH, count)
    stream = StreamKey(5, 2).kernel_stream(Purpose.WALKS, 3)
    chains = walked(
        energy,
        stride,
        poses=starts,
        energies=energy.of(starts),
        floor=np.inf,
        moves=1,
        stream=stream,
        kept=1,
    )
    moves = Poses(chains.poses).matrices @ TRUTH
    turns = moves[:, :3, :3]
    skew = (turns - np.swapaxes(turns, 1, 2)) / (1.0 + np.trace(turns, axis1=1, axis2=2))[
        :, None, None
    ]
    vectors = 2.0 * skew[:, [2, 0, 1], [1, 2, 0]]  # of Cayley
    variance = 0.01**2 * (10**0.6 - 10**-1.8) / (2.4 * math.log(10.0))
    np.testing.assert_allclose(
        vectors.mean(axis=0), 0.0, atol=4.0 * 6.0 * (variance / count) ** 0.5
    )
    covariance = vectors.T @ vectors / count
    np.testing.assert_allclose(covariance / (36.0 * variance), np.eye(3), atol=0.04)
    angles = rotation_angle(turns)
    axes = vectors / np.sqrt((vectors**2).sum(axis=1, keepdims=True))
    pivots = np.concatenate([contacts, CENTRE[None]])
    chances = np.array([0.2, 0.2, 0.2, 0.4])
    for point in pivots:
        levers = point - pivots
        across = (levers**2).sum(axis=1) - (axes @ levers.T) ** 2
        expected = 3.0 * variance + ((4.0 * np.sin(0.5 * angles) ** 2) * (across @ chances)).mean()
        moved = ((apply(moves, point[None])[:, 0] - point) ** 2).sum(axis=1).mean()
        assert moved == pytest.approx(expected, rel=0.04)
