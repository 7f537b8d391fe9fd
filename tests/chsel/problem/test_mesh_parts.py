"""Overlapping, touching, mirrored and hollow parts of a mesh become one solid."""

import warnings

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from chsel.errors import MeshWarning
from chsel.problem.mesh import clean_mesh, mesh_digest
from chsel.problem.sdf_grid import SdfGrid, mesh_sdf
from tests.chsel.samples import box_distance

CUBE = ((0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
BAR = ((0.06, 0.06, 0.2), (0.02, 0.0, 0.06))
CROSS = ((0.05, 0.3, 0.03), (0.02, 0.01, 0.0))
INNER = ((0.06, 0.06, 0.06), (0.0, 0.0, 0.0))


def box(size, position, *, inward=False, divided=0):
    mesh = trimesh.creation.box(size).apply_translation(position)
    for _ in range(divided):
        mesh = mesh.subdivide()
    if inward:
        mesh.invert()
    return mesh


def clean(*parts):
    """The clean mesh of parts, and what was said of it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = trimesh.util.concatenate(list(parts))
        mesh = clean_mesh(mesh.vertices, mesh.faces, name="tool")
    return mesh, {w.message.code: str(w.message) for w in caught}


def inside(points, solids, *, cavities):
    def within(boxes):
        of_each = [box_distance(points - np.array(at), np.array(size)) < 0.0 for size, at in boxes]
        return np.any(of_each, axis=0) if boxes else np.zeros(len(points), dtype=bool)

    return within(solids) & ~within(cavities)


def check(mesh, solids, *, cavities=()):
    """Compare with the distance to points on the boundary of boxes without other boxes."""
    surface, normals = [], []
    for size, position in (*solids, *cavities):
        one = box(size, position)
        points, face = trimesh.sample.sample_surface(one, 100_000, seed=0)
        surface.append(points)
        normals.append(one.face_normals[face])
    surface = np.concatenate(surface)
    step = 1e-7 * np.concatenate(normals)
    ends = [inside(surface + side * step, solids, cavities=cavities) for side in (-1.0, 1.0)]
    outer = cKDTree(surface[ends[0] != ends[1]])
    lower = np.min(surface, axis=0) - 0.02
    upper = np.max(surface, axis=0) + 0.02
    points = np.random.default_rng(0).uniform(lower, upper, (3000, 3))
    expected = outer.query(points)[0] * np.where(
        inside(points, solids, cavities=cavities), -1.0, 1.0
    )
    np.testing.assert_allclose(mesh_sdf(mesh, points)[0], expected, atol=5e-3)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent


def beside(x, y, z):
    return CUBE[0], (x, y, z)


@pytest.mark.parametrize("others", [[BAR], [BAR, CROSS]])
@pytest.mark.parametrize("turned", [None, 0, 1])
def test_overlapping_parts_are_one_solid_also_if_one_of_them_is_mirrored(others, turned):
    boxes = [((0.2, 0.08, 0.08), (0.0, 0.0, 0.0)), *others]
    mesh, said = clean(*(box(*b, inward=turned == i) for i, b in enumerate(boxes)))
    check(mesh, boxes)
    if turned is None:
        assert said == {}
    else:
        size = " x ".join(f"{side:g}" for side in boxes[turned][0])
        assert list(said) == ["inward_part"]
        assert f"a part of tool, the one of {size} m around (" in said["inward_part"]


def test_overlapping_parts_have_the_volume_of_their_union_and_exact_distances():
    mesh, _ = clean(box((0.2, 0.08, 0.08), (0.0, 0.0, 0.0)), box(*BAR))
    assert mesh.volume == pytest.approx(0.2 * 0.08**2 + 0.06**2 * (0.2 - 0.08), rel=1e-4)
    points = [[0.02, 0.0, 0.0], [-0.08, 0.0, 0.0], [0.02, 0.0, 0.14], [0.2, 0.0, 0.0]]
    distance = mesh_sdf(mesh, np.array(points))[0]
    np.testing.assert_allclose(distance, [-0.04, -0.02, -0.02, 0.1], atol=2e-6)


@pytest.mark.parametrize(
    "other",
    [
        beside(0.1, 0.0, 0.0),  # at a face
        beside(0.1, 0.1, 0.0),  # at an edge
        beside(0.1, 0.1, 0.1),  # at a corner
        beside(0.1, 0.03, 0.02),  # at a part of a face
        ((0.04, 0.04, 0.04), (0.07, 0.0, 0.0)),  # at a part of a face, inside of it
        ((0.3, 0.3, 0.3), (0.2, 0.0, 0.0)),  # whose sides are a rounding error apart
    ],
)
@pytest.mark.parametrize("inward", [False, True])
@pytest.mark.parametrize("divided", [0, 2])
def test_parts_that_touch_are_closed_and_have_no_surface_between_them(other, inward, divided):
    parts = box(*CUBE, divided=divided), box(*other, inward=inward, divided=divided)
    mesh, said = clean(*parts)
    check(mesh, [CUBE, other])
    assert set(said) <= {"inward_part"}
    mixed = trimesh.util.concatenate(parts)
    order = np.random.default_rng(1).permutation(len(mixed.faces))
    check(clean(trimesh.Trimesh(mixed.vertices, mixed.faces[order]))[0], [CUBE, other])


def test_sides_of_other_triangles_are_no_surface_between_parts_either():
    other = box(*beside(0.0, 0.0, 0.0), divided=1).apply_transform(
        trimesh.transformations.rotation_matrix(np.pi / 2.0, (1.0, 0.0, 0.0))
    )
    mesh, said = clean(box(*CUBE), other.apply_translation((0.1, 0.0, 0.0)))
    check(mesh, [CUBE, beside(0.1, 0.0, 0.0)])
    assert said == {}


def test_faces_and_parts_that_come_twice_count_once():
    cube = box(*CUBE)
    for parts in (
        (cube, cube),
        (cube, box(*CUBE, inward=True)),
        (cube, cube, cube),
        (cube, trimesh.Trimesh(cube.vertices, cube.faces[2:7], process=False)),
        (cube, trimesh.Trimesh(cube.vertices, cube.faces[2:7, ::-1], process=False)),
    ):
        mesh, said = clean(*parts)
        check(mesh, [CUBE])
        assert (len(mesh.faces), said) == (12, {})


@pytest.mark.parametrize("inward", [False, True])
def test_cavities_are_inside_of_material_and_look_inward(inward):
    """Also where all is mirrored; a part that looks outward there is swallowed."""
    hollow = box(*CUBE, inward=inward), box(*INNER, inward=not inward)
    mesh, said = clean(*hollow)
    check(mesh, [CUBE], cavities=[INNER])
    assert said == {}
    handle = (0.1, 0.02, 0.02), (0.09, 0.0, 0.0)
    mesh, _ = clean(*hollow, box(*handle, inward=inward))
    check(mesh, [CUBE, handle], cavities=[INNER])
    mesh, said = clean(box(*CUBE, inward=inward), box(*INNER, inward=inward))
    check(mesh, [CUBE])
    assert said == {}
    mesh, _ = clean(*hollow, box((0.02, 0.02, 0.02), (0.0, 0.0, 0.0), inward=inward))
    assert mesh.volume == pytest.approx(0.1**3 - 0.06**3 + 0.02**3)


def test_a_mirrored_part_is_turned_with_its_cavity_and_one_that_touches_is_no_cavity():
    far = (0.3, 0.3, 0.3), (0.3, 0.0, 0.0)
    mesh, said = clean(box(*CUBE, inward=True), box(*INNER), box(*far))
    check(mesh, [CUBE, far], cavities=[INNER])
    assert "a part of tool, the one of 0.1 x 0.1 x 0.1 m around (0, 0, 0) m" in said["inward_part"]
    mesh, said = clean(box(*CUBE), box((0.06, 0.06, 0.06), (0.02, 0.0, 0.0), inward=True))
    check(mesh, [CUBE])
    assert list(said) == ["inward_part"]


def test_sheets_inside_of_a_solid_are_no_surface():
    corners = np.array([(0.0, y, z) for y, z in [(-1, -1), (1, -1), (1, 1), (-1, 1)]]) * 0.05
    for size in (1.0, 0.9):  # at its sides or not
        sheet = trimesh.Trimesh(size * corners, [[0, 1, 2], [0, 2, 3]], process=False)
        mesh, said = clean(box(*CUBE), sheet)
        check(mesh, [CUBE])
        assert said == {}


def opened():
    mesh = box(*CUBE, divided=3)
    mesh.update_faces(mesh.face_normals[:, 2] > -0.5)
    return mesh


def test_an_open_mesh_has_distances_to_its_surface_and_is_turned_if_it_looks_inward():
    points = np.array([[0.0, 0.0, 0.04], [0.045, 0.0, -0.03], [0.07, 0.0, 0.0], [0.0, 0.0, -0.2]])
    expected = [-0.01, -0.005, 0.02, np.sqrt(0.15**2 + 0.05**2)]  # the last one from the rim
    scan = opened()
    mesh, said = clean(scan)
    assert list(said) == ["open_mesh"]
    np.testing.assert_allclose(mesh_sdf(mesh, points)[0], expected, atol=1e-9)
    scan.invert()
    turned, said = clean(scan)
    assert list(said) == ["inward_mesh", "open_mesh"]
    assert said["inward_mesh"] == "the faces of tool looked inward and were turned outward"
    np.testing.assert_allclose(mesh_sdf(turned, points)[0], expected, atol=1e-9)


def test_faces_of_a_closed_part_inside_of_an_open_one_are_no_surface():
    mesh, said = clean(opened(), box((0.02, 0.02, 0.02), (0.0, 0.0, 0.02)))
    assert list(said) == ["open_mesh"]
    distance = mesh_sdf(mesh, np.array([[0.0, 0.0, 0.02], [0.011, 0.0, 0.02]]))[0]
    np.testing.assert_allclose(distance, [-0.03, -0.03], atol=1e-9)


def test_a_moebius_strip_is_named():
    count = 60
    angle = np.repeat(np.linspace(0.0, 2.0 * np.pi, count, endpoint=False), 2)
    across = np.tile([-0.02, 0.02], count)
    radius = 0.05 + across * np.cos(angle / 2.0)
    vertices = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), across * np.sin(angle / 2.0)], axis=1
    )
    faces = []
    for i in range(count):
        a, b = 2 * i, 2 * i + 1
        c, d = (2 * i + 2, 2 * i + 3) if i < count - 1 else (1, 0)
        faces += [[a, c, d], [a, d, b]]
    _, said = clean(trimesh.Trimesh(vertices, faces, process=False))
    assert set(said) == {"one_sided_part", "open_mesh"}
    assert "like a Moebius strip: the one of" in said["one_sided_part"]


def test_a_part_that_passes_through_itself_is_told_by_its_grid():
    ring = np.linspace(0.0, 4.0 * np.pi, 81, endpoint=False)  # round twice
    centre = np.stack([np.cos(ring), np.sin(ring), 0.3 * np.cos(ring / 2.0)], axis=1) * 0.06
    side = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    outward = np.stack([np.cos(ring), np.sin(ring), np.zeros(81)], axis=1)
    tube = centre[:, None] + 0.03 * (
        np.cos(side)[:, None] * outward[:, None] + np.sin(side)[:, None] * np.array([0.0, 0.0, 1.0])
    )
    i, j = np.indices((81, 12))
    a, b = 12 * i + j, 12 * ((i + 1) % 81) + j
    c, d = 12 * ((i + 1) % 81) + (j + 1) % 12, 12 * i + (j + 1) % 12
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    mesh, said = clean(trimesh.Trimesh(tube.reshape(-1, 3), faces, process=False))
    assert said == {}
    with pytest.warns(MeshWarning, match="faces of the mesh pass through one another"):
        SdfGrid.from_mesh(mesh, 0.005)
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (500, 3))
    nearest = trimesh.proximity.closest_point(mesh, points)[1]
    np.testing.assert_allclose(np.abs(mesh_sdf(mesh, points)[0]), nearest, atol=1e-5)


def test_a_clean_mesh_of_parts_is_clean():
    spheres = [
        trimesh.creation.icosphere(1, 0.02).apply_translation(place)
        for place in np.random.default_rng(0).uniform(-0.05, 0.05, (30, 3))
    ]
    for parts in (spheres, [box(*CUBE), box(*beside(0.1, 0.1, 0.0), inward=True)]):
        mesh, _ = clean(*parts)
        again, said = clean(mesh)
        assert said == {}
        assert again.volume == pytest.approx(mesh.volume, rel=1e-6)
        assert mesh_digest(clean(again)[0]) == mesh_digest(again)
