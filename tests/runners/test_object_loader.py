"""The choice of an object leads to its mesh, or to a clear error."""

from __future__ import annotations

import pytest
import trimesh
from hydra import compose, initialize_config_dir

from chsel.errors import MeshError, SettingError
from chsel.problem.settings import build_settings
from runners import fetch
from runners.command.choices import CONF
from runners.command.program import plain
from runners.objects.loader import ObjectConfig, load_object
from runners.objects.scans import SCANS, check_scan, scan_file
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


def chosen(*overrides: str) -> ObjectConfig:
    """The object that a command line with these overrides chooses."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = plain(compose("fetch", overrides=list(overrides)))
    return build_settings(ObjectConfig, config["object"], "object")  # type: ignore[arg-type]


@pytest.mark.parametrize("name", TRIALS)
def test_models_and_scans_share_the_scales_of_the_trials(name):
    model, scan = chosen(f"object={name}"), chosen(f"object=ycb/{name}")
    assert (model.kind, scan.kind) == ("model", "scan")
    for config in (model, scan):
        assert config.name == name
        assert (config.scale, config.epsilon, config.configuration) == TRIALS[name]
    assert scan.scan is not None
    assert SCANS[scan.scan][0] == name


@pytest.mark.parametrize("name", TRIALS)
def test_a_scan_is_loaded_closed_and_at_its_scale(ycb_directory, name):
    config = chosen(f"object=ycb/{name}")
    loaded = load_object(config, ycb_directory)
    expected = [TRIALS[name][0] * extent for extent in SCANS[config.scan or ""][1]]
    assert loaded.mesh.extents == pytest.approx(expected, rel=0.002)
    assert loaded.mesh.is_watertight
    assert (loaded.name, loaded.scale, loaded.epsilon) == (name, *TRIALS[name][:2])
    assert loaded.configuration == TRIALS[name][2]


@pytest.mark.parametrize("scan", SCANS)
def test_every_scan_passes_its_own_check_and_no_other(ycb_directory, scan):
    path = scan_file(ycb_directory, scan)
    assert check_scan(path, scan).endswith("mm, watertight")
    for other in set(SCANS) - {scan}:
        with pytest.raises(MeshError, match=rf"scan {other} measures .* mm; expected: .* mm"):
            check_scan(path, other)


def test_a_missing_scan_tells_what_to_run(tmp_path):
    expected = (
        r"035_power_drill/google_16k/nontextured\.ply does not exist; "
        r"run `python -m runners\.fetch object=ycb/drill`, or set assets\.dir \(or CHSEL_ASSETS\)"
    )
    with pytest.raises(MeshError, match=expected):
        load_object(chosen("object=ycb/drill"), tmp_path)
    with pytest.raises(MeshError, match=r"object=ycb/drill object\.scan=011_banana`"):
        load_object(chosen("object=ycb/drill", "object.scan=011_banana"), tmp_path)


@pytest.mark.parametrize("scan", ["../x", "/etc", "a/b", "."])
def test_a_scan_is_a_folder_of_the_set_alone(tmp_path, scan):
    config = ObjectConfig("x", 1.0, 0.001, "drill", kind="scan", scan=scan)
    with pytest.raises(SettingError, match=r"object\.scan is .*accepted: a name such as"):
        load_object(config, tmp_path)


def test_a_mesh_file_is_found_from_the_working_directory(tmp_path, monkeypatch):
    trimesh.creation.box((100, 200, 300)).export(tmp_path / "thing.stl")
    monkeypatch.chdir(tmp_path)
    config = chosen("object=mesh", "object.path=thing.stl", "object.scale=0.001")
    loaded = load_object(config, tmp_path)
    assert loaded.mesh.extents == pytest.approx([0.1, 0.2, 0.3])
    assert (loaded.scale, loaded.epsilon) == (0.001, 0.001)


def test_a_mesh_without_a_file_tells_the_key():
    with pytest.raises(SettingError, match=r"pass object\.path=FILE"):
        chosen("object=mesh")


def test_errors_of_a_mesh_file_name_it(tmp_path):
    trimesh.creation.box((100, 200, 300)).export(tmp_path / "thing.stl")
    config = chosen("object=mesh", f"object.path={tmp_path / 'thing.stl'}")
    with pytest.raises(MeshError, match=r"is 100 x 200 x 300 m; .*object\.scale=0\.001"):
        load_object(config, tmp_path)
    config = chosen("object=mesh", f"object.path={tmp_path / 'other.stl'}")
    with pytest.raises(MeshError, match=r"other\.stl does not exist"):
        load_object(config, tmp_path)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("object.scale=0", "scale is 0.0; accepted: a finite number above 0"),
        ("object.scale=big", "scale is 'big'; accepted: a number"),
        ("object.epsilon=-1", "epsilon is -1.0; accepted"),
        ("object.kind=photo", "kind is 'photo'; accepted: model, scan, file"),
    ],
)
def test_a_setting_out_of_range_is_named(override, message):
    with pytest.raises(SettingError, match=rf"^object.*{message}"):
        chosen("object=drill", override)


def test_a_model_is_scaled(tmp_path):
    small, large = (
        load_object(chosen("object=spam_can", f"object.scale={scale}"), tmp_path / "no assets")
        for scale in (1, 2)
    )
    assert large.mesh.extents == pytest.approx(2.0 * small.mesh.extents)


def test_a_model_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(SettingError, match=r"object\.name is 'cup'; accepted: drill, mustard"):
        load_object(chosen("object=drill", "object.name=cup"), tmp_path)


def test_the_command_downloads_nothing_that_is_there_and_leaves_no_traces(
    ycb_directory, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CHSEL_ASSETS", str(ycb_directory))
    done = run(fetch.main, "object=ycb/clamp")
    assert done.returncode == 0, done.stderr
    assert "is there already: 583 vertices, 43.5 x 62.5 x 83.5 mm, watertight" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_the_command_says_of_an_object_without_scan_that_it_needs_none():
    done = run(fetch.main, "object=drill")
    message = "error: this object needs no download; accepted: object=ycb/NAME\n"
    assert (done.returncode, done.stderr) == (2, message)


def test_the_command_touches_no_folder_that_is_there_but_damaged(tmp_path):
    damaged = tmp_path / "035_power_drill/google_16k/nontextured.ply"
    damaged.parent.mkdir(parents=True)
    damaged.write_text("ply")
    done = run(fetch.main, f"assets.dir={tmp_path}")
    assert done.returncode == 2
    assert "to download the scan again, move" in done.stderr
    assert damaged.read_text() == "ply"
