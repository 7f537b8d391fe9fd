"""The choice of an object leads to its mesh, or to a clear error."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hydra import compose, initialize_config_dir

from chsel.errors import MeshError, SettingError
from chsel.problem.points import Workspace
from chsel.problem.settings import build_settings
from runners import fetch
from runners.command.choices import CONF
from runners.command.program import plain
from runners.objects.loader import ObjectConfig, ObjectModel, check_size, load_object
from runners.sessions import session_settings
from tests.chsel.samples import REPOSITORY
from tests.runners.in_process import run

# name: (simulated scale, epsilon in metres, default configuration), as the paper's trials have it
TRIALS = {
    "drill": (2.5, 0.001, "drill"),
    "mustard": (2.5, 0.0003, "mustard"),
    "hammer": (2.5, 0.001, "hammer"),
    "cracker_box": (1.5, 0.0005, "box"),
    "spam_can": (2.5, 0.0003, "can"),
    "clamp": (5.0, 0.0007, "clamp"),
}


def chosen(*overrides):
    """The object that a command line with these overrides chooses."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = plain(compose("fetch", overrides=list(overrides)))
    return build_settings(ObjectConfig, config["object"], where="object")


def test_models_and_scans_share_the_scales_of_the_trials():
    for name, trial in TRIALS.items():
        for choice, kind in ((name, "model"), (f"ycb/{name}", "scan")):
            config = chosen(f"object={choice}")
            assert (config.name, config.kind) == (name, kind)
            assert (config.scale, config.epsilon, config.configuration) == trial


def test_a_scan_is_loaded_closed_and_at_its_scale(ycb_directory):
    loaded = load_object(chosen("object=ycb/cracker_box"), ycb_directory)
    assert loaded.mesh.extents == pytest.approx([0.135, 0.2517, 0.3576], rel=0.002)
    assert loaded.mesh.is_watertight
    assert (loaded.name, loaded.scale, loaded.epsilon) == ("cracker_box", 1.5, 0.0005)


def test_a_mesh_file_is_found_from_the_working_directory(tmp_path, monkeypatch):
    trimesh.creation.box((100, 200, 300)).export(tmp_path / "thing.stl")
    monkeypatch.chdir(tmp_path)
    config = chosen("object=mesh", "object.path=thing.stl", "object.scale=0.001")
    loaded = load_object(config, tmp_path)
    assert loaded.mesh.extents == pytest.approx([0.1, 0.2, 0.3])
    assert (loaded.scale, loaded.epsilon) == (0.001, 0.001)


@pytest.mark.parametrize("kind", ["simulated", "kinematic", "points", "sensors"])
@pytest.mark.parametrize(
    ("overrides", "spacing"),
    [
        ("object=drill", 0.010),
        ("object=clamp", 0.010),
        ("object=drill object.scale=1", None),
        ("object=mesh object.path=thing.stl", None),
        ("object=mesh object.path=thing.stl object.name=drill object.scale=2.5", None),
    ],
)
def test_objects_of_the_trials_have_their_grid_and_all_others_that_of_object_grid(
    kind, overrides, spacing, tmp_path, monkeypatch
):
    trimesh.creation.box((0.03, 0.05, 0.04)).export(tmp_path / "thing.stl")
    monkeypatch.chdir(tmp_path)
    needed = {
        "points": {"path": "x.npz"},
        "sensors": {"path": "x", "rig": {"name": "r", "world": "world"}},
    }
    settings = session_settings(kind, needed.get(kind, {}))
    model = load_object(chosen(*overrides.split()), tmp_path)
    assert model.resolution(settings) == spacing
    assert model.resolution(replace(settings, object_resolution=0.004)) == 0.004
    if overrides.endswith("stl"):
        assert model.grid(settings).resolution == pytest.approx(0.03 / 20.0)


def test_scans_of_the_trials_have_their_grid_and_other_scans_do_not(ycb_directory):
    settings = session_settings("kinematic", {})
    for overrides, spacing in (
        ("object=ycb/clamp", 0.010),
        ("object=ycb/clamp object.scale=1", None),
        ("object=ycb/clamp object.scan=006_mustard_bottle", None),
    ):
        model = load_object(chosen(*overrides.split()), ycb_directory)
        assert model.resolution(settings) == spacing, overrides


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("object=mesh", r"pass object\.path=FILE"),
        ("object=drill object.scale=0", "scale is 0.0; accepted: a finite number above 0"),
        ("object=drill object.epsilon=-1", "epsilon is -1.0; accepted"),
        ("object=drill object.kind=photo", "accepted: model, household, scan, file"),
        ("object=drill object.name=cup", r"object\.name is 'cup'; accepted: drill, mustard"),
        ("object=ycb/drill object.scan=../x", r"object\.scan is .*accepted: a name such as"),
    ],
)
def test_a_choice_that_cannot_be_is_named(overrides, message, tmp_path):
    with pytest.raises(SettingError, match=message):
        load_object(chosen(*overrides.split()), tmp_path)


