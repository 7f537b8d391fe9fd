"""Known points, and those that cannot be, or hardly are, those of an object."""

import pickle

import numpy as np
import pytest
import torch
import trimesh

from chsel.errors import PointsError
from chsel.problem.points import (
    FreeVoxels,
    KnownPoints,
    Lattice,
    Workspace,
    check_contacts,
    check_points,
    distinct_points,
    first_at_place,
    same_place,
    unit_normals,
)


def test_points_are_copied_and_can_not_be_changed():
    mine = np.zeros((2, 3))
    points = KnownPoints(free=mine)
    mine += 1.0
    assert (points.free == 0.0).all()
    with pytest.raises(ValueError, match="read-only"):
        points.free[0] = 1.0


def test_tensors_are_taken():
    points = KnownPoints(known=torch.tensor([[1, 2, 3]]))
    assert points.known.dtype == np.float64
    np.testing.assert_array_equal(points.known, [[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(points.sdf, [0.0])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"free": np.zeros((2, 2))}, r"free has shape \(2, 2\); accepted: \(any, 3\)"),
        ({"occupied": [[0, 0, np.inf]]}, r"occupied\[0\] is not finite"),
        ({"known": [["a", 0, 0]]}, "known is not an array of numbers"),
        ({"known": np.zeros((2, 3)), "known_sdf": [0.0]}, "known_sdf has 1 entries"),
    ],
)
def test_malformed_points_are_named(arrays, message):
    with pytest.raises(PointsError, match=message):
        KnownPoints(**arrays)


def test_normals_that_are_unit_keep_their_bits_and_others_become_unit():
    """So that those of a recording are the same after they were exported and read."""
    random = np.random.default_rng(0)
    given = random.normal(size=(200, 3))
    once, _ = unit_normals(
        "n", given / np.linalg.norm(given, axis=1)[:, None], noise=0.1, count=200
    )
    again, noise = unit_normals("n", once, noise=None, count=200)
    np.testing.assert_array_equal(again, once)
    np.testing.assert_array_equal(noise, 0.25)
    longer, _ = unit_normals("n", 1.009 * once, noise=0.1, count=200)
    np.testing.assert_allclose(longer, once, atol=1e-15)
    KnownPoints(known=given, normals=longer, normal_noise=noise)


def test_the_sign_of_zero_is_not_part_of_a_digest():
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    digests = {
        KnownPoints(known=np.eye(3)[:2], normals=given, normal_noise=[0.1, 0.0]).digest
        for given in (normals, np.where(normals == 0.0, -0.0, normals))
    }
    assert len(digests) == 1


def test_noise_counts_where_there_is_a_normal():
    _, noise = unit_normals("n", [[0, 0, 1], [0, 0, 0]], noise=[0.2, 0.0], count=2)
    np.testing.assert_array_equal(noise, [0.2, 0.0])
    _, noise = unit_normals("n", [[0, 0, 1], [0, 0, 0]], noise=0.3, count=2)
    np.testing.assert_array_equal(noise, [0.3, 0.0])
    for wrong, message in (([0.0, 0.1], "is 0; accepted"), ([0.1, 9.0], "is 9; in degrees")):
        with pytest.raises(PointsError, match=message):
            unit_normals("n", [[0, 0, 1], [0, 0, 0]], noise=wrong, count=2)
    with pytest.raises(PointsError, match=r"n\[0\] is 0 long; accepted: unit vectors"):
        unit_normals("n", [[1e-200, 0, 0]], noise=0.1, count=1)


def test_points_without_a_name_and_a_workspace_of_one_corner_are_refused():
    with pytest.raises(PointsError, match=r"no name; accepted: KnownPoints\(free=..., known=...\)"):
        KnownPoints(np.zeros((2, 3)))
    for corners in ([[0, 1], [0, 1], [0, 1]], (0, 0, 0)):
        with pytest.raises(PointsError, match=r"accepted: chsel\.Workspace\(lower, upper\)"):
            Workspace(corners)


