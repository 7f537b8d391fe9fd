"""Meshes are merged and checked at the border."""

import warnings

import numpy as np
import pytest
import trimesh

from chsel.errors import MeshError, MeshWarning, SettingError
from chsel.problem.mesh import check_bodies, clean_mesh, load_mesh, mesh_digest

EXTENTS = (0.1, 0.2, 0.3)


@pytest.fixture
def box():
    return trimesh.creation.box(EXTENTS)


@pytest.fixture(autouse=True)
def _warnings_are_errors():
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        yield


@pytest.mark.parametrize("file_name", ["box.ply", "box.stl", "BOX.STL", "box.off", "box.obj"])
def test_a_box_comes_back_closed_with_eight_vertices_whatever_the_format(box, tmp_path, file_name):
    path = tmp_path / file_name
    box.export(path, file_type=path.suffix.lower()[1:])
    mesh = load_mesh(path, scale=2.0)
    assert len(mesh.vertices) == 8
    assert len(mesh.faces) == 12
    assert mesh.is_watertight
    assert mesh.vertices.dtype == np.float64
    assert mesh.extents == pytest.approx([0.2, 0.4, 0.6], rel=1e-6)
    assert mesh.volume == pytest.approx(8 * 0.006, rel=1e-6)


def test_a_scene_becomes_one_mesh_with_its_parts_in_place(box, tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(box)
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([0.25, 0, 0]))
    scene.export(tmp_path / "scene.glb")
    mesh = load_mesh(tmp_path / "scene.glb")
    assert mesh.is_watertight
    assert mesh.extents == pytest.approx([0.35, 0.2, 0.3], rel=1e-6)
    assert mesh.volume == pytest.approx(0.012, rel=1e-6)


def moved(mesh, *offset):
    return mesh.copy().apply_translation(offset)


def test_bodies_far_apart_are_kept_with_a_warning_that_counts_them(box):
    two = trimesh.util.concatenate([box, moved(box, 0.05, 0.0, 0.0), moved(box, 0.0, 1.0, 0.0)])
    with pytest.warns(MeshWarning, match=r"shelf has 2 bodies at least 0\.8 m apart, .* 0\.374 m"):
        mesh = clean_mesh(two.vertices, two.faces, name="shelf")
    assert len(mesh.faces) == 36
    assert mesh.extents == pytest.approx([0.15, 1.2, 0.3])


def test_parts_near_one_another_are_one_object_however_many(box):
    """A row of parts is longer than what is far apart, and no two neighbours are."""
    row = [moved(box, 0.25 * k, 0.0, 0.0) for k in range(8)]
    crumb = moved(trimesh.creation.box((0.001, 0.001, 0.001)), 0.0, 0.25, 0.0)
    parts = trimesh.util.concatenate([*row, crumb])
    assert len(clean_mesh(parts.vertices, parts.faces).faces) == 9 * 12


def test_real_scans_have_their_parts_together(ycb_directory):
    for file in ycb_directory.glob("*/google_16k/nontextured.ply"):
        mesh = trimesh.load(file, process=True)
        assert check_bodies(mesh, file.parent.name) == []


def test_texture_seams_keep_no_vertices_apart(tmp_path):
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    faces = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"vt 0.{k} 0.5" for k in range(9)]
    for i, face in enumerate(faces):  # every face has texture coordinates of its own
        lines.append("f " + " ".join(f"{c + 1}/{i + j + 1}" for j, c in enumerate(face)))
    (tmp_path / "seams.obj").write_text("\n".join(lines))
    mesh = load_mesh(tmp_path / "seams.obj")
    assert len(mesh.vertices) == 4
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(1 / 6)


def test_faces_that_merging_collapses_are_dropped(box):
    vertices = np.vstack([box.vertices, box.vertices[:1]])
    faces = np.vstack([box.faces, [[0, 8, 1]]])
    mesh = clean_mesh(vertices, faces)
    assert len(mesh.faces) == 12
    assert mesh.is_watertight


@pytest.mark.parametrize("flipped", [slice(None), [0], [2, 5, 6], [0, 1, 3, 7, 8, 9, 10]])
def test_faces_are_turned_outward(box, flipped):
    faces = box.faces.copy()
    faces[flipped] = faces[flipped][:, ::-1]
    mesh = clean_mesh(box.vertices, faces)
    assert mesh.volume == pytest.approx(0.006)
    assert ((mesh.face_normals * mesh.triangles_center).sum(axis=1) > 0).all()


def test_an_open_mesh_is_kept_with_a_warning_that_names_it(box, tmp_path):
    box.update_faces(np.arange(12) > 0)
    box.export(tmp_path / "open.off")
    with pytest.warns(UserWarning, match=r"open\.off is open .* winding number"):
        mesh = load_mesh(tmp_path / "open.off")
    assert len(mesh.faces) == 11
    assert not mesh.is_watertight


