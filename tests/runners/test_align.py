"""The command that finds the true pose of a recorded object near a guess."""

import shutil

import numpy as np
import pytest
import yaml

from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_settings import EvaluationCostSettings
from chsel.problem.mesh import clean_mesh
from chsel.problem.poses import inverse
from replay.files import file_digest
from replay.mcap.reader import read_recording
from runners import align, plausible
from runners.objects.loader import load_model
from runners.sensors.pose_file import beside, read_pose
from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS
from runners.simulated_robot.settings import BubbleSettings, CameraSettings, RobotSettings
from tests.runners.box_session import POSE, recorded_box
from tests.runners.in_process import run

NEAR = ("position=[0.12,0.19,0.31]", "rotation=[0,0,0.46]")
SEARCH = ("search.reach=0.03", "search.rotations=200", "search.angle=0.04")
SETS = ("definition.grid.rotations=200", "definition.grid.upright=0")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording of points on a box whose pose nobody told."""
    recording = recorded_box(tmp_path_factory.mktemp("align"), contacts=30, world_from_object=None)
    assert read_recording(recording).start.world_from_object is None
    return recording


@pytest.fixture
def path(recorded, tmp_path):
    """The same, where nothing else is yet."""
    path = tmp_path / "session.mcap"
    shutil.copyfile(recorded, path)
    return path


def aligned(path, *arguments):
    return run(align.main, str(path), *SEARCH, *arguments)


def test_the_pose_is_found_near_a_guess_and_written_with_a_picture(path):
    done = aligned(path, *NEAR)
    assert (done.returncode, done.stderr) == (0, "")
    assert sorted(file.name for file in path.parent.iterdir()) == [
        "session.mcap",
        "session.pose.rrd",
        "session.pose.yaml",
    ]
    about = yaml.safe_load(path.with_name("session.pose.yaml").read_text())
    found = read_pose(path.with_name("session.pose.yaml"))
    away = inverse(POSE) @ found
    assert np.abs(away[:3, 3]).max() < 0.005
    assert np.arccos((np.trace(away[:3, :3]) - 1.0) / 2.0) < 0.06
    problem = read_recording(path).problem(1)
    cost = EvaluationCost(problem, EvaluationCostSettings())
    costs = cost.evaluate(inverse(np.stack([found, POSE])))
    assert about["cost"] == pytest.approx(costs[0], rel=1e-9)
    assert about["cost"] <= costs[1] + 1e-3
    assert about["cost"] < about["guess_cost"] / 3.0
    assert about["source"] == file_digest(path)
    assert about["search"]["rotations"] == 200
    guess = np.array(about["guess"])
    np.testing.assert_allclose(guess[:3, 3], [0.12, 0.19, 0.31])
    moved = 1000.0 * np.linalg.norm(found[:3, 3] - guess[:3, 3])
    assert f"moved from the guess by {moved:.1f} mm" in done.stdout
    assert "warning" not in done.stdout


def test_the_found_pose_is_the_next_guess_and_what_is_there_stays(path):
    assert aligned(path, *NEAR).returncode == 0
    there = path.with_name("session.pose.yaml")
    before = there.read_bytes()
    refused = aligned(path, f"pose={there}")
    assert refused.returncode == 2
    assert "session.pose.yaml exists; accepted: overwrite=true" in refused.stderr
    assert there.read_bytes() == before
    again = aligned(path, f"pose={there}", "overwrite=true")
    assert (again.returncode, again.stderr) == (0, "")
    about = yaml.safe_load(there.read_text())
    assert about["guess_cost"] == pytest.approx(yaml.safe_load(before)["cost"], rel=1e-9)
    assert about["cost"] <= about["guess_cost"]


def test_plausible_sets_are_made_around_the_pose_beside_a_recording(path):
    refused = run(plausible.main, str(path), *SETS)
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1
    assert f"python -m runners.align {path} position=[x,y,z]" in refused.stderr
    assert aligned(path, *NEAR).returncode == 0
    done = run(plausible.main, str(path), *SETS)
    assert (done.returncode, done.stderr) == (0, "")
    x, y, z = read_pose(path.with_name("session.pose.yaml"))[:3, 3]
    assert f"around ({x:.3f}, {y:.3f}, {z:.3f}) m" in done.stdout


def test_a_raw_log_is_read_first_and_its_object_is_named(tmp_path):
    from runners.simulated_robot.simulation import simulate_log

    log = tmp_path / "log.mcap"
    small = RobotSettings(
        probes=1, camera=CameraSettings(width=96), bubbles=BubbleSettings(width=96)
    )
    model = load_model("mustard")
    mesh = clean_mesh(model.vertices, model.faces, name="mustard", scale=1.0)
    made = simulate_log(
        log, CABINET_CONFIGURATIONS["cabinet_mustard"], mesh=mesh, seed=0, settings=small
    )
    x, y, z = (float(value) for value in made.world_from_object[:3, 3] + [0.01, 0.0, 0.005])
    yaw = float(np.arctan2(made.world_from_object[1, 0], made.world_from_object[0, 0]))
    guess = (f"position=[{x},{y},{z}]", f"rotation=[0,0,{yaw}]")
    done = aligned(log, *guess, "session/rig=cabinet", "object=mustard", "object.scale=1")
    assert (done.returncode, done.stderr) == (0, "")
    assert "mustard, after probe 0: 50 contacts" in done.stdout
    about = yaml.safe_load(beside(log).read_text())
    assert about["cost"] < about["guess_cost"]
    assert about["mean_distance"] < 0.004
    assert about["source"] == file_digest(log)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "accepted: either position=[x,y,z] rotation=[roll,pitch,yaw]"),
        ((*NEAR, "pose=some.yaml"), "accepted: either position=[x,y,z]"),
        (("position=[0,0,nan]",), "is not finite"),
        (("pose=none.yaml",), "pose file none.yaml: cannot be read"),
    ],
)
def test_what_cannot_be_searched_is_one_line(path, arguments, message):
    done = run(align.main, str(path), *arguments)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert message in done.stderr
    assert len(list(path.parent.iterdir())) == 1