def test_points_at_a_place_that_was_measured_count_once():
    """Against all pairs, one after the other; also across the borders of any voxels."""
    stream = np.random.default_rng(0)
    for side in (0.005, 0.02, 0.2):
        points, earlier = stream.uniform(0.0, side, (200, 3)), stream.uniform(0.0, side, (5, 3))
        kept = [*earlier]
        expected = []
        for point in points:
            expected.append(min(np.linalg.norm(point - other) for other in kept) > 0.003)
            kept += [point] if expected[-1] else []
        assert first_at_place(points, earlier, apart=0.003).tolist() == expected
        new = KnownPoints(known=points, occupied=points)
        before = KnownPoints(known=earlier)
        distinct, _ = distinct_points(new, before, apart=0.003)
        np.testing.assert_array_equal(distinct.known, points[expected])
        assert len(distinct.occupied) >= len(distinct.known)
    held = np.zeros((100_000, 3))
    held[:3] = [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]
    assert np.flatnonzero(first_at_place(held, held[:0], apart=0.003)).tolist() == [0, 1, 2]


def test_known_points_of_other_distances_are_other_points_and_free_ones_stay():
    points = KnownPoints(free=np.zeros((5, 3)), known=np.zeros((3, 3)), known_sdf=[0.0, 0.02, 0.0])
    distinct, warnings = distinct_points(points, KnownPoints(), apart=0.003)
    assert distinct.sdf.tolist() == [0.0, 0.02]
    assert len(distinct.free) == 5
    (warning,) = warnings
    assert warning.text.startswith("1 of 3 points are within 3 mm of an earlier one; a place")
    scan = KnownPoints(known=np.linspace([0, 0, 0], [0.1, 0, 0], 30))
    close = scan.merged(KnownPoints(known=[[0.0001, 0, 0]]))
    distinct, warnings = distinct_points(close, KnownPoints(), apart=0.003)
    assert (distinct.digest, warnings) == (scan.digest, [])  # so few are no warning
    assert [same_place(size) for size in (1.0, 0.04)] == [0.003, 0.002]


def test_merging_appends_class_by_class_and_changes_the_digest():
    first = KnownPoints(free=[[0, 0, 0]], known=[[1, 1, 1]], known_sdf=[0.1])
    second = KnownPoints(free=[[2, 2, 2]], occupied=[[3, 3, 3]], known=[[4, 4, 4]])
    both = first.merged(second)
    np.testing.assert_array_equal(both.free, [[0, 0, 0], [2, 2, 2]])
    np.testing.assert_array_equal(both.sdf, [0.1, 0.0])
    np.testing.assert_array_equal(both.contacts, [[4, 4, 4]])
    assert both.count == 5
    assert len({first.digest, second.digest, both.digest, second.merged(first).digest}) == 4


