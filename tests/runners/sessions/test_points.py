"""Sessions of points in files: formats, steps, repeated places and refusals."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh

from chsel.errors import PointsError, PointsWarning, SettingError
from chsel.problem.sdf_grid import object_grid
from runners.objects.loader import ObjectModel
from runners.sessions.points import PointsSettings, PointsSource, read_points
from runners.sessions.probing_settings import without_defaults

BOX = ObjectModel(
    "box", trimesh.creation.box((0.03, 0.04, 0.12)), scale=1.0, epsilon=0.001, configuration="box"
)
SURFACE = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.2, 0.0]])


def npz(folder, **arrays):
    path = folder / "points.npz"
    np.savez(path, **arrays)
    return path


def text(folder, content, *, name="points.csv"):
    path = folder / name
    path.write_text(content)
    return path


def test_a_file_without_steps_is_one_probe(tmp_path):
    free = np.full((4, 3), 0.3)
    path = npz(tmp_path, surface=SURFACE, free=free, world_from_object=np.eye(4))
    session = PointsSource(PointsSettings(str(path)), BOX)
    (probe,) = session.probes()
    assert (session.count, probe.step, probe.outcome) == (1, 0, "points")
    np.testing.assert_array_equal(probe.new_points.known, SURFACE)
    np.testing.assert_array_equal(probe.new_points.free, free)
    np.testing.assert_array_equal(probe.contacts, SURFACE)
    np.testing.assert_array_equal(session.world_from_object, np.eye(4))


def test_steps_make_a_sequence_and_all_classes_arrive_at_theirs(tmp_path):
    path = npz(
        tmp_path,
        surface=SURFACE,
        surface_step=np.array([5, 0, 5]),
        occupied=SURFACE + 1.0,
        occupied_step=np.array([2, 2, 0]),
        known=SURFACE + 2.0,
        known_sdf=np.array([0.1, -0.2, 0.0]),
        known_step=np.array([0, 5, 5]),
    )
    probes = list(PointsSource(PointsSettings(str(path)), BOX).probes())
    assert [probe.step for probe in probes] == [0, 2, 5]
    last = probes[2].new_points
    np.testing.assert_array_equal(last.known, np.concatenate([SURFACE[[0, 2]], SURFACE[1:] + 2.0]))
    np.testing.assert_array_equal(last.sdf, [0.0, 0.0, -0.2, 0.0])
    np.testing.assert_array_equal(probes[1].new_points.occupied, SURFACE[:2] + 1.0)
    assert len(last.contacts) == 3


def test_a_place_that_is_measured_again_counts_once_also_at_a_later_step(tmp_path):
    held = np.repeat(SURFACE[:1], 30, axis=0)
    path = npz(
        tmp_path,
        surface=np.concatenate([SURFACE, held + 0.001]),
        surface_step=np.array([0, 0, 0, *range(30)]),
    )
    session = PointsSource(PointsSettings(str(path)), BOX)
    probes = list(session.probes())
    known = np.concatenate([probe.new_points.known for probe in probes])
    np.testing.assert_array_equal(known, SURFACE)
    assert [len(probe.contacts) for probe in probes] == [4, *[1] * 29]
    assert {warning.code for warning in session.warnings} == {"repeated"}


def test_points_in_millimetres_are_a_warning_and_those_out_of_reach_an_error(tmp_path):
    session = PointsSource(PointsSettings(str(npz(tmp_path, surface=[[400.0, 0, 0]]))), BOX)
    assert [warning.code for warning in session.warnings] == ["far_away"]
    with pytest.raises(PointsError, match=r"points.npz: points\[0\] has 1e\+08; accepted: up to"):
        read_points(npz(tmp_path, surface=[[1e8, 0, 0]]))


def test_csv_holds_every_kind_and_points_without_a_step_are_known_first(tmp_path):
    rows = "x, y, z, kind, sdf, step\n0,0,0,surface,,0\n0.1,1e-1,.7,free,,\n"
    rows += "0,1,0, known ,-0.02,1\n2,2,2,occupied,, 1\n3,3,3,free,, \n"
    content = read_points(text(tmp_path, rows))
    first, later = content.at(0), content.at(1)
    np.testing.assert_array_equal(first.known, [[0, 0, 0]])
    np.testing.assert_array_equal(first.free, [[0.1, 0.1, 0.7], [3, 3, 3]])
    np.testing.assert_array_equal(later.sdf, [-0.02])
    np.testing.assert_array_equal(later.occupied, [[2, 2, 2]])
    points = np.random.default_rng(0).normal(size=(500, 3)) * 10.0 ** np.arange(-3, 0)
    lines = [f"{x!r},{y!r},{z!r},free" for x, y, z in points.tolist()]
    content = read_points(text(tmp_path, "\n".join(["\ufeffx,y,z,kind", *lines])))
    np.testing.assert_array_equal(content.at(0).free, points)  # to the bit


def test_a_csv_without_kinds_holds_surface_points_and_says_so(tmp_path):
    path = text(tmp_path, "z,x,y,step\n3,1,2,0\n0.3,.1,.2,4\n")
    with pytest.warns(PointsWarning, match=r"points.csv has no column kind: its points are"):
        content = read_points(path)
    for step, point in ((0, [1, 2, 3]), (4, [0.1, 0.2, 0.3])):
        np.testing.assert_array_equal(content.at(step).contacts, [point])
        assert len(content.at(step).free) == 0


@pytest.mark.parametrize("suffix", ["ply", "off", "stl", "xyz"])
def test_vertices_of_meshes_and_clouds_are_surface_points(tmp_path, suffix):
    path = tmp_path / f"points.{suffix}"
    if suffix == "xyz":
        np.savetxt(path, SURFACE)
    else:
        trimesh.Trimesh(SURFACE, [[0, 1, 2]]).export(path)
    points = read_points(path).at(0)
    found = points.known[np.lexsort(points.known.T)]
    np.testing.assert_allclose(found, SURFACE[np.lexsort(SURFACE.T)], atol=1e-7)


def test_vertices_beside_the_faces_are_points_too(tmp_path):
    off = "OFF\n5 1 0\n0 0 0\n1 0 0\n0 1 0\n0 0 0\n{} 2 2\n3 0 1 2\n"
    found = read_points(text(tmp_path, off.format("2"), name="points.off")).at(0).known
    expected = [[0, 0, 0], [0, 0, 0], [0, 1, 0], [1, 0, 0], [2, 2, 2]]
    assert sorted(found.tolist()) == expected
    with pytest.raises(PointsError, match=r"surface\[4\] is not finite"):
        read_points(text(tmp_path, off.format("nan"), name="points.off"))


NORMALS = np.array([[0.0, 0.0, 1.0], [0.6, 0.8, 0.0], [0.0, 0.0, 0.0]])
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property float nx
property float ny
property float nz
{}end_header
0 0 0 0 0 1
0.125 0 0 0.6 0.8 0
0 0.25 0 0 0 0
0.125 0 0 -1 0 0
{}"""


