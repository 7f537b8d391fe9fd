"""Evaluations of sessions whose raw logs are read: which there are, and their true poses."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from chsel.errors import SettingError
from chsel.events import RigDescribed, Start
from chsel.plausible.pose_scan import TruePoseSettings
from chsel.plausible.symmetry import object_symmetry
from chsel.problem.poses import compose, inverse, roll_pitch_yaw, rotation_angle, rotation_vector
from replay.mcap.reader import read_recording
from runners import evaluate
from runners.command.choices import CONF
from runners.evaluation.plan import Task, Trial
from runners.evaluation.trial_configurations import chosen_names, configurations_of
from runners.evaluation.trial_session import open_recorded, read_told
from runners.evaluation.true_poses import TRUTH, as_set_by_hand, check_log, guessed_pose, is_missing
from runners.sensors.pose_file import beside, read_pose, write_pose
from tests.runners.in_process import do_task, run
from tests.runners.test_evaluation import plan_in

CABINET = ["cabinet_drill", "cabinet_drill_opposite", "cabinet_mustard", "cabinet_mustard_sideways"]
POSE = compose(rotation_vector(np.array([0.31, -0.4, 1.1])), np.array([0.913, -0.046, 0.338]))


def sensors_plan(folder, **changes):
    """A plan of sessions of the simulated robot's rig."""
    rig = yaml.safe_load((CONF / "session" / "rig" / "cabinet.yaml").read_text())
    session = {"kind": "sensors", "rig": rig, "start_contacts": 1, "start_probe": 0}
    truth = TruePoseSettings(reach=0.02, spacing=0.01, rotations=200, angle=0.05, passes=2)
    return replace(plan_in(folder), session=session, steps=None, truth=truth, **changes)


def own_logs(folder, **objects):
    """A folder of logs of one's own, which are empty files here."""
    for name, values in objects.items():
        (folder / name).mkdir(parents=True)
        (folder / name / "object.yaml").write_text(yaml.safe_dump(values))
        (folder / name / "seed_0.mcap").touch()
    return folder


def test_configurations_are_simulated_unless_there_are_logs_of_ones_own(tmp_path):
    assert list(configurations_of("sensors")) == CABINET
    assert [one.probes for one in configurations_of("sensors").values()] == [6, 6, 6, 6]
    (tmp_path / "cabinet_drill").mkdir()
    assert list(configurations_of("sensors", tmp_path)) == CABINET
    own_logs(tmp_path, shelf={"name": "mustard"}, table={"name": "ycb/drill"})
    own = configurations_of("sensors", tmp_path)
    assert list(own) == ["cabinet_drill", "shelf", "table"]
    assert [own[name].object for name in own] == ["drill", "mustard", "drill"]
    assert own["shelf"].probes is None
    objects = {name: one.object for name, one in own.items()}
    assert chosen_names("configurations", "drill", existing=own, objects=objects) == (
        "cabinet_drill",
        "table",
    )
    with pytest.raises(SettingError, match="configurations names 'box'; accepted: all, an object"):
        chosen_names("configurations", "box", existing=own, objects=objects)


def test_objects_of_logs_are_of_real_size_unless_their_file_says_otherwise(tmp_path):
    plan = sensors_plan(tmp_path)
    assert plan.object_config("cabinet_drill").scale == 1.0
    assert plan.object_config("cabinet_drill").epsilon == 0.001
    assert plan.object_config("cabinet_mustard").epsilon == 0.0003
    assert replace(plan, objects="scans").object_config("cabinet_drill").kind == "scan"
    jug = {"name": "jug", "path": "jug.ply", "scale": 0.001, "epsilon": 0.002}
    logs = own_logs(tmp_path / "logs", a={"name": "mustard"}, b={"name": "ycb/drill"}, c=jug)
    own = sensors_plan(tmp_path, logs=logs)
    assert (own.object_config("a").name, own.object_config("a").scale) == ("mustard", 1.0)
    assert own.object_config("b").scan == "035_power_drill"
    assert own.object_config("c").path == str(logs / "c" / "jug.ply")
    assert (own.object_config("c").scale, own.object_config("c").epsilon) == (0.001, 0.002)
    assert own.steps_of("a")[:2] == (0, 1)
    assert replace(own, steps="3..5").steps_of("a") == (3, 4, 5)
    drill = replace(plan, steps="1,4,9")
    assert drill.steps_of("cabinet_drill") == (1, 4), "those of the steps that it has"


def test_a_folder_of_logs_must_name_its_object(tmp_path):
    (tmp_path / "shelf").mkdir()
    with pytest.raises(
        SettingError, match=r"object.yaml: cannot .*; accepted: a choice of object="
    ):
        configurations_of("sensors", tmp_path)
    (tmp_path / "shelf" / "object.yaml").write_text("{}")
    with pytest.raises(SettingError, match=r"object.yaml has no name"):
        configurations_of("sensors", tmp_path)
    with pytest.raises(SettingError, match=r"session.logs is .*none; accepted: a folder with"):
        configurations_of("sensors", tmp_path / "none")