def some_points(stream, free, known):
    """Points of all classes, some of the known ones with normals, the zeros of either sign."""
    normals = np.where(stream.random((known, 1)) < 0.5, [[0.0, -0.0, 1.0]], 0.0)
    return KnownPoints(
        free=np.rint(stream.normal(size=(free, 3))) * stream.choice([-1.0, 1.0]),
        occupied=stream.normal(size=(free // 3, 3)),
        known=stream.normal(size=(known, 3)),
        known_sdf=stream.choice([0.0, -0.0, 0.02], known),
        normals=normals,
        normal_noise=np.where(normals.any(axis=1), 0.1, 0.0),
    )


def test_points_that_grow_are_those_of_all_parts_and_earlier_ones_never_change():
    stream = np.random.default_rng(0)
    parts = [some_points(stream, *stream.integers(0, 9, 2)) for _ in range(60)]
    held = [KnownPoints()]
    for part in parts:
        held.append(held[-1].merged(part))
    other = held[20].merged(parts[7])  # of which held[21] must not change
    for count, points in enumerate(held):
        arrays = ("free", "occupied", "known", "known_sdf", "normals", "normal_noise")
        every = KnownPoints(
            **{
                name: np.concatenate(
                    [getattr(part, name) for part in [KnownPoints(), *parts[:count]]]
                )
                for name in arrays
            }
        )
        assert points.digest == every.digest
        assert not points.free.flags.writeable
        if count:
            np.testing.assert_array_equal(points.bounds, every.bounds)
    assert other.digest == KnownPoints.joined([*parts[:20], parts[7]]).digest
    assert pickle.loads(pickle.dumps(held[40])).merged(parts[40]).digest == held[41].digest


def test_points_that_grow_alike_share_their_memory():
    stream = np.random.default_rng(1)
    first, new = some_points(stream, 50, 50), some_points(stream, 5, 5)
    one, other = first.merged(new), first.merged(new)
    assert np.shares_memory(one.free, other.free)
    turned = np.where(new.free == 0.0, -new.free, new.free)  # equal numbers, other bytes
    other = first.merged(KnownPoints(free=turned, known=new.known))
    assert not np.shares_memory(one.free, other.free)
    np.testing.assert_array_equal(one.free, other.free)
    assert np.signbit(one.free).sum() != np.signbit(other.free).sum()


def test_voxels_keep_one_point_each_at_their_centres():
    voxels = FreeVoxels(Lattice((0.1, 0.0, 0.0), 0.025))
    new = voxels.add(np.array([[0.101, 0.0, 0.0], [0.11, 0.001, 0.0], [0.15, -0.03, 0.0]]))
    np.testing.assert_allclose(new, [[0.1, 0.0, 0.0], [0.15, -0.025, 0.0]])
    assert len(voxels.add(np.array([[0.099, 0.0, 0.0], [0.15, -0.02, 0.001]]))) == 0
    assert len(voxels) == 2


def test_workspace_must_have_an_inside():
    with pytest.raises(PointsError, match="lower bound below its upper"):
        Workspace((0, 0, 0), (1, 0, 1))
    around = Workspace.around(np.array([[0.0, 1.0, 2.0], [0.5, 1.0, 2.0]]), 0.1)
    np.testing.assert_allclose(around.bounds, [[-0.1, 0.9, 1.9], [0.6, 1.1, 2.1]])


BOX = trimesh.creation.box((0.2, 0.1, 0.05))
DIAMETER = float(np.linalg.norm(BOX.extents))  # 0.229 m
SIDE = 0.01
SURFACE = trimesh.sample.sample_surface(BOX, 200, seed=0)[0]
ROOM = Workspace((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3))
# The centres of all voxels of the room, the object's place included.
AROUND = np.argwhere(np.ones((61, 61, 61))) * SIDE + ROOM.lower
GOOD = KnownPoints(free=AROUND[(np.abs(AROUND) > BOX.extents / 2).any(axis=1)], known=SURFACE)


def check(codes, workspace=None, **points):
    """The texts of the warnings about points, which have these codes."""
    found = check_points(KnownPoints(**points), DIAMETER, free_resolution=SIDE, workspace=workspace)
    assert [warning.code for warning in found] == codes
    return "\n".join(map(str, found))


def test_all_space_around_an_object_and_points_all_over_it_are_fine():
    check([], ROOM, free=GOOD.free, known=GOOD.known)
    assert check_contacts(GOOD) == []


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_points_in_millimetres_are_an_error(scale):
    """Also contacts that are all on a small part of the object."""
    with pytest.raises(
        PointsError, match=r"span .* m, and the object is 0.229 m: are they in mill"
    ):
        check([], known=1000.0 * scale * SURFACE)
    with pytest.raises(PointsError, match=r"known points span 1\d\d\d m"):
        check([], free=1000.0 * AROUND[::100])


def test_contacts_ten_diameters_apart_are_a_warning():
    check([], known=[[0.0, 0.0, 0.0], [9.9 * DIAMETER, 0.0, 0.0]])
    text = check(["contacts_apart"], known=[[0.0, 0.0, 0.0], [10.1 * DIAMETER, 0.0, 0.0]])
    assert "span 2.31 m, and the object is 0.229 m" in text
    stray = np.concatenate([SURFACE, [[0.0, 500.0, 0.0]]])  # an outlier and no error
    check(["contacts_apart"], known=stray)


def test_contacts_far_from_all_free_points_are_a_warning():
    free = AROUND[:50]
    reach = float(np.linalg.norm(free, axis=1).min())
    away = np.array([[reach + 10.5 * DIAMETER, 0.0, 0.0]])
    text = check(["contacts_far_from_free"], free=free, known=away)
    assert "1 of 1 contacts are more than 10 object diameters from" in text
    check([], free=np.concatenate([free, away + 0.1]), known=away)
    far = np.full((3000, 3), 20.0)
    check([], free=np.concatenate([far[:7], free, far]), known=away - [[1.0, 0.0, 0.0]])
    between = np.array([[-3.0, 0.0, 0.0], [3.0, 0.0, 0.0]])  # two regions
    check(["contacts_far_from_free"], free=between, known=[[0.0, 0.0, 0.0]])


def test_contacts_outside_of_the_workspace_are_counted_and_all_far_away_an_error():
    moved = SURFACE + np.array([0.32, 0.0, 0.0])  # its ends are at 0.22 and 0.42, the room's at 0.3
    count = int((moved[:, 0] > 0.3 + 0.2 * DIAMETER).sum())
    assert 10 < count < 190
    text = check(["contacts_outside"], ROOM, known=moved)
    assert f"{count} of 200 points on the object are outside of the workspace [[-0.3," in text
    check([], known=moved)
    check([], ROOM, known=SURFACE + np.array([0.24, 0.0, 0.0]))  # 4 cm: they are not that exact
    with pytest.raises(PointsError, match=r"the nearest 0.35 m from it; accepted: a workspace"):
        check([], ROOM, known=SURFACE + np.array([0.0, 0.7, 0.0]))


@pytest.mark.parametrize(
    ("free", "known", "count"),
    [
        (AROUND, SURFACE, "200 of 200"),
        (GOOD.free, np.concatenate([SURFACE, [[0.2, 0.2, 0.2]]]), "1 of 201"),
        (np.concatenate([GOOD.free, SURFACE[:7]]), SURFACE, "7 of 200"),  # both at once
    ],
)
def test_contacts_deep_in_free_space_are_a_warning(free, known, count):
    text = check(["contacts_in_free_space"], ROOM, free=free, known=known)
    assert f"{count} contacts are in free space" in text


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_contact_with_any_unknown_voxel_beside_it_is_fine(axis):
    beside = SIDE * np.eye(3)[axis]
    free = AROUND[np.abs(AROUND - beside).max(axis=1) > SIDE / 2]
    assert len(AROUND) - len(free) == 1
    check([], ROOM, free=free, known=[[0.001, 0.001, 0.001]])
    check(["contacts_in_free_space"], ROOM, free=AROUND, known=[[0.001, 0.001, 0.001]])


def test_free_points_alone_say_nothing_about_where_the_object_is():
    (warning,) = check_contacts(KnownPoints(free=AROUND))
    assert warning.code == "no_contact"
    assert check_contacts(KnownPoints(free=AROUND, occupied=[[0.0, 0.0, 0.0]])) == []
    assert check_contacts(KnownPoints(known=[[0.0, 0.0, 0.1]], known_sdf=[0.05])) == []


def test_fine_voxels_over_a_large_space_take_no_memory():
    """Too many voxels to number them are not looked at."""
    points = KnownPoints(free=[[1.0, 0.0, 0.0]], known=[[0.0, 0.0, 0.0], [4.0, 4.0, 4.0]])
    assert check_points(points, 10.0, free_resolution=1e-6) == []
