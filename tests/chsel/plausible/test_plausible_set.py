"""The plausible set against brute force, and what must hold for any."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.errors import EvaluationError, PoseError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import threads
from chsel.plausible import pose_scan
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_set import (
    load_plausible,
    plausible_path,
    plausible_set,
    rotation_seed,
    save_plausible,
)
from chsel.plausible.plausible_settings import (
    EvaluationCostSettings,
    ModeSearchSettings,
    Offsets,
    PlausibleSettings,
    PoseGridSettings,
    definition_name,
    plausible_settings,
)
from chsel.plausible.pose_scan import grid_around, scan_grid
from chsel.problem.points import KnownPoints
from chsel.problem.poses import apply, compose, inverse, rotation_angle
from chsel.problem.streams import StreamKey
from tests.chsel.plausible.scenes import OBJECTS, ball, box, scene

SMALL = PoseGridSettings(
    Offsets(((-0.06, 0.06, 5),), ((-0.1, 0.0, 2), (0.02, 0.05, 3)), z=((0.0, 0.0, 1),)),
    rotations=30,
    upright=4,
)
MANY = PoseGridSettings(
    Offsets(((-0.06, 0.06, 7),), ((-0.1, 0.0, 3), (0.01, 0.05, 3)), z=((-0.2, 0.3, 6),)),
    rotations=10,
    upright=4,
)


@st.composite
def costs(draw):
    return EvaluationCostSettings(
        draw(st.sampled_from(["means", "sums"])),
        violation=draw(st.sampled_from([1e-3, 0.2, 1e5])),
        tolerance=draw(st.sampled_from([0.0, 0.01, 0.03])),
        occupied=draw(st.booleans()),
        lookup=draw(st.sampled_from(["nearest", "trilinear"])),
        outside=draw(st.sampled_from(["surface_point", "bounding_box"])),
    )


def brute_force(problem, poses, *, by):
    """C (B,) of world_from_object poses (B, 4, 4), term by term as it is defined."""
    points, sdf = problem.points, problem.sdf
    known = []
    free = []
    occupied = []
    for move in inverse(poses):
        s = [
            sdf.at(apply(move, part), lookup=by.lookup, outside=by.outside)[0]
            for part in (points.known, points.free, points.occupied)
        ]
        known.append(np.abs(s[0] - points.sdf).sum())
        free.append((s[1] <= -by.tolerance).sum() * by.violation)
        occupied.append((s[2] >= by.tolerance).sum() * by.violation * by.occupied)
    counts = np.array([[len(points.known)], [len(points.free)], [len(points.occupied)]])
    over = np.maximum(counts, 1) if by.combine == "means" else 1
    total: FloatArray = (np.array([known, free, occupied]) / over).sum(axis=0)
    return total


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(sorted(OBJECTS)),
    by=costs(),
    far=st.sampled_from([0.0, 0.0, 1e4]),
    share=st.floats(0.0, 0.6),
    aligned=st.booleans(),
    value=st.sampled_from([None, 0.0, 0.02]),
)
def test_what_a_scan_finds_is_what_brute_force_finds_to_the_bit(
    seed, kind, by, far, share, aligned, value
):
    """Also where points lie on the borders of cells, if aligned; value: that of all points."""
    stream = np.random.default_rng(seed)
    problem, truth = scene(stream, OBJECTS[kind](stream), far=far)
    if value is not None:
        known_sdf = np.full(len(problem.points.known), value)
        problem = replace(problem, points=replace(problem.points, known_sdf=known_sdf))
    if aligned:
        known = np.rint(problem.points.known / 0.01) * 0.01
        problem = replace(problem, points=replace(problem.points, known=known))
        truth = compose(np.eye(3), np.rint(truth[:3, 3] / 0.01) * 0.01)
    cost = EvaluationCost(problem, by)
    grid = grid_around(truth, MANY, seed=seed)
    poses = grid.poses(np.arange(len(grid)))
    every = cost.evaluate(inverse(poses))
    if far == 0.0 or by.lookup == "trilinear":
        # But at a border of cells or a jump of the cost, where rounding decides.
        some = slice(None, None, 97)
        close = np.isclose(
            every[some], brute_force(problem, poses[some], by=by), rtol=1e-9, atol=1e-9
        )
        assert close.mean() > 0.99
    limit = float(np.quantile(every, share))
    index, found = scan_grid(cost, grid, limit=limit)
    np.testing.assert_array_equal(index, np.flatnonzero(every < limit))
    np.testing.assert_array_equal(found, every[index])
    below = cost.evaluate(inverse(poses), limit=limit)
    np.testing.assert_array_equal(below, np.where(every < limit, every, np.inf))


def touched_box(*, free=True):
    """A box with contacts on five sides, in free space but for itself, or in the unknown."""
    half = np.array([0.06, 0.09, 0.12])
    problem, truth = scene(np.random.default_rng(3), box(half))
    sides = np.array([[1, 0.3, 0], [-1, 0, 0.4], [0.2, 1, 0], [0, -1, 0.5], [0.1, 0.6, 1]])
    contacts = apply(truth, sides * half)
    nodes = np.stack(np.meshgrid(*[np.arange(-0.3, 0.3, 0.03)] * 3), axis=-1).reshape(-1, 3)
    outside = apply(truth, nodes[(np.abs(nodes) > half + 0.005).any(axis=1)])
    points = KnownPoints(free=outside if free else np.zeros((0, 3)), known=contacts)
    return replace(problem, points=points), truth


WIDE = replace(SMALL, rotations=300)
BOX = PlausibleSettings(epsilon=0.01, cost=EvaluationCostSettings(lookup="trilinear"), grid=WIDE)


def test_the_set_holds_the_true_pose_and_nothing_that_costs_more_than_epsilon_above_it():
    problem, truth = touched_box()
    found = plausible_set(problem, truth, settings=BOX)
    np.testing.assert_array_equal(found.truth, truth)
    exact = brute_force(problem, found.world_from_object, by=BOX.cost)
    np.testing.assert_allclose(found.cost, exact, atol=1e-12)
    assert (found.cost < found.true_cost + BOX.epsilon).all()
    assert len(found.cost) == BOX.fill_to
    assert found.local.any()
    assert len(found.index) == (~found.local).sum()  # the true pose itself is on this grid


def test_a_thin_set_is_filled_too():
    problem, truth = touched_box()
    by = replace(BOX, epsilon=0.0005, fill_to=300)
    found = plausible_set(problem, truth, settings=by)
    assert len(found.cost) == by.fill_to
    exact = brute_force(problem, found.world_from_object, by=by.cost)
    assert (exact < found.true_cost + by.epsilon).all()
    assert len(np.unique(found.world_from_object.reshape(-1, 16), axis=0)) == by.fill_to


def test_threads_change_nothing():
    problem, truth = touched_box()
    by = replace(BOX, grid=replace(SMALL, rotations=1000), epsilon=0.03)
    alone = plausible_set(problem, truth, settings=by)
    assert len(alone.index) > 50
    with threads(2):
        assert plausible_set(problem, truth, settings=by).digest == alone.digest


def test_what_the_true_pose_violates_is_allowed_to_others():
    problem, truth = touched_box()
    with_one = np.concatenate([problem.points.free, truth[None, :3, 3]])
    violated = replace(problem, points=replace(problem.points, free=with_one))
    strict = plausible_set(problem, truth, settings=BOX)
    lenient = plausible_set(violated, truth, settings=BOX)
    assert lenient.true_cost == pytest.approx(strict.true_cost + BOX.cost.violation / len(with_one))
    assert len(lenient.index) >= len(strict.index) > 0


def test_more_members_than_are_kept_are_a_random_subset_with_the_true_pose():
    problem, truth = touched_box(free=False)
    by = replace(BOX, epsilon=0.05, members=40)
    found = plausible_set(problem, truth, settings=by)
    assert len(found.index) > 100
    assert len(found.cost) in (39, 40)  # the grid holds the true pose, too
    np.testing.assert_array_equal(found.truth, truth)
    assert plausible_set(problem, truth, settings=by).digest == found.digest
    seeded = replace(problem, key=StreamKey(8, 2))
    assert plausible_set(seeded, truth, settings=by).digest != found.digest


def test_the_rotations_are_the_same_at_every_step_of_a_session():
    problem, truth = touched_box()
    later = replace(problem, key=StreamKey(7, 9))
    found = plausible_set(problem, truth, settings=BOX)
    assert plausible_set(later, truth, settings=BOX).digest == found.digest


def test_too_many_members_are_one_clear_error(monkeypatch):
    monkeypatch.setattr(pose_scan, "MOST_MEMBERS", 10)
    problem, truth = touched_box()
    with pytest.raises(EvaluationError, match="more than 10 poses cost less than"):
        plausible_set(problem, truth, settings=replace(BOX, epsilon=0.05))


@pytest.mark.parametrize("points", ["known", "free", "occupied"])
@pytest.mark.parametrize("definition", ["default", "paper", "reference"])
def test_a_single_point_of_any_class_has_a_set(points, definition):
    problem, truth = touched_box()
    problem = replace(problem, points=KnownPoints(**{points: truth[None, :3, 3]}))
    by = plausible_settings(definition, 0.001)
    by = replace(by, grid=replace(by.grid, offsets=SMALL.offsets, rotations=150))
    found = plausible_set(problem, truth, settings=by)
    assert len(found.cost) >= 1
    assert np.isfinite(found.cost).all()


def test_the_definitions_have_the_grids_that_their_sources_name():
    paper, reference, default = (
        plausible_settings(name, 0.001) for name in ("paper", "reference", "default")
    )
    truth = np.eye(4)
    assert len(grid_around(truth, paper.grid, seed=0)) == 33_750_000
    assert len(grid_around(truth, default.grid, seed=0)) == 3375 * 10_101
    grid = grid_around(truth, reference.grid, seed=5)
    assert len(grid) == 3150 * 10_000
    assert grid.positions.min(axis=0).tolist() == [-0.1, -0.2, 0.0]
    assert grid.positions.max(axis=0).tolist() == [0.3, 0.2, 0.1]
    np.testing.assert_allclose(rotation_angle(grid.rotations[100]), 0.0, atol=1e-9)
    np.testing.assert_allclose(grid.rotations[:100, 2], [[0.0, 0.0, 1.0]] * 100, atol=1e-15)
    extents = grid_around(truth, default.grid, seed=5).positions[[0, -1]]
    np.testing.assert_allclose(extents, [[-0.1, -0.2, 0.0], [0.15, 0.2, 0.1]], atol=1e-15)
    for name, combine, tolerance in (
        ("default", "means", 0.01),
        ("paper", "sums", 0.0),
        ("wide_means", "means", 0.0),
        ("wide_means_10mm", "means", 0.01),
        ("wide_sums", "sums", 0.0),
    ):
        settings = plausible_settings(name, 0.002)
        assert (settings.cost.combine, settings.cost.tolerance) == (combine, tolerance)
        assert definition_name(settings) == name
    problem, _ = touched_box()
    seeded = [replace(problem, key=StreamKey(seed, 0)) for seed in (5, 6)]
    assert len({rotation_seed(each, reference) for each in seeded}) == 1
    assert len({rotation_seed(each, default) for each in seeded}) == 2
    assert (grid_around(truth, reference.grid, seed=6).rotations != grid.rotations).any()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PlausibleSettings(epsilon=0.0), "epsilon is 0.0"),
        (lambda: Offsets(z=((0.0, 0.1, 0),)), "offsets are .15, 15, 0. along x, y and z"),
        (lambda: plausible_settings("mine", 0.001), "'mine'"),
    ],
)
def test_a_setting_that_cannot_be_is_named(make, message):
    with pytest.raises(SettingError, match=message):
        make()


def test_a_true_pose_that_is_not_rigid_is_named():
    problem, truth = touched_box()
    with pytest.raises(PoseError, match="world_from_object"):
        plausible_set(problem, 2.0 * truth, settings=BOX)


SETTINGS = PlausibleSettings(
    epsilon=0.02,
    grid=PoseGridSettings(Offsets(((-0.02, 0.02, 3),), ((0.0, 0.0, 1),), z=((0.0, 0.0, 1),)), 20),
    modes=ModeSearchSettings(starts=5),
)


@pytest.fixture(scope="module")
def made():
    problem, truth = scene(np.random.default_rng(1), ball())
    contact = apply(truth, np.array([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]))
    problem = replace(problem, points=KnownPoints(known=contact))
    return problem, truth, plausible_set(problem, truth, settings=SETTINGS)


def test_a_set_is_read_as_it_was_written_and_named_by_its_points(made, tmp_path):
    problem, truth, found = made
    assert len(found.index) > 3
    assert load_plausible(tmp_path, problem, settings=SETTINGS) is None
    path = save_plausible(tmp_path / "sets", found)
    assert path.name.startswith(problem.points.digest)
    assert path == plausible_path(tmp_path / "sets", problem, settings=SETTINGS)
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    read = load_plausible(path.parent, problem, settings=SETTINGS, world_from_object=truth)
    assert read.digest == found.digest
    assert (read.settings, read.seed) == (SETTINGS, 7)
    assert read.true_cost == found.true_cost
    np.testing.assert_array_equal(read.truth, truth)


def test_other_points_definitions_and_seeds_have_files_of_their_own(made, tmp_path):
    problem, _, found = made
    path = save_plausible(tmp_path, found)
    more = replace(problem, points=problem.points.merged(problem.points))
    others = [
        (more, SETTINGS),
        (replace(problem, sdf=ball(0.09)), SETTINGS),
        (replace(problem, key=StreamKey(8, 2)), SETTINGS),
        (problem, replace(SETTINGS, epsilon=0.021)),
        (problem, replace(SETTINGS, modes=None)),
    ]
    names = {plausible_path(tmp_path, other[0], settings=other[1]).name for other in others}
    assert len(names | {path.name}) == 6
    assert all(load_plausible(tmp_path, other[0], settings=other[1]) is None for other in others)
    later = replace(problem, key=StreamKey(7, 9))
    assert plausible_path(tmp_path, later, settings=SETTINGS) == path


def test_a_set_around_another_true_pose_is_refused(made, tmp_path):
    problem, truth, found = made
    save_plausible(tmp_path, found)
    moved = truth.copy()
    moved[0, 3] += 0.001
    with pytest.raises(EvaluationError, match="or another true pose"):
        load_plausible(tmp_path, problem, settings=SETTINGS, world_from_object=moved)


def test_what_was_changed_after_it_was_written_is_refused(made, tmp_path):
    problem, _, found = made
    path = save_plausible(tmp_path, found)
    with np.load(path) as archive:
        arrays = dict(archive)
    for name, value, message in [
        ("cost", arrays["cost"] * 2.0, "does not hold what was written"),
        ("settings", np.array("["), "damaged or not a plausible set"),
        ("cost", np.array([object()]), "damaged"),
    ]:
        np.savez(path.open("wb"), **{**arrays, name: value})
        with pytest.raises(EvaluationError, match=message):
            load_plausible(tmp_path, problem, settings=SETTINGS)


def test_a_folder_that_cannot_be_written_is_named(made, tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(EvaluationError, match="cannot be written"):
        save_plausible(tmp_path / "file", made[2])
