"""`python -m runners.judge`, and what sessions say of a pose."""

import numpy as np
import pandas as pd
import pytest
import trimesh
import yaml

import chsel
from chsel.errors import PoseError
from chsel.problem.poses import axis_angle, compose
from runners import judge
from tests.chsel.samples import box_with_knob
from tests.runners.bop_dataset import POSES, write_bop
from tests.runners.in_process import run

SIDES = np.array([0.10, 0.06, 0.16])
Z = np.array([0.0, 0.0, 1.0])
TRUTH = compose(axis_angle(Z, np.array(0.4)), np.array([0.3, 0.1, 0.08]))
HALF_TURN = compose(axis_angle(Z, np.array(np.pi)), np.zeros(3))
BESIDE = compose(np.eye(3), np.array([0.03, 0.0, 0.0]))


@pytest.fixture(scope="module")
def mesh():
    return box_with_knob(SIDES)[0]


def touched(mesh, count):
    """Points all over the object where it is."""
    surface = mesh.copy().apply_transform(TRUTH)
    return trimesh.sample.sample_surface(surface, count, seed=1)[0]


def test_a_pose_is_confirmed_contradicted_or_one_of_several(mesh):
    with chsel.Session(mesh) as session:
        with pytest.raises(PoseError, match="nothing is registered yet"):
            session.judge(TRUTH)
        session.add(contacts=touched(mesh, 60))
        session.register()
        right = session.judge(TRUTH)
        assert right.verdict == "confirmed"
        assert right.others == 0
        assert right.farthest < 0.005
        assert right.inliers == 1.0
        assert right.above < 1.0
        for wrong in (BESIDE @ TRUTH, TRUTH @ HALF_TURN):
            judged = session.judge(wrong)
            assert judged.verdict == "contradicted"
            assert judged.above > 9.0
            assert judged.farthest > 0.005
        assert str(judged).startswith("contradicted (")
        with pytest.raises(PoseError, match="world_from_object"):
            session.judge(2.0 * TRUTH)
    with chsel.Session(trimesh.creation.box(SIDES), symmetry=chsel.ObjectSymmetry()) as session:
        session.add(contacts=touched(trimesh.creation.box(SIDES), 60))
        session.register()
        one_of_several = session.judge(TRUTH @ HALF_TURN)  # of a painted box
        assert one_of_several.verdict == "undecided"


def test_the_command_says_what_it_is_and_what_would_tell_more(mesh, tmp_path):
    mesh.export(tmp_path / "box.ply")
    np.savez(tmp_path / "few.npz", surface=touched(mesh, 60)[:5])
    np.savez(tmp_path / "many.npz", surface=touched(mesh, 60))
    pose = tmp_path / "pose.yaml"
    pose.write_text(yaml.safe_dump({"world_from_object": TRUTH.tolist()}))
    words = (f"object.path={tmp_path / 'box.ply'}", f"pose={pose}")
    done = run(judge.main, str(tmp_path / "many.npz"), *words)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"pose of {pose}: confirmed (" in done.stdout
    assert "what tells most" not in done.stdout
    done = run(judge.main, str(tmp_path / "few.npz"), *words)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"pose of {pose}: undecided (" in done.stdout
    assert "poses by the points: wide" in done.stdout
    assert "what tells most: a touch from (" in done.stdout


def test_results_of_the_bop_challenge_are_judged_by_depth(tmp_path):
    dataset = write_bop(tmp_path / "bop")
    rows = []
    for object_id, pose in POSES.items():
        for score, moved in ((0.9, 0.0), (0.5, 40.0)):  # millimetres across
            place = pose[:3, 3] + [moved, 0.0, 0.0]
            rows.append(
                {
                    "scene_id": 2,
                    "im_id": 7,
                    "obj_id": object_id,
                    "score": score,
                    "R": " ".join(map(str, pose[:3, :3].ravel())),
                    "t": " ".join(map(str, place)),
                    "time": -1,
                }
            )
    results = tmp_path / "results.csv"
    pd.DataFrame(rows).to_csv(results, index=False)
    done = run(judge.main, str(results), f"dataset={dataset}")
    assert (done.returncode, done.stderr) == (0, "")
    wrong = next(line for line in done.stdout.splitlines() if line.strip().startswith("wrong"))
    assert wrong.split()[1:5] == ["2", "2", "0", "0"]
    right = next(line for line in done.stdout.splitlines() if line.strip().startswith("right"))
    assert "contradicted" in done.stdout
    assert right.split()[-5:-3] == ["2", "0"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "accepted: either pose=FILE.yaml with world_from_object, or results"),
        (("pose=nowhere.yaml",), "pose file nowhere.yaml"),
        (("dataset=nowhere",), "results"),
    ],
)
def test_what_cannot_be_judged_is_one_line(tmp_path, words, message):
    np.savez(tmp_path / "points.npz", surface=np.zeros((3, 3)))
    done = run(judge.main, str(tmp_path / "points.npz"), *words)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