def test_a_mesh_of_many_faces_is_kept_with_a_warning_that_names_its_size(box, monkeypatch):
    monkeypatch.setattr("chsel.problem.mesh.MANY_FACES", 12)
    clean_mesh(box.vertices, box.faces)
    finer = box.subdivide().subdivide()
    message = r"^bowl has 192 faces: .* signed distance grid .*; a decimated mesh of 50,000 faces"
    with pytest.warns(UserWarning, match=message):
        mesh = clean_mesh(finer.vertices, finer.faces, name="bowl")
    assert len(mesh.faces) == 192


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MeshError, match=r"nowhere\.obj does not exist; accepted: .*\.obj.*\.stl"):
        load_mesh(tmp_path / "nowhere.obj")
    with pytest.raises(MeshError, match="is a folder"):
        load_mesh(tmp_path)


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "off", "glb"])
def test_a_damaged_file_of_any_kind_is_named(tmp_path, suffix):
    path = tmp_path / f"noise.{suffix}"
    path.write_bytes(np.random.default_rng(0).bytes(1000))
    with pytest.raises(MeshError, match=rf"noise\.{suffix} (cannot be read|has no faces)"):
        load_mesh(path)


def test_files_without_faces_are_no_mesh(tmp_path):
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "cloud.ply")
    (tmp_path / "empty.stl").touch()
    for name in ("cloud.ply", "empty.stl"):
        with pytest.raises(MeshError, match=rf"{name} has no faces"):
            load_mesh(tmp_path / name)


BOX = trimesh.creation.box(EXTENTS)
BROKEN = BOX.vertices.copy()
BROKEN[3, 1] = np.nan


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (BROKEN, BOX.faces, r"^bowl: vertices\[3\] is not finite"),
        (BOX.vertices, BOX.faces - 1, r"faces\[0\] is \[.*\]; accepted: indices of its 8 vert"),
        (BOX.vertices, BOX.faces + 1, r"faces\[\d\] is \[.*\]; accepted: indices of its 8 vert"),
        (BOX.vertices, np.zeros((4, 4), dtype=int), r"faces has shape .*; accepted: \(any, 3\)"),
        (BOX.vertices, np.zeros(12, dtype=int), r"faces has shape .*; accepted: \(any, 3\)"),
        ([[0, 0, 0], [1, 1, 1]], [[0, 0, 1], [1, 0, 1]], "no face with an area"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], "1 x 1 x 0 m: flat"),
    ],
)
def test_a_mesh_that_cannot_be_is_named(vertices, faces, message):
    with pytest.raises(MeshError, match=message):
        clean_mesh(vertices, faces, name="bowl")


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_a_scale_that_is_not_positive_is_refused(scale):
    with pytest.raises(SettingError, match="mesh scale"):
        clean_mesh(BOX.vertices, BOX.faces, scale=scale)


def test_millimetres_are_suspected_and_scaled_away(box):
    with pytest.raises(MeshError, match=r"100 x 200 x 300 m; looks like millimetres.*scale=0\.001"):
        clean_mesh(box.vertices * 1000, box.faces)
    assert clean_mesh(box.vertices * 1000, box.faces, scale=0.001).extents == pytest.approx(EXTENTS)


def test_sizes_up_to_the_bounds_are_accepted(box):
    longest = box.extents.max()
    for accepted, refused in [(9.99, 10.01), (0.00501, 0.00499)]:
        mesh = clean_mesh(box.vertices, box.faces, scale=accepted / longest)
        assert mesh.extents.max() == pytest.approx(accepted)
        with pytest.raises(MeshError, match=r"largest extent of 0\.005 m to 10 m"):
            clean_mesh(box.vertices, box.faces, scale=refused / longest)


def test_the_digest_names_content(box):
    same = clean_mesh(box.vertices, box.faces)
    moved = same.copy()
    moved.vertices[0, 0] = np.nextafter(moved.vertices[0, 0], 1.0)
    turned = trimesh.Trimesh(same.vertices, same.faces[:, [1, 2, 0]], process=False)
    digests = [mesh_digest(mesh) for mesh in (same, moved, turned)]
    assert digests[0] == mesh_digest(clean_mesh(box.vertices, box.faces))
    assert len(set(digests)) == 3


def test_the_digest_of_a_known_mesh_stays_as_it_is():
    mesh = clean_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], TETRAHEDRON)
    assert mesh_digest(mesh) == "21f7541125fe9ed062f5e3978f17fd86"


TETRAHEDRON = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
