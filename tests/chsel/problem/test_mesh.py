"""Meshes of files in all formats: units, parts, orientation, and warnings about them."""

import importlib.util
import warnings
import zipfile
from pathlib import Path

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


@pytest.mark.parametrize(("away", "warned"), [(0.0, False), (0.4, False), (0.8, True)])
def test_a_mesh_far_from_its_frame_is_a_warning(away, warned):
    """A body of 0.15 m: searches bound where the frame's origin is."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.05)).apply_translation((away, 0.0, 0.0))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        clean_mesh(mesh.vertices, mesh.faces, name="part")
    assert [each.message.code for each in caught] == ["far_frame"] * warned
    assert not warned or "part lies 0.8 m from the origin of its frame" in str(caught[0].message)


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
        ("nowhere.obj", r"does not exist; accepted: a mesh in metres, such as \.stl, \.obj"),
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
    with pytest.raises(MeshError, match=r"100 x 200 x 300 m; if .* millimetres, multiply its vert"):
        clean_mesh(thousandfold, BOX.faces)
    assert clean_mesh(thousandfold, BOX.faces, scale=0.001).extents == pytest.approx(EXTENTS)
    with pytest.raises(SettingError, match="mesh scale"):
        clean_mesh(BOX.vertices, BOX.faces, scale=0.0)


def test_for_millimetres_in_a_file_the_error_says_what_to_write(tmp_path):
    trimesh.Trimesh(BOX.vertices * 1000, BOX.faces).export(tmp_path / "part.stl")
    with pytest.raises(MeshError, match=r"chsel\.load_mesh\(path, scale=0\.001\), to commands obj"):
        load_mesh(tmp_path / "part.stl")
    assert load_mesh(tmp_path / "part.stl", scale=0.001).extents == pytest.approx(EXTENTS)


def collada(path, unit, vertices, faces):
    numbers = " ".join(str(x) for x in np.ravel(vertices))
    path.write_text(
        '<?xml version="1.0"?><COLLADA version="1.4.1" '
        'xmlns="http://www.collada.org/2005/11/COLLADASchema"><asset>'
        "<created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified>"
        f'{unit}<up_axis>Z_UP</up_axis></asset><library_geometries><geometry id="g"><mesh>'
        f'<source id="p"><float_array id="pa" count="{3 * len(vertices)}">{numbers}</float_array>'
        f'<technique_common><accessor source="#pa" count="{len(vertices)}" stride="3">'
        + "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
        + '</accessor></technique_common></source><vertices id="v"><input semantic="POSITION" '
        f'source="#p"/></vertices><triangles count="{len(faces)}"><input semantic="VERTEX" '
        f'source="#v" offset="0"/><p>{" ".join(str(i) for i in np.ravel(faces))}</p></triangles>'
        '</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s">'
        '<node id="n"><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>'
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def three_mf(path, unit, vertices, faces):
    """A model of two components, 4 units apart along x."""
    corners = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in vertices)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces)
    model = (
        f'<?xml version="1.0"?><model{unit} '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>'
        f'<object id="1" type="model"><mesh><vertices>{corners}</vertices><triangles>{triangles}'
        '</triangles></mesh></object><object id="2" type="model"><components>'
        '<component objectid="1"/><component objectid="1" transform="1 0 0 0 1 0 0 0 1 4 0 0"/>'
        '</components></object></resources><build><item objectid="2"/></build></model>'
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("3D/3dmodel.model", model)


@pytest.mark.parametrize(
    ("file_name", "unit", "metres", "length"),
    [
        ("inch.dae", '<unit meter="0.0254" name="inch"/>', 0.0254, 3),
        ("centimetres.dae", '<unit meter="0.01" name="centimeter"/>', 0.01, 3),
        ("metres.dae", '<unit meter="1" name="meter"/>', 1.0, 3),
        ("none.dae", "", 1.0, 3),
        ("inch.3mf", ' unit="inch"', 0.0254, 5),
        ("default.3mf", "", 0.001, 5),
    ],
)
def test_the_unit_that_a_file_states_counts_and_scale_multiplies_it(
    tmp_path, file_name, unit, metres, length
):
    write = collada if file_name.endswith("dae") else three_mf
    write(
        tmp_path / file_name, unit, vertices=BOX.vertices * 10.0, faces=BOX.faces
    )  # 1 x 2 x 3 units
    for scale in (1.5, 2.0):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            mesh = load_mesh(tmp_path / file_name, scale=scale)
        assert mesh.extents.max() == pytest.approx(length * metres * scale)
        units = [str(w.message) for w in caught if w.message.code == "mesh_unit"]
        assert len(units) == (metres != 1.0)
        assert all(f"states its unit, {metres:.6g} m" in text for text in units)


# By Open CASCADE 8.0, with inches as its unit: a cylinder of radius 1 and height 2.
CYLINDER = Path(__file__).parent / "cylinder_inch.step"


@pytest.mark.parametrize("tessellation", [1e-5, 1e-4, 2e-3])
def test_a_solid_in_inches_is_in_metres_and_within_the_tessellation(tessellation):
    """The sides of a prism with corners on a circle are inside of it by the sagitta at most."""
    mesh = load_mesh(CYLINDER, tessellation=tessellation)
    assert mesh.is_watertight
    assert mesh.extents[2] == pytest.approx(0.0508)
    assert mesh.extents[:2].max() == pytest.approx(0.0508, abs=2.0 * tessellation)
    corners = mesh.vertices[:, :2]
    np.testing.assert_allclose((corners**2).sum(axis=1) ** 0.5, 0.0254, rtol=1e-5)
    inside = mesh.volume / (np.pi * 0.0254**2 * 0.0508)
    assert (1.0 - tessellation / 0.0254) ** 2 < inside < 1.0
    assert load_mesh(CYLINDER, scale=3.0).extents[2] == pytest.approx(3.0 * 0.0508)


def test_a_solid_that_cannot_be_read_is_one_line(tmp_path, monkeypatch):
    path = tmp_path / "cut.step"
    path.write_bytes(CYLINDER.read_bytes()[:2000])
    with pytest.raises(MeshError, match=r"cut\.step cannot be read as \.step: it is damaged; acc"):
        load_mesh(path)
    with pytest.raises(
        SettingError, match=r"mesh tessellation is 0\.0; accepted: a finite number above 0"
    ):
        load_mesh(CYLINDER, tessellation=0.0)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        MeshError, match=r"cascadio, which is not installed; .*chsel-replay\[files\]"
    ):
        load_mesh(CYLINDER)


def test_an_error_about_the_size_names_the_unit_of_the_file(tmp_path):
    collada(
        tmp_path / "a.dae",
        '<unit meter="0.0254"/>',
        vertices=BOX.vertices * 2000.0,
        faces=BOX.faces,
    )
    with (
        pytest.warns(MeshWarning, match=r"states its unit, 0\.0254 m, which scale multiplies"),
        pytest.raises(MeshError, match=r"a\.dae \(unit 0\.0254 m, times scale\) is 5\.08 x"),
    ):
        load_mesh(tmp_path / "a.dae")


def test_relative_indices_are_read_right_or_refused(tmp_path):
    """trimesh counts them from the end of the file, so the last of two objects would come twice."""
    body = [f"v {x} {y} {z}" for x, y, z in CORNERS]
    faces = ["f " + " ".join(str(c - 4) for c in face) for face in TETRAHEDRON]
    (tmp_path / "one.obj").write_text("\n".join(body + faces))
    assert load_mesh(tmp_path / "one.obj").volume == pytest.approx(1 / 6)
    (tmp_path / "two.obj").write_text("\n".join([*body, *faces, "o b", *body, *faces]))
    with pytest.raises(MeshError, match=r"two\.obj counts vertices back from faces"):
        load_mesh(tmp_path / "two.obj")


LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n"
MIXED_PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    + np.arange(15, dtype="<f4").tobytes()
    + b"\x03"
    + np.array([0, 1, 2], dtype="<i4").tobytes()
    + b"\x04"
    + np.array([0, 1, 3, 4], dtype="<i4").tobytes()
)


@pytest.mark.parametrize(
    ("file_name", "content", "message"),
    [
        (
            "a.step",
            b"ISO-10303-21;",
            r"cannot be read as \.step: it is damaged; .*such as \.stl, \.obj",
        ),
        ("a.slt", b"solid", r"of no kind that can be read; accepted: a mesh in metres"),
        ("a.stl", LFS_POINTER, r"a pointer of Git LFS, not its data; run `git lfs pull`"),
        ("a.ply", MIXED_PLY, r"not all faces are triangles: export it with triangles"),
    ],
)
def test_files_that_cannot_be_read_say_what_to_do(tmp_path, file_name, content, message):
    (tmp_path / file_name).write_bytes(content)
    with pytest.raises(MeshError, match=f"{file_name} .*{message}"):
        load_mesh(tmp_path / file_name)


def test_of_more_than_a_thousand_bodies_the_large_ones_are_compared():
    """Two boxes 1 m apart, and 1200 splinters on one of them, which alone are near each other."""
    corners = np.array(CORNERS) * 0.001
    offsets = np.random.default_rng(0).uniform(-0.05, 0.05, (1200, 3))
    splinters = (corners + offsets[:, None]).reshape(-1, 3)
    faces = (np.array(TETRAHEDRON) + 4 * np.arange(1200)[:, None, None]).reshape(-1, 3)
    parts = [BOX, moved(BOX, 0.0, 1.2, 0.0), trimesh.Trimesh(splinters, faces, process=False)]
    (warning,) = check_bodies(trimesh.util.concatenate(parts), "dust")
    assert warning.code == "bodies_apart"
    assert "dust has 2 bodies at least 1 m apart" in warning.text
