"""The command that registers real measurements: on made-up ones, and on some of the real ones."""

import csv
import json

import numpy as np
import pytest
import trimesh

from chsel.problem.poses import apply, axis_angle, compose
from runners import real
from tests.runners.in_process import run

NOISE = 0.0005  # m
POSE = compose(axis_angle(np.array([0.0, 0.0, 1.0]), 0.4), np.array([0.5, 0.1, 0.2]))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Touches of two boxes, those of `known` with the true pose."""
    folder = tmp_path_factory.mktemp("data") / "real"
    folder.mkdir()
    box = trimesh.creation.box((0.06, 0.09, 0.15))
    box.export(folder / "box.obj")
    touches, _ = trimesh.sample.sample_surface(box, 41, seed=0)
    touches = apply(POSE, touches + np.random.default_rng(0).normal(0.0, NOISE, touches.shape))
    np.savez(folder / "known.npz", surface=touches, world_from_object=POSE)
    np.savez(folder / "unknown.npz", surface=touches)
    np.savez(folder / "one.npz", surface=touches[:1])
    return folder.parent


def measured(data, out, *arguments, case="known"):
    made = [f"+cases.{case}.path={case}.npz", f"+cases.{case}.mesh=box.obj", f"only={case}"]
    return run(real.main, f"data={data}", f"out={out}", "methods=icp", *made, *arguments)


def rows(out):
    with (out / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_rows_have_errors_to_the_pose_and_residuals_of_the_held_out_half(data, tmp_path):
    done = measured(data, tmp_path, "seeds=0..1")
    assert (done.returncode, done.stderr) == (0, "")
    *found, published = rows(tmp_path)
    assert (published["method"], published["points"]) == ("(published)", "all")
    assert 0.5 * NOISE < float(published["residual"]) < 1.2 * NOISE
    places = [(row["seed"], row["points"], row["touches"]) for row in found]
    assert places == [(seed, *of) for seed in "01" for of in (("all", "41"), ("half", "21"))]
    for row in found:
        assert row["case"] == "known"
        # ICP meets sampled points of the surface, which are some millimetres apart.
        assert 0.3 * NOISE < float(row["residual"]) < 0.005
        assert (row["held_out"] == "") == (row["points"] == "all")
        right = float(row["position_error"]) <= 0.005 and float(row["rotation_error"]) < 0.08727
        assert row["right"] == str(right).lower()
        assert row["truth_held"] == ""
    made = json.loads((tmp_path / "made.json").read_text())
    assert made["environments"][0]["package numpy"] == np.__version__
    held = [row["held_out"] for row in found if row["points"] == "half"]
    assert held[0] != held[1]  # of other halves
    assert all(0.3 * NOISE < float(value) < 0.02 for value in held)
    lines = done.stdout.splitlines()
    assert any(line.split()[:3] == ["known", "icp", "41"] for line in lines)
    table = lines[: lines.index(next(line for line in lines if line.startswith("Of the best")))]
    assert max(map(len, table)) <= 80
    again = measured(data, tmp_path / "again", "seeds=0..1")
    assert again.returncode == 0
    digests = [row["digest"] for row in rows(tmp_path / "again")]
    assert digests[:-1] == [row["digest"] for row in found]


def test_a_case_without_a_true_pose_has_residuals_alone(data, tmp_path):
    done = measured(data, tmp_path, "seeds=0", "halves=false", case="unknown")
    assert (done.returncode, done.stderr) == (0, "")
    (row,) = rows(tmp_path)
    assert float(row["residual"]) < 0.005
    assert row["position_error"] == row["right"] == row["held_out"] == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["data=nowhere"], "data is nowhere; accepted: a folder with real/"),
        (["only=lego"], "only names 'lego'; accepted: all, a pattern such as icu*, icub_lego"),
        (["~cases.known.mesh"], "cases.known lacks mesh"),
        (["cases.known.mesh=none.obj"], "none.obj"),
        (["methods=magic"], "magic"),
    ],
)
def test_mistakes_are_one_line(data, tmp_path, arguments, message):
    done = measured(data, tmp_path, *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_case_of_one_touch_is_refused(data, tmp_path):
    done = measured(data, tmp_path, case="one")
    assert done.returncode == 2
    assert "one has 1 touches; accepted: from 2" in done.stderr


def test_real_touches_and_a_depth_image_are_measured(real_directory, tmp_path):
    folder = real_directory.parent
    cases = "only=[icub_cylinder,gelatin_box]"
    words = [f"data={folder}", f"out={tmp_path}", "methods=icp", "seeds=0", cases]
    done = run(real.main, *words)
    assert (done.returncode, done.stderr) == (0, "")
    lines = {(row["case"], row["points"]): row for row in rows(tmp_path) if row["method"] == "icp"}
    assert len(lines) == 4
    assert 0.004 < float(lines["icub_cylinder", "all"]["residual"]) < 0.007
    assert float(lines["gelatin_box", "all"]["residual"]) < 0.003
