"""Warnings about normals that are flipped, of results by the search that reads them.

`touched(mesh, count, seed)` are contacts all over a body in any pose with normals at 10 degrees.
"""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import chsel
from chsel.errors import PointsWarning
from chsel.events import Logged
from chsel.problem.points import KnownPoints
from chsel.problem.poses import apply, compose, inverse, random_rotations
from chsel.problem.sdf_grid import object_grid
from replay.mcap.reader import read_recording
from tests.chsel.methods.scene import MESH
from tests.chsel.sharp_objects import box, plate

NOISE = 0.17  # radians


def touched(mesh, count, seed, *, wrong=0):
    """Points, and where the body is (4, 4); the first `wrong` normals have any direction."""
    random = np.random.default_rng(seed)
    world_from_object = compose(random_rotations(random, 1)[0], random.uniform(-0.3, 0.3, 3))
    places, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    off = 0.5**0.5 * NOISE * random.standard_normal((count, 3))
    normals = (mesh.face_normals[faces] + off) @ world_from_object[:3, :3].T
    normals[:wrong] = random.standard_normal((wrong, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    known = apply(world_from_object, np.asarray(places))
    noise = np.full(count, NOISE)
    return KnownPoints(known=known, normals=normals, normal_noise=noise), world_from_object


def flipped(points):
    return replace(points, normals=-points.normals)


def warned(mesh, points, **given):
    """Texts about flipped normals, of a call and of its best pose."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = chsel.register(
            object_grid(mesh, None),
            contacts=points.known,
            free=points.free,
            normals=points.normals,
            normal_noise=points.normal_noise,
            **given,
        )
    codes = [w.message for w in caught if isinstance(w.message, PointsWarning)]
    return [str(w) for w in codes if w.code == "normals_flipped"], found


@pytest.mark.parametrize("mesh", [MESH, box(), plate()], ids=["L", "box", "plate"])
@pytest.mark.parametrize("count", [6, 12, 60])
def test_flipped_normals_are_named_although_the_best_pose_is_drawn_to_them(mesh, count):
    for seed in range(2):
        points, _ = touched(mesh, count, seed)
        (text,), found = warned(mesh, flipped(points))
        inward, of = (int(text.split()[n]) for n in (0, 2))
        assert 0.8 * count <= of <= count  # places that are measured again count once
        assert 0.7 * of <= inward <= of
        assert text.endswith("are they flipped? accepted: unit vectors out of the object")
        texts, right = warned(mesh, points)
        assert texts == []
        assert right.cost[0] < found.cost[0] - 5.0


def test_right_normals_of_which_three_in_ten_are_wrong_are_not_called_flipped():
    for seed in range(4):
        points, _ = touched(MESH, 10, seed, wrong=3)
        assert warned(MESH, points)[0] == []
        assert len(warned(MESH, flipped(points))[0]) == 1


def test_a_thin_plate_touched_on_one_side_fits_either_way():
    """Moved by its 2 mm, it has the contacts on its other side: no warning, and both explained."""
    points, world_from_object = touched(plate(), 60, 0)
    upper = apply(inverse(world_from_object), points.known)[:, 2] > 0.0009
    points = points.with_known(np.flatnonzero(upper)[:8])
    (texts, found), (others, other) = (warned(plate(), each) for each in (points, flipped(points)))
    assert texts == others == []
    assert other.cost[0] == pytest.approx(found.cost[0], abs=2.0)


def test_flipped_normals_are_named_for_methods_that_read_none():
    points, _ = touched(MESH, 12, 0)
    assert len(warned(MESH, flipped(points), method="icp", hypotheses=8)[0]) == 1
    assert warned(MESH, points, method="icp", hypotheses=8)[0] == []


def test_a_session_says_once_that_normals_are_flipped_and_records_it(tmp_path):
    points, _ = touched(MESH, 12, 0)
    with chsel.Session(MESH, record=tmp_path / "a.mcap") as session:
        for part in (slice(0, 8), slice(8, 12)):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                session.add(contacts=points.known[part], normals=-points.normals[part])
                session.register()
            codes = [w.message.code for w in caught if isinstance(w.message, PointsWarning)]
            assert codes.count("normals_flipped") == (part.start == 0)
    events = read_recording(tmp_path / "a.mcap").events()
    texts = [event.text for event in events if isinstance(event, Logged)]
    assert sum("are they flipped?" in text for text in texts) == 1