def test_normals_of_arrays_are_read_where_they_are_asked_for(tmp_path):
    given = {
        "surface": SURFACE,
        "surface_normal": 1.005 * NORMALS,
        "surface_step": np.array([1, 0, 0]),
        "known": SURFACE + 1.0,
        "known_sdf": np.array([0.0, 0.01, 0.0]),
        "known_normal": NORMALS[::-1],
        "known_normal_noise": np.array([0.0, 0.1, 0.2]),
        "free": SURFACE + 2.0,
    }
    path = npz(tmp_path, **given)
    session = PointsSource(PointsSettings(str(path), normals="file", normal_noise=0.4), BOX)
    first, later = session.probes()
    assert [warning.code for warning in session.warnings] == []
    np.testing.assert_allclose(first.new_points.normals, [*NORMALS[1:], *NORMALS[::-1]])
    np.testing.assert_array_equal(first.new_points.normal_noise, [0.4, 0.0, 0.0, 0.1, 0.2])
    np.testing.assert_array_equal(first.contacts, [*SURFACE[1:], *SURFACE[[0, 2]] + 1.0])
    np.testing.assert_allclose(first.contact_normals, [*NORMALS[1:], *NORMALS[[2, 0]]])
    np.testing.assert_allclose(later.new_points.normals, NORMALS[:1])
    unread = PointsSource(PointsSettings(str(path)), BOX)
    (warning,) = unread.warnings
    assert warning.code == "normals_unused"
    assert str(warning).endswith("has normals, which are not used; session.normals=file uses them")
    without = {name: array for name, array in given.items() if "normal" not in name}
    plain = PointsSource(PointsSettings(str(npz(tmp_path, **without))), BOX)
    digests = [[probe.new_points.digest for probe in source.probes()] for source in (unread, plain)]
    assert digests[0] == digests[1]
    assert plain.warnings == []


