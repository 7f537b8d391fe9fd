"""The prior in the settings of sessions and rigs, and in their recordings."""

from dataclasses import replace

import numpy as np
import pytest

from chsel.errors import SettingError
from chsel.problem.pose_prior import PosePrior
from chsel.problem.settings import build_settings
from replay.comparing.verification import EQUAL, verify
from replay.mcap.reader import read_recording
from runners import probe
from runners.sensors.rig import Rig
from runners.sessions import session_settings
from runners.sessions.sensors import SensorsSettings, SensorsSource
from tests.runners.box_session import points_session, recorded_box
from tests.runners.in_process import run
from tests.runners.sensors.sphere_log import RIG, SphereLog

UPRIGHT = {"axis": [0, 0, 1], "along": [0, 0, 1], "axis_noise": 0.09}
THERE = {"centre": [0.9, 0.0, 0.45], "centre_noise": 0.02}
QUICK = ("object.epsilon=0.002", "method=gradient_descent", "recording=mcap")


def digest(**given):
    return PosePrior(**given).digest


@pytest.mark.parametrize("kind", ["kinematic", "simulated", "points", "sensors"])
def test_every_kind_with_an_object_of_the_run_has_a_prior(kind):
    needed = {"points": {"path": "p.npz"}, "sensors": {"path": "log", "rig": {}}}.get(kind, {})
    if kind == "sensors":
        needed["rig"] = {"name": "rig", "world": "world"}
    assert session_settings(kind, needed).prior is None
    assert session_settings(kind, needed | {"prior": UPRIGHT}).prior == UPRIGHT
    with pytest.raises(SettingError, match=r"prior\.tilt does not exist; accepted: centre, "):
        session_settings(kind, needed | {"prior": {"tilt": 3}})


def test_the_prior_of_a_command_is_in_the_recording_and_in_its_problems(tmp_path):
    overrides = points_session(tmp_path, 2)
    text = "session.prior={axis:[0,0,1],along:[0,0,1],axis_noise:0.09}"
    done = run(probe.main, *overrides, *QUICK, text, f"logs={tmp_path / 'logs'}")
    assert done.returncode == 0, done.stderr
    (path,) = (tmp_path / "logs").rglob("recording.mcap")
    recording = read_recording(path)
    assert recording.start.config["session"]["prior"] == UPRIGHT
    assert recording.start.prior.digest == digest(**UPRIGHT)
    assert [recording.problem(k).prior.digest for k in (0, 1)] == [digest(**UPRIGHT)] * 2
    assert [verdict.outcome for verdict in verify(recording)] == [EQUAL, EQUAL]
    repeated = ("session=recorded", f"session.path={path}", *QUICK[1:])
    done = run(probe.main, *repeated, f"logs={tmp_path / 'again'}")
    assert done.returncode == 0, done.stderr
    (path,) = (tmp_path / "again").rglob("recording.mcap")
    assert read_recording(path).problem(1).digest == recording.problem(1).digest


def test_without_a_prior_a_recording_does_not_mention_it(tmp_path):
    recording = read_recording(recorded_box(tmp_path))
    assert recording.start.prior is None
    assert recording.problem(1).prior is None
    assert "prior" not in recording.start.config["session"]


def test_a_rig_has_a_prior_which_that_of_the_session_replaces(tmp_path):
    log = str(SphereLog().write(tmp_path / "log.mcap"))
    rig = replace(RIG, prior=THERE)
    assert SensorsSource(SensorsSettings(RIG, log), 0).prior is None
    assert SensorsSource(SensorsSettings(rig, log), 0).prior.digest == digest(**THERE)
    source = SensorsSource(SensorsSettings(rig, log, prior=UPRIGHT), 0)
    assert source.prior.digest == digest(**UPRIGHT)
    np.testing.assert_array_equal(source.prior.axis, [0.0, 0.0, 1.0])
    with pytest.raises(SettingError, match="rig: prior: the prior has centre without centre_noise"):
        build_settings(Rig, {"name": "rig", "world": "w", "prior": {"centre": [0]}}, where="rig")
