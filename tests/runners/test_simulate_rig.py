"""The command that simulates the raw log of a rig."""

import numpy as np
import pytest
import yaml

from chsel.problem.settings import build_settings
from runners import simulate_rig
from runners.command.choices import CONF
from runners.objects.loader import load_model
from runners.sensors.rig import Rig
from runners.simulated_robot.cabinet import (
    CABINET_CONFIGURATIONS,
    CABINET_WORKSPACE,
    CAP,
    CAP_BASE,
    rigid_parts,
    stood_on_shelf,
)
from runners.simulated_robot.simulation import WORLD, WRIST
from tests.runners.in_process import run

SHORT = ("probes=1", "push_steps=1", "standing=0.1", "dwell=0.1")
QUICK = (*SHORT, "camera.width=32", "bubbles.width=32")


def test_a_log_and_its_truth_are_written(tmp_path):
    log = tmp_path / "new" / "log.mcap"
    done = run(simulate_rig.main, f"out={log}", "configuration=cabinet_mustard", "seed=4", *QUICK)
    assert done.returncode == 0, done.stderr
    assert sorted(file.name for file in log.parent.iterdir()) == ["log.mcap", "log.truth.yaml"]
    truth = yaml.safe_load(log.with_suffix(".truth.yaml").read_text())
    pose = stood_on_shelf(load_model("mustard"), CABINET_CONFIGURATIONS["cabinet_mustard"])
    assert np.allclose(truth.pop("world_from_object"), pose, atol=1e-12)
    about = {"configuration": "cabinet_mustard", "object": "mustard", "scale": 1.0, "seed": 4}
    assert truth == about
    assert "probe   0  y" in done.stdout
    assert "nothing touched" in done.stdout

    before = log.read_bytes()
    other = ("configuration=cabinet_mustard", "seed=5", *QUICK)
    again = run(simulate_rig.main, f"out={log}", *other)
    assert again.returncode == 2
    assert "exists; accepted: another out=FILE.mcap, or overwrite=true" in again.stderr
    assert log.read_bytes() == before
    again = run(simulate_rig.main, f"out={log}", "overwrite=true", *other)
    assert again.returncode == 0, again.stderr
    assert log.read_bytes() != before
    again = run(simulate_rig.main, f"out={log / 'x.mcap'}", *QUICK)
    assert again.returncode == 2
    assert "x.mcap cannot be written" in again.stderr
    assert "accepted: a file in a folder that can be written" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "out is None; accepted: the name of a file, out=FILE.mcap"),
        (("out=x.mcap", "configuration=drill"), "accepted: cabinet_drill, cabinet_drill_opposite"),
        (("out=x.mcap", "probes=7"), "probes is 7; accepted: 1 to 6"),
        (("out=x.mcap", "camera.width=4"), "width is 4; accepted: 16 to 4096"),
        (("out=x.mcap", "drop=1"), "drop is 1.0; accepted: 0 to 0.9"),
        (("out=x.mcap", "push_steps=9"), "push_steps is 9; accepted: 1 to 5"),
        (("out=x.mcap", "object=drill", "object.scale=2.5"), "more than the cabinet has"),
    ],
)
def test_a_mistake_is_one_line(arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run(simulate_rig.main, *arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_rig_of_the_cabinet_describes_the_twin():
    values = yaml.safe_load((CONF / "session" / "rig" / "cabinet.yaml").read_text())
    rig = build_settings(Rig, values, where="rig")
    assert rig.world == WORLD
    assert rig.box().lower == CABINET_WORKSPACE.lower
    assert rig.box().upper == CABINET_WORKSPACE.upper
    assert rig.hand.frame == WRIST
    for box, part in zip(rig.hand.boxes, rigid_parts(), strict=True):
        assert np.allclose(box.size, part.size)
        assert np.allclose(box.position, part.position, atol=1e-6)
        assert np.allclose(box.rotation, part.rotation, atol=1e-6)
    for bubble in rig.bubbles:
        assert bubble.range[0] < CAP_BASE < CAP_BASE + CAP[2] < bubble.range[1]
