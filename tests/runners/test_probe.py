"""`python -m runners.probe`: what it prints, records and refuses."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_dir
from scipy.spatial.transform import Rotation

import chsel
from chsel.errors import MeshError
from chsel.events import Believed, Logged, Measured
from chsel.plausible.pose_metrics import result_numbers
from chsel.plausible.symmetry import object_symmetry
from chsel.session.judging import trust_by
from replay.comparing.beliefs import BeliefSequence
from replay.comparing.choices import recorded_method
from replay.mcap.reader import read_recording
from runners import probe
from runners.command.choices import CONF
from runners.run.display import MEANINGS
from tests.chsel.samples import REPOSITORY
from tests.runners.box_session import points_session
from tests.runners.in_process import run as in_process

QUICK = (
    "method.descent.restarts=2",
    "method.descent.iterations=20",
    "method.emitter.iterations=10",
    "recording.snapshot_interval=5",
    "method=chsel",
)


@pytest.fixture(scope="module")
def points(tmp_path_factory):
    """A session of three steps on a box: the overrides that select it."""
    return points_session(tmp_path_factory.mktemp("points"), probes=3)


def run(folder, *overrides):
    return in_process(probe.main, *overrides, f"logs={folder}", columns=120)


def run_folder(logs):
    (folder,) = (logs / "probe").iterdir()
    return folder


@pytest.fixture(scope="module")
def finished(points, tmp_path_factory):
    logs = tmp_path_factory.mktemp("logs")
    done = run(logs, *points, *QUICK)
    assert done.returncode == 0, done.stderr
    return run_folder(logs), done


def test_recorded_errors_are_modulo_symmetries(finished):
    recording = read_recording(finished[0] / "recording.mcap")
    symmetry = object_symmetry(recording.start.mesh)
    assert len(symmetry.rotations) == 4
    measured = [event for event in recording.events() if isinstance(event, Measured)]
    assert [event.step for event in measured] == [0, 1, 2]
    for event in measured:
        found, problem = recording.hypotheses(event.step), recording.problem(event.step)
        truth = recording.start.world_from_object
        trust = trust_by(recorded_method(recording).build(), problem, hypotheses=found)
        expected = result_numbers(
            found, problem, world_from_object=truth, symmetry=symmetry, trust=trust
        )
        assert event.values == pytest.approx(expected, abs=1e-6)


def test_trust_is_on_the_terminal_in_the_summary_and_in_the_log(finished):
    folder, done = finished
    recording = read_recording(folder / "recording.mcap")
    method = recorded_method(recording).build()
    trusts = [
        trust_by(method, recording.problem(n), hypotheses=recording.hypotheses(n)) for n in range(3)
    ]
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["trust"] == json.loads(json.dumps(asdict(trusts[2])))
    assert [step["verdict"] for step in summary["steps"]] == [trust.verdict for trust in trusts]
    logged = [event.text for event in recording.events() if isinstance(event, Logged)]
    assert logged[0] == f"probe 0: points, 5 contacts; {trusts[0]}"
    table = [line for line in done.stdout.splitlines() if line.rstrip().endswith(trusts[0].verdict)]
    assert table[0].split()[:2] == ["0", "5"]
    shown = " ".join(done.stdout.split())
    assert shown.endswith(f" {MEANINGS[trusts[2].verdict]}: {trusts[2]}")


def test_recorded_beliefs_follow_from_the_recorded_results(finished):
    recording = read_recording(finished[0] / "recording.mcap")
    told = [event for event in recording.events() if isinstance(event, Believed)]
    assert [event.step for event in told] == [0, 1, 2]
    beliefs = BeliefSequence(recording)
    for event in told:
        problem, found = recording.problem(event.step), recording.hypotheses(event.step)
        again = beliefs.after(problem, found).event(event.step)
        assert vars(again).keys() == vars(event).keys()
        for name, value in vars(again).items():
            np.testing.assert_array_equal(value, getattr(event, name))


def shown_pose(done, step):
    """The pose at the end of a run, world_from_object (4, 4), from millimetres and x y z w."""
    _, _, shown = done.stdout.partition(f"best pose after probe {step}, world_from_object")
    _, position, quaternion = shown.splitlines()[:3]
    assert position.endswith(" mm")
    assert quaternion.endswith(" (x y z w)")
    pose = np.eye(4)
    pose[:3, 3] = [0.001 * float(number) for number in position.split()[1:4]]
    pose[:3, :3] = Rotation.from_quat([*map(float, quaternion.split()[1:5])]).as_matrix()
    return pose


def test_a_run_ends_with_the_best_pose_and_its_summary_has_one_a_mode(finished):
    folder, done = finished
    recording = read_recording(folder / "recording.mcap")
    rows = json.loads((folder / "summary.json").read_text())["steps"]
    for step, row in enumerate(rows):
        found = recording.hypotheses(step)
        world = np.linalg.inv(found.object_from_world)
        trust = chsel.trust_in(recording.problem(step), found)
        np.testing.assert_allclose(row["world_from_object"], world[0], atol=1e-12)
        modes = world[[*trust.best_of_modes]]
        np.testing.assert_allclose(row["modes_world_from_object"], modes, atol=1e-12)
        assert len(modes) == max(trust.modes, 1)
    np.testing.assert_allclose(shown_pose(done, 2), rows[2]["world_from_object"], atol=2e-4)


def test_points_of_ones_own_are_registered_by_anchored_unless_a_method_is_named(
    points, finished, tmp_path
):
    done = run(tmp_path, *points, "method.size=small", "recording=none")
    assert done.returncode == 0, done.stderr
    line = "method=anchored (the default for session=points; method=chsel is the paper's)"
    assert done.stdout.splitlines()[1] == line
    summary = json.loads((run_folder(tmp_path) / "summary.json").read_text())
    assert summary["method"] == "anchored"
    assert "(the default for" not in finished[1].stdout


@pytest.mark.parametrize(
    ("overrides", "method"),
    [
        ((), "chsel"),
        (("session=kinematic", "preset=paper"), "chsel"),
        (("session=recorded",), "chsel"),
        (("session=recorded", "policy=information"), "anchored"),
        (("policy=nearest_mean", "preset=reference"), "chsel"),
        (("session=sensors",), "anchored"),
        (("session=points", "method=icp"), "icp"),
    ],
)
def test_the_default_method_follows_from_session_policy_and_preset(overrides, method):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        assert compose("probe", [*overrides]).method.name == method


def test_a_run_leaves_recordings_config_and_summary(finished):
    folder, done = finished
    names = {file.name for file in folder.iterdir()}
    assert names == {"recording.mcap", "recording.rrd", "config.yaml", "summary.json"}
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["outcome"] == "finished"
    recording = read_recording(folder / "recording.mcap")
    assert summary["recording_digest"] == recording.digest
    assert len(recording.digest) == 32
    assert [row["step"] for row in summary["steps"]] == [0, 1, 2]
    assert [row["contacts"] for row in summary["steps"]] == [5, 10, 15]
    assert set(summary["steps"][0]["seconds_by_stage"]) >= {"probe", "descent", "cma_mega"}
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["method"]["descent"]["iterations"] == 20
    assert done.stdout.count("\nprobe ") == 3
    title = " ".join(done.stdout.split())
    assert "errors to the true pose modulo the object's symmetries, at its centre: best" in title
    assert f"{folder}/\n" in done.stdout
    assert done.stderr == ""


def test_the_same_command_writes_the_same_bytes_and_no_path_or_clock(points, finished, tmp_path):
    command = [sys.executable, "-m", "runners.probe", *points, *QUICK, "logs=elsewhere"]
    tree = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    subprocess.run(command, cwd=tmp_path, env=tree, check=True, capture_output=True)
    again = (run_folder(tmp_path / "elsewhere") / "recording.mcap").read_bytes()
    assert again == (finished[0] / "recording.mcap").read_bytes()


def test_recording_snapshots_and_threads_change_no_result(points, finished, tmp_path):
    quick = [word for word in QUICK if "snapshot_interval" not in word]
    done = run(tmp_path, *points, *quick, "recording=none", "threads=2")
    assert done.returncode == 0, done.stderr
    folder = run_folder(tmp_path)
    assert {file.name for file in folder.iterdir()} == {"config.yaml", "summary.json"}
    assert json.loads((folder / "summary.json").read_text())["recording_digest"] is None
    digests = [
        [row["digest"] for row in json.loads((f / "summary.json").read_text())["steps"]]
        for f in (folder, finished[0])
    ]
    assert digests[0] == digests[1]


def test_a_recorded_session_repeats_the_probes_with_another_method(finished, tmp_path):
    source = finished[0] / "recording.mcap"
    chosen = ("session=recorded", f"session.path={source}", "method=gradient_descent", *QUICK[:2])
    done = run(tmp_path, *chosen, "recording=mcap")
    assert done.returncode == 0, done.stderr
    again = read_recording(run_folder(tmp_path) / "recording.mcap")
    before = read_recording(source)
    assert again.problem(2).points.digest == before.problem(2).points.digest
    assert again.start.sdf.digest == before.start.sdf.digest
    assert (again.start.object, again.steps) == ("mesh", before.steps)


@pytest.mark.usefixtures("interruptible")
def test_a_session_says_its_engine_and_is_replayed_without_any(tmp_path):
    quick = ("method=icp", "recording=mcap", "session.start_probe=10", "object=spam_can")
    done = run(tmp_path, *quick, "session.engine=mujoco")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("spam_can, simulated session in mujoco, icp, preset default")
    folder = run_folder(tmp_path)
    assert yaml.safe_load((folder / "config.yaml").read_text())["session"]["engine"] == "mujoco"
    path = folder / "recording.mcap"
    assert read_recording(path).start.config["session"]["engine"] == "mujoco"
    missing = "import sys; sys.modules |= dict.fromkeys(('mujoco', 'pybullet'))"
    verify = f"{missing}; sys.argv[1:] = ['verify', {str(path)!r}]"
    code = f"{verify}; from replay.__main__ import program; program()"
    verified = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "2 of 2 steps equal (icp)" in verified.stdout, verified.stderr
    refused = run(tmp_path, "session=kinematic", "session.engine=mujoco")
    assert refused.returncode == 2
    assert "session.engine has no effect: a kinematic session has no physics engine" in (
        refused.stderr
    )


def test_ctrl_c_ends_with_a_whole_recording_and_status_130(points, tmp_path):
    command = [sys.executable, "-m", "runners.probe", *points, f"logs={tmp_path}"]
    slow = ["method=chsel", "method.emitter.iterations=50000", "recording=mcap"]
    process = subprocess.Popen(command + slow, stdout=subprocess.PIPE, text=True)
    recordings: list[Path] = []
    while not recordings:
        assert process.poll() is None
        recordings = list(tmp_path.rglob("recording.mcap"))
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    output = process.communicate()[0]
    assert process.returncode == 130
    assert "interrupted: the recording holds everything up to here" in output
    recording = read_recording(recordings[0])
    assert recording.ended.outcome == "interrupted"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("+typo=3", "probe.typo does not exist; accepted: assets"),
        (
            "method.descent.iterations=9",
            "method=anchored has no key 'descent'; did you mean modes? accepted: size, ",
        ),
        ("method=chsel method.cst.alpha=1", "has no key 'cst'; did you mean cost? accepted: "),
        ("methd=chsel", "probe has no key 'methd'; did you mean method? accepted: "),
        ("definition=paper", "Could not override 'definition'. No match in the defaults list"),
        ("seed.x=1", "seed has no key 'x'; accepted: no key below it"),
        ("seed=${nothing}", "Interpolation key 'nothing' not found"),
        ("--config-name=nothing", "Cannot find primary config 'nothing'"),
        ("object=ycb/dril", "object/ycb has no option 'dril'; did you mean drill? accepted: "),
        ("method=chsel method.cost.free_scale=many", "free_scale is 'many'; accepted: a number"),
        ("seed=-1", "seed is -1; accepted: an integer from 0"),
        ("threads=10000", "threads is 10000; accepted: an integer from 1 to 256"),
        ("object.path=nothing.obj", "mesh file nothing.obj does not exist"),
        ("session.path=nothing.npz", "point file nothing.npz does not exist"),
        ("logs=/dev/null", "run folder /dev/null/probe"),
        ("seed=1=2{", "seed is '1=2{'; accepted: an integer"),
        ("seed", "'seed' is not a setting"),
        ("session=kinematic object=clamp configuration=drill", "'drill'; accepted: clamp, "),
        ("session=sensors session.rig.cameras.0.edge_reach=3", "accepted: +session.rig.cameras.0."),
        (
            "session=sensors session.path=no.mcap session.rig.contact.threshold=0.003",
            "log no.mcap does not exist",
        ),
        ("policy.probes=3", "policy.probes has no effect: without policy=NAME, or with grid, a se"),
        ("policy=grid policy.stop.spread=0.1", "; accepted: policy=expected_loss, or another, wi"),
        ("session=kinematic policy=random session.start_probe=9", "start_probe has no effect: a "),
        ("grasp.sure=0.5", "grasp.sure has no effect: grasp.path is not given; accepted: grasp.p"),
        ("recording=none recording.timings=true", "recording.timings has no effect: nothing is r"),
        ("session=recorded session.path=a object=drill", "object has no effect: a recorded sessi"),
        ("configuration=clamp", "configuration has no effect: a session of kind points has its o"),
        ("object=drill object.path=bracket.obj", "accepted: object=mesh object.path=bracket.obj"),
        (
            "session=kinematic object.scan=035_power_drill",
            "not of a scan; accepted: object=ycb/NAME",
        ),
        ("object=bracket.obj", "accepted: object=mesh object.path=bracket.obj"),
        ("object=parts/bracket.STL", "accepted: object=mesh object.path=parts/bracket.STL"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(points, tmp_path, override, message):
    chosen = () if override.startswith("session=") else points
    logs = () if override.startswith("logs=") else (f"logs={tmp_path}",)
    done = in_process(probe.main, *logs, *chosen, *override.split())
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert not list(tmp_path.rglob("*"))


def test_traceback_is_shown_when_asked_for(points, tmp_path):
    with pytest.raises(MeshError):  # which Python prints with its traceback
        run(tmp_path, *points, "object.path=nothing.obj", "--traceback")
