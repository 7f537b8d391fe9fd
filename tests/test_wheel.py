"""The project works when it is installed, from any folder."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of the checkout, unpacked as an installer does."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    files = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    for name in files:
        if (REPOSITORY / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((REPOSITORY / name).read_bytes())
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir", str(folder)]
    subprocess.run([sys.executable, "-m", "pip", "wheel", str(source), *options], check=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def test_the_wheel_holds_the_four_packages_their_data_and_no_tests(installed: Path) -> None:
    packages = {path.name for path in installed.iterdir() if not path.name.endswith("dist-info")}
    assert packages == {"chsel", "conf", "replay", "runners"}
    of_checkout = sorted((REPOSITORY / "conf").rglob("*.yaml"))
    names = {str(file.relative_to(REPOSITORY)) for file in of_checkout}
    assert names == {str(f.relative_to(installed)) for f in (installed / "conf").rglob("*.yaml")}


def test_the_installed_command_runs_in_any_folder(installed: Path, tmp_path: Path) -> None:
    box = trimesh.creation.box((0.1, 0.06, 0.2))
    box.export(tmp_path / "box.stl")
    np.savez(tmp_path / "points.npz", surface=box.vertices[:6])
    overrides = ["session=points", "session.path=points.npz", "object=mesh", "object.path=box.stl"]
    overrides += ["method.descent.restarts=1", "method.emitter.iterations=5"]
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    code = "import runners, sys; print(runners.__file__, file=sys.stderr)"
    where = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert str(installed) in where.stderr
    done = subprocess.run(
        [sys.executable, "-m", "runners.probe", *overrides],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    (recording,) = tmp_path.glob("logs/probe/*/recording.mcap")
    assert recording.stat().st_size > 1000