def test_logs_of_ones_own_need_a_guess_and_simulated_ones_are_made(tmp_path):
    logs = own_logs(tmp_path / "logs", shelf={"name": "mustard"})
    plan = sensors_plan(tmp_path, logs=logs)
    trial = Trial(0, "shelf")
    assert not is_missing(plan, trial)
    with pytest.raises(SettingError, match=r"no seed_0.pose.yaml beside .*: .*runners.align"):
        check_log(plan, trial)
    with pytest.raises(SettingError, match=r"no .*seed_7.mcap; accepted: seeds of which"):
        check_log(plan, Trial(7, "shelf"))
    write_pose(beside(trial.log(plan)), POSE, about={})
    check_log(plan, trial)
    np.testing.assert_allclose(guessed_pose(trial.log(plan)), POSE, atol=1e-12)
    (logs / "shelf" / "seed_1").mkdir()
    assert Trial(1, "shelf").log(plan) == logs / "shelf" / "seed_1"
    simulated = sensors_plan(tmp_path)
    assert is_missing(simulated, Trial(0, "cabinet_drill"))
    check_log(simulated, Trial(0, "cabinet_drill"))
    assert trial.log(simulated) == simulated.folder / "logs" / "shelf" / "seed_0.mcap"


def test_a_pose_set_by_hand_is_near_the_truth_but_not_it():
    hand = as_set_by_hand(POSE)
    np.testing.assert_allclose(hand[:3, 3], [0.91, -0.05, 0.34], atol=1e-12)
    assert 0.0 < rotation_angle((inverse(POSE) @ hand)[:3, :3]) < 0.16
    turned = compose(roll_pitch_yaw(np.deg2rad([12.0, -23.0, 88.0])), np.zeros(3))
    rounded = roll_pitch_yaw(np.deg2rad([10.0, -20.0, 90.0]))
    np.testing.assert_allclose(as_set_by_hand(turned)[:3, :3], rounded, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("session=kinematic", "session.logs=LOGS"), "session.logs is for session=sensors"),
        (("session=sensors", "session.logs=LOGS", "seeds=0"), "no seed_0.pose.yaml beside it"),
        (("session=sensors", "session.logs=LOGS", "seeds=4"), "seed_4.mcap; accepted: seeds"),
    ],
)
def test_an_evaluation_of_logs_that_cannot_be_is_one_line(tmp_path, arguments, message):
    logs = own_logs(tmp_path / "logs", shelf={"name": "mustard"})
    words = [word.replace("LOGS", str(logs)) for word in arguments]
    done = run(evaluate.main, *words, f"out={tmp_path / 'out'}")
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_trial_gets_its_log_its_true_pose_and_its_results(tmp_path, monkeypatch):
    from runners.simulated_robot.settings import BubbleSettings, CameraSettings, RobotSettings

    small = RobotSettings(
        probes=2, camera=CameraSettings(width=96), bubbles=BubbleSettings(width=96)
    )
    monkeypatch.setattr("runners.evaluation.true_poses.RobotSettings", lambda: small)
    plan = sensors_plan(tmp_path)
    trial = Trial(0, "cabinet_drill")
    assert do_task(plan, Task(trial)) == ""
    log = trial.log(plan)
    assert {file.name for file in log.parent.iterdir()} == {"seed_0.mcap", f"seed_0{TRUTH}"}
    truth = read_pose(log.with_name(f"seed_0{TRUTH}"))
    recording = read_recording(trial.folder(plan) / "session.mcap")
    found = recording.start.world_from_object
    assert np.abs(found[:3, 3] - as_set_by_hand(truth)[:3, 3]).max() < 0.035
    assert any(isinstance(event, RigDescribed) for event in recording.events())
    assert str(tmp_path) not in json.dumps(dict(recording.start.config))
    assert len(recording.probes) == 2
    told = read_told(trial.folder(plan))["truth"]
    assert told["mean_distance"] < 0.01
    centre = np.array([*object_symmetry(recording.start.mesh).centre, 1.0])
    apart = np.linalg.norm((found @ centre - truth @ centre)[:3])
    assert told["from_known"]["position"] == pytest.approx(apart, abs=1e-9)
    session = open_recorded(plan, trial)
    assert session.start == Start(contacts=1)
    elsewhere = replace(plan, folder=tmp_path / "again", logs=log.parents[1])
    assert do_task(elsewhere, Task(trial)) == ""
    first, second = (trial.folder(one) / "session.mcap" for one in (plan, elsewhere))
    assert first.read_bytes() == second.read_bytes()
    log.with_name(f"seed_0{TRUTH}").unlink()
    assert is_missing(plan, trial)