def test_normals_of_rows_are_read_where_they_are_asked_for(tmp_path):
    rows = "x,y,z,kind,sdf,nx,ny,nz,normal_noise\n0,0,0,surface,,0,0,1,0.1\n"
    rows += "1,0,0,surface,,,,,\n2,0,0,free,,,,,\n3,0,0,known,0,0.6,.8,0,\n"
    path = text(tmp_path, rows)
    points = read_points(path, normal_noise=0.3).at(0)
    np.testing.assert_allclose(points.normals, [[0, 0, 1], [0, 0, 0], [0.6, 0.8, 0]])
    np.testing.assert_array_equal(points.normal_noise, [0.1, 0.0, 0.3])
    unread = read_points(text(tmp_path, rows.replace(".8", "no number")))
    assert unread.has_unread_normals
    assert not unread.at(0).has_normals


@pytest.mark.parametrize(
    "face", [("", ""), ("element face 1\nproperty list uchar int vertex_indices\n", "3 0 1 2\n")]
)
def test_normals_of_ply_vertices_are_read_where_they_are_asked_for(tmp_path, face):
    """Of a place that comes twice, the first counts."""
    path = text(tmp_path, PLY.format(*face), name="points.ply")
    points = read_points(path, normal_noise=0.3).at(0)
    np.testing.assert_array_equal(points.known, [[0, 0, 0], [0.125, 0, 0], [0, 0.25, 0]])
    np.testing.assert_allclose(points.normals, NORMALS, atol=1e-7)
    np.testing.assert_array_equal(points.normal_noise, [0.3, 0.3, 0.0])
    assert read_points(path).has_unread_normals
    assert not read_points(path).at(0).has_normals
    binary = trimesh.Trimesh(SURFACE, [[0, 1, 2]], vertex_normals=np.tile([0.0, 0.6, 0.8], (3, 1)))
    binary.export(tmp_path / "binary.ply", vertex_normal=True)
    found = read_points(tmp_path / "binary.ply", normal_noise=0.3).at(0)
    np.testing.assert_allclose(found.normals, np.tile([0.0, 0.6, 0.8], (3, 1)), atol=1e-7)


PCD = """# .PCD v0.7
VERSION 0.7
FIELDS x y z intensity normal_x normal_y normal_z
SIZE 4 4 4 2 4 4 4
TYPE F F F U F F F
COUNT 1 1 1 1 1 1 1
WIDTH 4
HEIGHT 1
VIEWPOINT {}
POINTS 4
DATA ascii
0 0 0 7 0 0 1
0.5 0 0 7 nan nan nan
nan nan nan 7 0 0 1
0 0.25 0 7 0.6 0 0.8
"""


