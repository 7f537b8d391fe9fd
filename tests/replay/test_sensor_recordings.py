"""What the commands say of the recording of a robot session, which has a rig and images."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from replay.__main__ import main
from replay.events import RigDescribed, SensorImage
from replay.mcap.reader import read_recording
from replay.verbs.accept import write_accepted
from tests.replay.conftest import same_bits
from tests.tools.small_recordings import robot_session, write_recording


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("robot") / "robot.mcap"
    write_recording(found, robot_session("gradient_descent"))
    return found


def test_it_is_verified_stepped_and_compared(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["verify", str(path)]) == 0
    assert main(["step", str(path), "--step", "1", "-o", str(tmp_path / "step.mcap")]) == 0
    assert [probe.step for probe in read_recording(tmp_path / "step.mcap").probes] == [0, 1]
    assert main(["compare", str(path), "--methods", "gradient_descent"]) == 0
    capsys.readouterr()


def test_accepting_it_keeps_its_rig_and_images(path: Path, tmp_path: Path) -> None:
    new = tmp_path / "new.mcap"
    write_accepted(read_recording(path), new)
    kept, before = (list(read_recording(file).events()) for file in (new, path))
    of_sensors = [event for event in before if isinstance(event, RigDescribed | SensorImage)]
    found = [event for event in kept if isinstance(event, RigDescribed | SensorImage)]
    assert len(found) == 5
    assert all(map(same_bits, found, of_sensors))


def test_it_is_viewed(path: Path, tmp_path: Path) -> None:
    assert main(["view", str(path), "--save", str(tmp_path / "a.rrd")]) == 0
    assert (tmp_path / "a.rrd").stat().st_size > 10_000


def test_images_are_exported_as_they_are(path: Path, tmp_path: Path) -> None:
    expected = list(read_recording(path).sensor_images())
    for suffix in ("npz", "csv", "json"):
        out = str(tmp_path / f"out.{suffix}")
        assert main(["export", str(path), "--what", "images", "-o", out]) == 0
    with np.load(tmp_path / "out.npz", allow_pickle=False) as found:
        assert found["steps"].tolist() == [0, 1]
        for event in expected:
            folder = f"step_{event.step}/{event.sensor}_0"
            for name in ("values", "mask", "intrinsics", "world_from_camera"):
                assert found[f"{folder}/{name}"].tobytes() == getattr(event, name).tobytes()
            assert found[f"{folder}/unit"] == event.unit
        assert len(found.files) == 1 + 5 * len(expected)
    with (tmp_path / "out.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["step"], row["sensor"], row["kind"]) for row in rows] == [
        (str(event.step), event.sensor, event.kind) for event in expected
    ]
    assert [int(row["counting"]) for row in rows] == [int(e.mask.sum()) for e in expected]
    document = json.loads((tmp_path / "out.json").read_text())
    assert [row["fx"] for row in document] == [9.0] * 4


def test_images_of_single_steps_are_exported(path: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.npz"
    assert main(["export", str(path), "--what", "images", "-o", str(out), "--steps", "1"]) == 0
    with np.load(out) as found:
        assert {name.split("/")[0] for name in found.files} == {"steps", "step_1"}
    assert main(["export", str(path), "--what", "images", "-o", str(out), "--steps", "7"]) == 2
