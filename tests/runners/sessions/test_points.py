"""Sessions of points in files: formats, steps, repeated places and refusals."""

import numpy as np
import pytest
import trimesh

from chsel.errors import PointsError, PointsWarning, SettingError
from chsel.problem.sdf_grid import object_grid
from runners.objects.loader import ObjectModel
from runners.sessions.points import PointsSettings, PointsSource, read_points

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