def test_points_of_pcd_files_are_read_but_those_without_a_measurement(tmp_path):
    path = text(tmp_path, PCD.format("0 0 0 1 0 0 0"), name="points.pcd")
    found = read_points(path, normal_noise=0.2)
    np.testing.assert_array_equal(found.points, [[0, 0, 0], [0.5, 0, 0], [0, 0.25, 0]])
    np.testing.assert_allclose(found.normals, [[0, 0, 1], [0, 0, 0], [0.6, 0, 0.8]], atol=1e-7)
    np.testing.assert_array_equal(found.normal_noise, [0.2, 0.0, 0.2])
    assert read_points(path).has_unread_normals
    seen = text(tmp_path, PCD.format("0.1 0 0.5 1 0 0 0"), name="seen.pcd")
    with pytest.raises(PointsError, match=r"its VIEWPOINT is 0\.1 0 0\.5 1 0 0 0, and whether"):
        read_points(seen)


def test_a_compressed_pcd_file_of_open3d_is_read():
    """Written by Open3D 0.20.0."""
    found = read_points(Path(__file__).parent / "open3d_compressed.pcd", normal_noise=0.2)
    points = [[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0.1, 0.25, 0.0625]]
    np.testing.assert_array_equal(found.points, np.float32(points))
    np.testing.assert_allclose(found.normals[3], [0.6, 0.0, 0.8], atol=1e-7)


def test_a_pcd_file_that_is_cut_or_has_no_places_is_one_line(tmp_path):
    data = (Path(__file__).parent / "open3d_compressed.pcd").read_bytes()
    (tmp_path / "cut.pcd").write_bytes(data[:-8])
    with pytest.raises(PointsError, match=r"cut\.pcd: not a readable \.pcd file"):
        read_points(tmp_path / "cut.pcd")
    path = text(tmp_path, PCD.format("0 0 0 1 0 0 0").replace(" x y", " u v"), name="uv.pcd")
    with pytest.raises(
        PointsError, match=r"its fields are u, v, z, intensity, .*accepted: x, y and"
    ):
        read_points(path)


@pytest.mark.parametrize("suffix", ["npz", "csv", "ply", "off", "stl", "xyz"])
def test_a_file_without_normals_is_an_error_where_they_are_asked_for(tmp_path, suffix):
    path = tmp_path / f"points.{suffix}"
    if suffix == "npz":
        np.savez(path, surface=SURFACE)
    elif suffix == "csv":
        path.write_text("x,y,z,kind,nx,ny,nz\n0,0,0,surface,,,\n")
    elif suffix == "xyz":
        np.savetxt(path, SURFACE)
    else:
        trimesh.Trimesh(SURFACE, [[0, 1, 2]]).export(path)
    with pytest.raises(PointsError, match=rf"points.{suffix}: it has no normals; accepted: sess"):
        read_points(path, normal_noise=0.3)
    assert not read_points(path).at(0).has_normals


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"surface_normal": NORMALS[:2]}, "surface_normal has 2 rows; accepted: one per point, 3"),
        ({"surface_normal": 1.02 * NORMALS}, r"surface_normal\[0\] is 1.02 long"),
        ({"surface_normal": NORMALS * np.nan}, r"surface_normal\[0\] is not finite"),
        ({"surface_normal_noise": np.full(3, 0.1)}, "normal_noise has no surface_normal"),
        (
            {"surface_normal": NORMALS, "surface_normal_noise": np.full(3, 15.0)},
            "normal_noise is 15; in degrees",
        ),
        ({"known_normal": NORMALS}, "known_normal has no known; accepted: both, or none"),
        ({"free_normal": NORMALS}, "array 'free_normal' is unknown"),
    ],
)
def test_malformed_arrays_of_normals_are_named(tmp_path, arrays, message):
    with pytest.raises(PointsError, match=rf"points.npz: .*{message}"):
        read_points(npz(tmp_path, surface=SURFACE, **arrays), normal_noise=0.3)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("surface,0,0,1.02,", "row 2: nx, ny, nz is no unit vector"),
        ("surface,0,,1,", "row 2: one of nx, ny, nz is missing"),
        ("surface,0,inf,1,", "row 2: one of nx, ny, nz and normal_noise is not finite"),
        ("surface,0,b,1,", "row 2: ny is 'b'; accepted: a number"),
        ("free,0,0,1,", "row 2: a normal, but kind is none of surface, known"),
        ("surface,0,0,1,15", "row 2: normal_noise is not above 0, up to pi, radians"),
        ("surface,0,0,1,0", "row 2: normal_noise is not above 0, up to pi, radians"),
    ],
)
def test_malformed_normals_of_rows_are_named(tmp_path, row, message):
    rows = f"x,y,z,kind,nx,ny,nz,normal_noise\n0,0,0,surface,0,0,1,0.1\n1,0,0,{row}\n"
    with pytest.raises(PointsError, match=f"points.csv: {message}"):
        read_points(text(tmp_path, rows), normal_noise=0.3)
    for columns in ("x,y,z,nx,ny", "x,y,z,normal_noise"):
        shown = columns.replace(",", ", ")
        with pytest.raises(PointsError, match=f"its columns are {shown}; accepted: x, y, z"):
            read_points(text(tmp_path, f"{columns}\n"), normal_noise=0.3)


