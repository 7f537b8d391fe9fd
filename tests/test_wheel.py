"""The project works when it is installed, from any folder: packages, scripts, completion."""

import os
import re
import shutil
import socket
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
from tests.runners.sensors.test_depth_frame import written as depth_frame

pytestmark = pytest.mark.slow
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
SCRIPTS = tuple(PROJECT["scripts"])
VERSIONS = ("3.11", "3.12", "3.13", "3.14")
OF_BOX = "session=points session.path=points.npz object=mesh object.path=box.stl"
SMALL = "method=gradient_descent method.descent.restarts=1 method.descent.iterations=5"
LAUNCHED = f"chsel-probe -m {OF_BOX} {SMALL} seed=0,1 recording=mcap hydra/launcher="
EXTRAS = {  # what docs/start.md, the pages named there and README.md say that each is for
    "torch": "python torch_cost.py",
    "sim": f"chsel-probe object=spam_can {SMALL}; python -c 'import pooch'",
    "files": f"chsel-probe session=points session.path=points.pcd object=mesh "
    f"object.path=cylinder.step {SMALL}",
    "sensors": "chsel-probe session=sensors session.path=frame.yaml session/rig=depth_frame "
    f"object=mesh object.path=box.stl {SMALL}",
    "evaluate": "chsel-evaluate experiment=smoke configurations=can methods=icp steps=5; "
    f"chsel-report logs/evaluation/smoke; chsel-probe {OF_BOX} {SMALL}; "
    "chsel-replay compare logs/probe/*/recording.mcap --methods icp --save-plot compared.png",
    "serve": "chsel-serve port=PORT & trap 'kill -INT $!; wait' EXIT; "
    "until python serve_client.py PORT; do kill -0 $!; sleep 1; done",
    "notebook": "ipython run_notebook.py",
    "slurm": "python -c 'import dask_jobqueue, runners.evaluate'",
    "sweep-joblib": f"{LAUNCHED}joblib",
    "sweep-submitit": f"{LAUNCHED}submitit_local",
}
TORCH_COST = """
import chsel, torch, trimesh
sdf = chsel.SdfGrid.from_mesh(trimesh.creation.box((0.1, 0.1, 0.1)), 0.01)
cost = chsel.RelaxedCost(sdf, chsel.KnownPoints(known=[[0.05, 0.0, 0.0]]))
"""
PCD = """VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH 3
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 3
DATA ascii
0.0254 0 0
0 0.0254 0
0 0 0.0254
"""
RUN_NOTEBOOK = """
import json
from IPython import get_ipython
for cell in json.load(open("from_contacts_to_modes.ipynb"))["cells"]:
    if cell["cell_type"] == "code":
        get_ipython().run_cell("".join(cell["source"])).raise_error()
"""


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
    for pattern in ("conf/**/*.yaml", "runners/**/*.ply", "runners/results/*/*", "replay/*.json"):
        names = {str(file.relative_to(REPOSITORY)) for file in REPOSITORY.glob(pattern)}
        assert names
        assert names == {str(file.relative_to(site)) for file in site.glob(pattern)}


def test_the_sdist_has_the_checkout_without_its_tests(built):
    with tarfile.open(built["sdist"]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    listed = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True)
    left_out = {name.partition("/")[0] for name in set(listed.stdout.split()) - names}
    settings = {".ci", ".gitignore", ".pre-commit-config.yaml"}
    assert left_out == settings | {"findings", "logs", "tests"}
    assert not {name for name in names if name.startswith("tests")}


def installed(archive, version, *, folder):
    """The scripts of an installation in an environment of its own, and how to run them."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    pythons = [*pyenv.glob(f"versions/{version}.*/bin/python"), shutil.which(f"python{version}")]
    if pythons[0] is None:
        pytest.skip(f"Python {version} is not on this machine")
    subprocess.run([pythons[0], "-m", "venv", folder / "venv"], check=True)
    path = folder / "venv" / "bin"
    constraints = ["--constraint", REPOSITORY / "constraints.txt"]
    install = [path / "python", "-m", "pip", "install", "--quiet", archive, *constraints]
    given = {key: text for key, text in os.environ.items() if key != "PYTHONPATH"}
    given |= {"CHSEL_CACHE_DIR": str(folder / "kernels"), "PATH": f"{path}{os.pathsep}{os.defpath}"}
    subprocess.run(install, check=True, env=given)
    (folder / "elsewhere").mkdir()
    return path, {
        "cwd": folder / "elsewhere",
        "env": given,
        "capture_output": True,
        "text": True,
    }


@pytest.mark.parametrize("archive", ["wheel", "sdist"])
@pytest.mark.parametrize("version", VERSIONS)
def test_an_installation_registers_in_any_folder_as_here(version, archive, built, tmp_path):
    """To the bit: a stored recording, registered again by the installed package."""
    path, options = installed(built[archive], version, folder=tmp_path)
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


@pytest.mark.parametrize("extra", EXTRAS)
@pytest.mark.parametrize("version", VERSIONS)
def test_an_extra_alone_does_what_it_is_for(version, extra, built, tmp_path):
    _, options = installed(f"{built['wheel']}[{extra}]", version, folder=tmp_path)
    folder = options["cwd"]
    box = trimesh.creation.box((0.1, 0.06, 0.2))
    box.export(folder / "box.stl")
    np.savez(folder / "points.npz", surface=box.vertices[:6])
    depth_frame(folder)
    (folder / "torch_cost.py").write_text(TORCH_COST)
    (folder / "run_notebook.py").write_text(RUN_NOTEBOOK)
    (folder / "points.pcd").write_text(PCD)
    shutil.copy(REPOSITORY / "tests/chsel/problem/cylinder_inch.step", folder / "cylinder.step")
    for name in ("from_contacts_to_modes.ipynb", "own_robot.py", "serve_client.py"):
        shutil.copy(REPOSITORY / "examples" / name, folder)
    with socket.create_server(("127.0.0.1", 0)) as free:
        command = EXTRAS[extra].replace("PORT", str(free.getsockname()[1]))
    options["env"] |= {"CHSEL_TOKEN": "a token", "MPLBACKEND": "agg"}
    done = subprocess.run(["bash", "-e", "-c", command], **options)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_extra_for_users_is_tried():
    developers = {"all", "docs", "mutants", "test"}
    assert set(PROJECT["optional-dependencies"]) == {*EXTRAS, *developers}


def test_every_command_has_a_script_and_each_names_its_version(ran):
    commands = {file.stem for file in (REPOSITORY / "conf").glob("*.yaml")}
    assert set(SCRIPTS) == {f"chsel-{name.replace('_', '-')}" for name in commands | {"replay"}}
    for script in SCRIPTS:
        done = ran(script, "--version")
        assert (done.returncode, done.stdout) == (0, f"chsel-replay {PROJECT['version']}\n")


def test_the_benchmark_is_ranked_in_any_folder(ran):
    kept = REPOSITORY / "runners" / "results"
    done = ran("chsel-rank", str(kept / "anchored"))
    assert done.returncode == 0, done.stderr
    assert re.match(r"(\d+) of \1 rows that both have are the same to the bit\n", done.stdout)
    assert "ratio to" in done.stdout


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    for key in ("version", "license"):
        assert citation[key] == PROJECT[key]
