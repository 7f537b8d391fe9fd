"""The project works when it is installed, from any folder: packages, scripts, completion."""

import os
import shutil
import subprocess
import sys
import tarfile
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
def built(tmp_path_factory):
    """The sdist and the wheel of the checkout."""
    folder = tmp_path_factory.mktemp("built")
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    files = subprocess.run(listed, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    for name in files.stdout.split():
        if (REPOSITORY / name).is_file():
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(REPOSITORY / name, folder / "source" / name)
    build = "from setuptools import build_meta as b; b.build_sdist('..'); b.build_wheel('..')"
    subprocess.run([sys.executable, "-c", build], cwd=folder / "source", check=True)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return {"sdist": sdist, "wheel": wheel}


@pytest.fixture(scope="module")
def site(built, tmp_path_factory):
    """The folder of packages of an installation of the wheel; its scripts are in `bin`."""
    folder = tmp_path_factory.mktemp("installation")
    options = ["--no-deps", "--quiet", "--target", str(folder)]
    install = [sys.executable, "-m", "pip", "install", str(built["wheel"]), *options]
    subprocess.run(install, check=True)
    return folder


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


def test_the_sdist_has_the_checkout_without_its_tests(built):
    with tarfile.open(built["sdist"]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    listed = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True)
    left_out = {name.partition("/")[0] for name in set(listed.stdout.split()) - names}
    assert left_out == {".ci", ".gitignore", "logs", "tests"}
    assert not {name for name in names if name.startswith("tests")}


@pytest.mark.parametrize("archive", ["wheel", "sdist"])
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13"])
def test_an_installation_registers_in_any_folder_as_here(version, archive, built, tmp_path):
    """To the bit: a stored recording, registered again by the installed package."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    pythons = [*pyenv.glob(f"versions/{version}.*/bin/python"), shutil.which(f"python{version}")]
    if pythons[0] is None:
        pytest.skip(f"Python {version} is not on this machine")
    subprocess.run([pythons[0], "-m", "venv", tmp_path / "venv"], check=True)
    path = tmp_path / "venv" / "bin"
    constraints = ["--constraint", REPOSITORY / "constraints.txt"]
    install = [path / "python", "-m", "pip", "install", "--quiet", built[archive], *constraints]
    given = {key: text for key, text in os.environ.items() if key != "PYTHONPATH"}
    given |= {"CHSEL_CACHE_DIR": str(tmp_path / "kernels")}
    subprocess.run(install, check=True, env=given)
    (tmp_path / "elsewhere").mkdir()
    options = {"cwd": tmp_path / "elsewhere", "env": given, "capture_output": True, "text": True}
    box = trimesh.creation.box((0.1, 0.06, 0.2))
    box.export(tmp_path / "elsewhere" / "box.stl")
    np.savez(tmp_path / "elsewhere" / "points.npz", surface=box.vertices[:6])
    overrides = ["session=points", "session.path=points.npz", "object=mesh", "object.path=box.stl"]
    overrides += ["method=chsel", "method.descent.restarts=1", "method.emitter.iterations=5"]
    done = subprocess.run([path / "chsel-probe", *overrides], **options)
    assert done.returncode == 0, done.stderr
    (recording,) = tmp_path.glob("elsewhere/logs/probe/*/recording.mcap")
    stored = REPOSITORY / "tests" / "replays" / "points_default_chsel.mcap"
    done = subprocess.run([path / "chsel-replay", "verify", recording, stored], **options)
    assert done.returncode == 0, done.stdout + done.stderr
    mistaken = subprocess.run([path / "chsel-replay", "colour=red"], **options)
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