def test_settings_of_normals_that_cannot_be_are_refused_and_defaults_not_recorded():
    for wrong, message in (
        ({"normals": "mesh"}, "normals is 'mesh'; accepted: none, file"),
        ({"normal_noise": 15.0}, "normal_noise is 15; in degrees"),
        ({"normal_noise": 0.0}, "normal_noise is 0.0"),
    ):
        with pytest.raises(SettingError, match=message):
            PointsSettings("x", **wrong)
    default = dataclasses.asdict(PointsSettings("x"))
    assert "normals" not in without_defaults(default)
    assert "normal_noise" not in without_defaults(default)
    asked = dataclasses.asdict(PointsSettings("x", normals="file", normal_noise=0.1))
    assert without_defaults(asked) == {k: v for k, v in asked.items() if k != "prior"}


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"surface": np.zeros((3, 2))}, r"surface has shape \(3, 2\); accepted: \(any, 3\)"),
        ({"free": np.full((2, 3), np.nan)}, r"free\[0\] is not finite"),
        ({"contacts": SURFACE}, "array 'contacts' is unknown; accepted: surface, free"),
        ({"world_from_object": np.eye(4)}, "no array of points"),
        ({"known": SURFACE}, "known and known_sdf stand only together"),
        ({"known": SURFACE, "known_sdf": np.zeros(2)}, r"known_sdf has shape \(2,\)"),
        ({"surface": SURFACE, "surface_step": np.zeros(3)}, "surface_step has type float64"),
        ({"surface": SURFACE, "world_from_object": 2 * np.eye(4)}, "not a rigid transform"),
        ({"surface": np.zeros((0, 3))}, "holds no points"),
        ({"free": SURFACE, "free_step": np.array([0, 2**32, 1])}, "0 to 4294967296; accepted: 0"),
        ({"surface": np.array([[object()] * 3])}, "not a readable .npz"),
    ],
)
def test_malformed_arrays_are_named(tmp_path, arrays, message):
    with pytest.raises(PointsError, match=rf"points.npz.*{message}"):
        read_points(npz(tmp_path, **arrays))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("x,y\n0,0\n", r"its columns are x, y; accepted: x, y, z\[, kind"),
        ("x,y,z,sdf\n0,0,0,1\n", r"its columns are x, y, z, sdf; accepted: x, y, z\[, kind"),
        ("x;y;z\n0.5;1;2\n", "its columns are x;y;z; accepted: .* commas between them, decimal po"),
        ("x;y;z\n0,5;0,1;0,2\n", "row 1 has 4 values for 1 columns; accepted: .* decimal points"),
        ("x,y,z\n0,0,0\n0,1,0,2,0,3\n", "row 2 has 6 values for 3 columns; accepted: x, y, z"),
        ('x,y,z\n0,"0,25",0\n', "row 1: y is '0,25'; accepted: a number such as 0.125"),
        ("x,y,z,kind\n0,0,0,solid\n", "row 1: kind is none of surface, free"),
        ("x,y,z,kind\n0,b,0,free\n", "row 1: y is 'b'; accepted: a number"),
        ("x,y,z,kind,sdf\n0,0,0,known,\n", "row 1: a known point needs an sdf"),
        ("x,y,z,kind,step\n0,0,0,free,1.5\n", "row 1: step is not an integer"),
    ],
)
def test_malformed_rows_are_named(tmp_path, content, message):
    with pytest.raises(PointsError, match=rf"points.csv.*{message}"):
        read_points(text(tmp_path, content))


