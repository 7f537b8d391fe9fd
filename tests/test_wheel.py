"""The project works when it is installed, from any folder: packages, scripts, completion."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from tests.chsel.samples import REPOSITORY

pytestmark = pytest.mark.slow
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
SCRIPTS = tuple(PROJECT["scripts"])


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of packages of an installation of the checkout; its scripts are in `bin`."""
    folder = tmp_path_factory.mktemp("installation")
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    files = subprocess.run(listed, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    for name in files.stdout.split():
        if (REPOSITORY / name).is_file():
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(REPOSITORY / name, folder / "source" / name)
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--target", str(folder / "site")]
    install = [sys.executable, "-m", "pip", "install", str(folder / "source"), *options]
    subprocess.run(install, check=True)
    return folder / "site"


@pytest.fixture
def ran(site, tmp_path):
    """Runs a command of the installation, in a folder."""
    path = os.pathsep.join([str(site / "bin"), str(Path(sys.executable).parent), os.defpath])
    given = {**os.environ, "PYTHONPATH": str(site), "PATH": path}
    options = {"cwd": tmp_path, "env": given, "capture_output": True, "text": True}
    return lambda *command: subprocess.run(command, **options)


def test_four_packages_with_their_data_and_no_tests_are_installed(site):
    beside = ("bin", "dist-info", "__pycache__")
    packages = {path.name for path in site.iterdir() if not path.name.endswith(beside)}
    assert packages == {"chsel", "conf", "replay", "runners"}
    assert {file.parent.name for file in site.rglob("py.typed")} == packages - {"conf"}
    for pattern in ("conf/**/*.yaml", "runners/**/*.ply", "replay/*.json"):
        names = {str(file.relative_to(REPOSITORY)) for file in REPOSITORY.glob(pattern)}
        assert names
        assert names == {str(file.relative_to(site)) for file in site.glob(pattern)}


def test_the_installed_command_runs_in_any_folder(site, ran, tmp_path):
    box = trimesh.creation.box((0.1, 0.06, 0.2))
    box.export(tmp_path / "box.stl")
    np.savez(tmp_path / "points.npz", surface=box.vertices[:6])
    overrides = ["session=points", "session.path=points.npz", "object=mesh", "object.path=box.stl"]
    overrides += ["method=chsel", "method.descent.restarts=1", "method.emitter.iterations=5"]
    assert str(site) in ran(sys.executable, "-c", "import runners; print(runners.__file__)").stdout
    done = ran("chsel-probe", *overrides)
    assert done.returncode == 0, done.stderr
    (recording,) = tmp_path.glob("logs/probe/*/recording.mcap")
    info = ran("chsel-replay", "info", str(recording))
    assert info.returncode == 0, info.stderr
    mistaken = ran("chsel-replay", "colour=red")
    assert (mistaken.returncode, mistaken.stderr[:7]) == (2, "error: ")
    assert mistaken.stderr.count("\n") == 1


def test_every_command_has_a_script_and_each_names_its_version(ran):
    commands = {file.stem for file in (REPOSITORY / "conf").glob("*.yaml")}
    assert set(SCRIPTS) == {f"chsel-{name.replace('_', '-')}" for name in commands | {"replay"}}
    for script in SCRIPTS:
        done = ran(script, "--version")
        assert (done.returncode, done.stdout) == (0, f"chsel-replay {PROJECT['version']}\n")


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    for key in ("version", "license"):
        assert citation[key] == PROJECT[key]