def test_the_tessellation_of_a_step_file_is_a_setting(tmp_path):
    path = REPOSITORY / "tests" / "chsel" / "problem" / "cylinder_inch.step"
    given = f"object=mesh object.path={path} object.tessellation="
    fine, coarse = (
        load_object(chosen(*f"{given}{size}".split()), tmp_path).mesh for size in (1e-5, 2e-3)
    )
    assert len(fine.faces) > 3 * len(coarse.faces)


def symmetry_file(folder, **values):
    path = folder / "models_info.json"
    path.write_text(json.dumps(values))
    return path


def declared(mesh, path, folder):
    trimesh.creation.box((30.0, 50.0, 40.0)).export(folder / mesh)
    given = f"object=mesh object.path={folder / mesh} object.scale=0.001 object.symmetry={path}"
    return load_object(chosen(*given.split()), folder).symmetry


def test_symmetries_are_those_of_the_file_in_the_unit_of_the_mesh(tmp_path):
    turn = [-1, 0, 0, 20, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]  # about x = 10 mm
    five = {"symmetries_discrete": [turn]}
    six = {"symmetries_continuous": [{"axis": [0, 0, 2], "offset": [0, 7, 0]}]}
    path = symmetry_file(tmp_path, **{"5": five, "6": six, "7": {"diameter": 3}})
    found = declared("obj_000005.ply", path, tmp_path)
    assert len(found.rotations) == 2
    np.testing.assert_allclose(found.centre, [0.01, 0.0, 0.0], atol=1e-12)
    found = declared("obj_000006.ply", path, tmp_path)
    np.testing.assert_allclose(found.axis, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(found.centre, [0.0, 0.007, 0.0], atol=1e-12)
    assert len(declared("obj_000007.ply", path, tmp_path).rotations) == 1
    alone = symmetry_file(tmp_path, **five)
    assert len(declared("thing.ply", alone, tmp_path).rotations) == 2
    assert len(declared("thing.ply", "none", tmp_path).rotations) == 1


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"5": {}}, "of the objects 5 none is that of the mesh thing.ply"),
        ({"symmetries_discrete": [[1, 2]]}, "symmetries that are not read"),
        ({"symmetries_discrete": [[2, *[0] * 15]]}, "turns"),
        (None, "No such file"),
    ],
)
def test_a_file_without_the_symmetries_of_a_mesh_is_one_line(values, message, tmp_path):
    path = tmp_path / "none.json" if values is None else symmetry_file(tmp_path, **values)
    with pytest.raises(SettingError, match=rf"symmetry .*json: .*{message}.*accepted: none, or"):
        declared("thing.ply", path, tmp_path)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            "object=ycb/drill",
            r"035_power_drill/google_16k/nontextured\.ply does not exist; run `python -m runners"
            r"\.fetch object=ycb/drill`, or set assets\.dir \(or CHSEL_ASSETS\)",
        ),
        ("object=ycb/drill object.scan=011_banana", r"object=ycb/drill object\.scan=011_banana`"),
        ("object=mesh object.path=other.stl", r"other\.stl does not exist"),
    ],
)
def test_a_missing_file_tells_what_to_do(overrides, message, tmp_path):
    with pytest.raises(MeshError, match=message):
        load_object(chosen(*overrides.split()), tmp_path)


@pytest.mark.parametrize(
    ("length", "scale", "count"),
    [(0.04, 1.0, 0), (0.04, 0.001, 0), (0.49, 1.0, 0), (0.04, 2.5, 1), (0.51, 1.0, 1)],
)
def test_enlarged_objects_and_those_longer_than_the_workspace_are_a_warning(length, scale, count):
    model = ObjectModel(
        "box",
        trimesh.creation.box((length, 0.02, 0.03)),
        scale=scale,
        epsilon=0.001,
        configuration="drill",
    )
    found = check_size(model, Workspace((0.0, 0.0, 0.0), (0.4, 0.5, 0.3)))
    text = (
        f"the object is {length} m long at scale {scale:g}, the workspace 0.5 m; objects of "
        "real size have object.scale=1"
    )
    assert [(one.code, one.text) for one in found] == [("object_size", text)] * count


def test_the_command_downloads_nothing_that_is_there_or_needs_no_download(tmp_path, monkeypatch):
    monkeypatch.setenv("CHSEL_ASSETS", str(tmp_path))
    (tmp_path / "050_medium_clamp" / "google_16k").mkdir(parents=True)
    done = run(fetch.main, "object=ycb/clamp")
    assert (done.returncode, "is there already" in done.stdout) == (0, True)
    done = run(fetch.main, "object=drill")
    message = "error: this object needs no download; accepted: object=ycb/NAME\n"
    assert (done.returncode, done.stderr) == (2, message)