def test_files_that_are_not_what_their_suffix_says_are_refused(tmp_path):
    for suffix in ("npz", "ply", "off", "stl", "csv", "xyz"):
        path = tmp_path / f"noise.{suffix}"
        path.write_bytes(b"\xff\x00\x81" * 50)
        with pytest.raises(PointsError, match=f"noise.{suffix}"):
            read_points(path)
    with pytest.raises(PointsError, match=r"accepted: \.npz, \.csv"):
        read_points(tmp_path / "points.txt")
    with pytest.raises(PointsError, match="does not exist"):
        read_points(tmp_path / "nothing.npz")


def test_workspace_is_that_of_the_points_padded_by_the_diameter(tmp_path):
    path = str(npz(tmp_path, surface=SURFACE, free=SURFACE - 1.0))
    lower, upper = PointsSource(PointsSettings(path), BOX).workspace.bounds
    diameter = object_grid(BOX.mesh).diameter
    assert 0.13 < diameter < 0.133
    np.testing.assert_allclose(lower, -1.0 - diameter)
    np.testing.assert_allclose(upper, np.array([0.1, 0.2, 0.0]) + diameter)
    chosen = PointsSettings(path, workspace=((0, 1), (0, 2), (0, 3)))
    assert PointsSource(chosen, BOX).workspace.upper == (1, 2, 3)
    with pytest.raises(PointsError, match="lower bound below"):
        PointsSource(PointsSettings(path, workspace=((0, 1), (2, 0), (0, 3))), BOX)
    with pytest.raises(SettingError, match=r"session\.path=FILE"):
        PointsSettings()
    with pytest.raises(SettingError, match=r"\[\[x0, x1\]"):
        PointsSettings("x", workspace=((0, 1), (0, 1)))


def test_the_way_of_a_hand_is_free_from_the_first_step_on(tmp_path):
    """A cube of 40 mm goes along x through the workspace, 0.2 m above the points."""
    trimesh.creation.box((0.04, 0.04, 0.04)).export(tmp_path / "hand.stl")
    rows = [f"{n} {-0.2 + 0.1 * n} 0.1 0.2 0 0 0 1" for n in range(6)]
    way = text(tmp_path, "\n".join(rows), name="hand.txt")
    path = npz(tmp_path, surface=SURFACE, surface_step=np.array([1, 1, 4]))
    settings = PointsSettings(
        str(path),
        trajectory=str(way),
        trajectory_kind="tum",
        hand=str(tmp_path / "hand.stl"),
        workspace=((-0.1, 0.2), (-0.1, 0.3), (-0.1, 0.3)),
    )
    probes = list(PointsSource(settings, BOX).probes())
    free = probes[0].new_points.free
    assert len(probes[1].new_points.free) == 0
    inside = (np.abs(free[:, 1:] - [0.1, 0.2]) <= 0.02 + 0.005).all(axis=1)
    assert inside.all()
    along = np.unique(np.round(free[:, 0], 6))
    assert along.min() < -0.09
    assert along.max() > 0.19
    assert np.diff(along).max() < 0.0101
    volume = len(free) * settings.free_resolution**3
    assert volume == pytest.approx(0.3 * 0.04 * 0.04, rel=0.6)
    elsewhere = text(tmp_path, "0 5 5 5 0 0 0 1\n", name="far.txt")
    missed = PointsSource(dataclasses.replace(settings, trajectory=str(elsewhere)), BOX)
    assert any("misses the workspace" in str(warning) for warning in missed.warnings)
    with pytest.raises(SettingError, match="trajectory, trajectory_kind and hand are"):
        dataclasses.replace(settings, hand=None)
