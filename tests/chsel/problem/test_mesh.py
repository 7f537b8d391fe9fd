import warnings

import numpy as np
import pytest
import trimesh

from chsel.errors import MeshError, MeshWarning, SettingError
from chsel.problem.mesh import check_bodies, clean_mesh, load_mesh

EXTENTS = (0.1, 0.2, 0.3)
BOX = trimesh.creation.box(EXTENTS)


@pytest.fixture(autouse=True)
def _warnings_are_errors():
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        yield


@pytest.mark.parametrize("file_name", ["BOX.STL", "box.obj"])
def test_a_box_comes_back_closed_with_eight_vertices_whatever_the_format(tmp_path, file_name):
    path = tmp_path / file_name
    BOX.export(path, file_type=path.suffix.lower()[1:])
    mesh = load_mesh(path, scale=2.0)
    assert (len(mesh.vertices), len(mesh.faces), mesh.is_watertight) == (8, 12, True)
    assert mesh.vertices.dtype == np.float64
    assert mesh.extents == pytest.approx([0.2, 0.4, 0.6], rel=1e-6)
    assert mesh.volume == pytest.approx(8 * 0.006, rel=1e-6)


def moved(mesh, *offset):
    return mesh.copy().apply_translation(offset)


def test_a_scene_becomes_one_mesh_with_its_parts_in_place(tmp_path):
    trimesh.Scene([BOX, moved(BOX, 0.25, 0.0, 0.0)]).export(tmp_path / "scene.glb")
    mesh = load_mesh(tmp_path / "scene.glb")
    assert mesh.is_watertight
    assert mesh.extents == pytest.approx([0.35, 0.2, 0.3], rel=1e-6)
    assert mesh.volume == pytest.approx(0.012, rel=1e-6)


def test_bodies_far_apart_are_counted_and_parts_near_one_another_one_object_however_many():
    """A row of parts is longer than what is far apart, and no two neighbours are."""
    two = trimesh.util.concatenate([BOX, moved(BOX, 0.05, 0.0, 0.0), moved(BOX, 0.0, 1.0, 0.0)])
    with pytest.warns(MeshWarning, match=r"shelf has 2 bodies at least 0\.8 m apart, .* 0\.391 m"):
        assert clean_mesh(two.vertices, two.faces, name="shelf").volume == pytest.approx(0.015)
    row = [moved(BOX, 0.25 * k, 0.0, 0.0) for k in range(8)]
    crumb = moved(trimesh.creation.box((0.001, 0.001, 0.001)), 0.0, 0.25, 0.0)
    parts = trimesh.util.concatenate([*row, crumb])
    assert len(clean_mesh(parts.vertices, parts.faces).faces) == 9 * 12


def test_real_scans_have_their_parts_together(ycb_directory):
    for file in ycb_directory.glob("*/google_16k/nontextured.ply"):
        assert check_bodies(trimesh.load(file, process=True), file.parent.name) == []


TETRAHEDRON = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]
CORNERS = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]


def test_texture_seams_keep_no_vertices_apart(tmp_path):
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"vt 0.{k} 0.5" for k in range(9)]
    for i, face in enumerate(TETRAHEDRON):  # every face has texture coordinates of its own
        lines.append("f " + " ".join(f"{c + 1}/{i + j + 1}" for j, c in enumerate(face)))
    (tmp_path / "seams.obj").write_text("\n".join(lines))
    mesh = load_mesh(tmp_path / "seams.obj")
    assert (len(mesh.vertices), mesh.is_watertight) == (4, True)
    assert mesh.volume == pytest.approx(1 / 6)


@pytest.mark.parametrize("flipped", [slice(None), [2, 5, 6]])
def test_faces_are_turned_outward_and_those_that_merging_collapses_dropped(flipped):
    faces = BOX.faces.copy()
    faces[flipped] = faces[flipped][:, ::-1]
    mesh = clean_mesh(np.vstack([BOX.vertices, BOX.vertices[:1]]), np.vstack([faces, [[0, 8, 1]]]))
    assert (len(mesh.faces), mesh.is_watertight) == (12, True)
    assert mesh.volume == pytest.approx(0.006)
    assert ((mesh.face_normals * mesh.triangles_center).sum(axis=1) > 0).all()


def test_an_open_mesh_is_kept_with_a_warning_that_names_it(tmp_path):
    trimesh.Trimesh(BOX.vertices, BOX.faces[1:]).export(tmp_path / "open.off")
    with pytest.warns(UserWarning, match=r"open\.off is open .* the sign near holes is inexact"):
        mesh = load_mesh(tmp_path / "open.off")
    assert len(mesh.faces) == 11


def test_files_that_are_no_mesh_are_named(tmp_path):
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "cloud.ply")
    (tmp_path / "noise.obj").write_bytes(np.random.default_rng(0).bytes(1000))
    for name, message in (
        ("nowhere.obj", r"does not exist; accepted: .*\.obj.*\.stl"),
        ("", "is a folder"),
        ("noise.obj", "(cannot be read|has no faces)"),
        ("cloud.ply", "has no faces"),
    ):
        with pytest.raises(MeshError, match=f"{name} {message}"):
            load_mesh(tmp_path / name)


BROKEN = np.where(np.arange(24).reshape(8, 3) == 10, np.nan, BOX.vertices)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (BROKEN, BOX.faces, r"^bowl: vertices\[3\] is not finite"),
        (BOX.vertices, BOX.faces - 1, r"faces\[0\] is \[.*\]; accepted: indices of its 8 vert"),
        (BOX.vertices, BOX.faces + 1, r"faces\[\d\] is \[.*\]; accepted: indices of its 8 vert"),
        (BOX.vertices, np.zeros((4, 4), dtype=int), r"faces has shape .*; accepted: \(any, 3\)"),
        ([[0, 0, 0], [1, 1, 1]], [[0, 0, 1], [1, 0, 1]], "no face with an area"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], "1 x 1 x 0 m: flat"),
    ],
)
def test_a_mesh_that_cannot_be_is_named(vertices, faces, message):
    with pytest.raises(MeshError, match=message):
        clean_mesh(vertices, faces, name="bowl")


def test_sizes_up_to_the_bounds_are_accepted_and_millimetres_suspected():
    for accepted, refused in [(9.99, 10.01), (0.00501, 0.00499)]:
        mesh = clean_mesh(BOX.vertices, BOX.faces, scale=accepted / 0.3)
        assert mesh.extents.max() == pytest.approx(accepted)
        with pytest.raises(MeshError, match=r"largest extent of 0\.005 m to 10 m"):
            clean_mesh(BOX.vertices, BOX.faces, scale=refused / 0.3)
    thousandfold = BOX.vertices * 1000
    with pytest.raises(MeshError, match=r"100 x 200 x 300 m; looks like millimetres.*scale=0\.001"):
        clean_mesh(thousandfold, BOX.faces)
    assert clean_mesh(thousandfold, BOX.faces, scale=0.001).extents == pytest.approx(EXTENTS)
    with pytest.raises(SettingError, match="mesh scale"):
        clean_mesh(BOX.vertices, BOX.faces, scale=0.0)
