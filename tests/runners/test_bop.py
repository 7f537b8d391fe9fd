"""Sessions of a BOP dataset, results in the form of its challenge, and their errors."""

import json

import numpy as np
import pandas as pd
import pytest

from chsel.errors import SessionError
from chsel.problem.poses import apply, inverse
from replay.__main__ import main
from replay.mcap.reader import read_recording
from replay.verbs.export import exported_bop, write_export
from runners import bop, probe
from runners.bop import BopConfig, measured, read_results
from runners.sensors.bop_scene import read_bop_frame
from tests.runners.bop_dataset import POSES, SIDES, write_bop
from tests.runners.in_process import run


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_bop(tmp_path_factory.mktemp("bop"))


def scene(dataset):
    return dataset / "test" / "000002"


def test_a_frame_is_in_metres_and_its_label_is_on_the_object(dataset):
    frame = read_bop_frame(scene(dataset), 7, object_id=9)
    np.testing.assert_allclose(frame.world_from_object[:3, 3], 0.001 * POSES[9][:3, 3])
    points = frame.camera.back_project(frame.depth)[frame.label]
    half = 0.0005 * np.array(SIDES)
    off = np.abs(apply(inverse(frame.world_from_object), points)) - half
    assert np.abs(off.max(axis=1)).max() < 2e-4  # depths are stored by tenths of a millimetre
    np.testing.assert_array_equal(frame.world_from_camera, np.eye(4))


def test_a_session_comes_back_from_the_results_file_as_it_was(dataset, tmp_path):
    model = dataset / "models" / "obj_000009.ply"
    done = run(
        probe.main,
        "session=bop",
        f"session.dataset={dataset}",
        "session.scene=2",
        "session.image=7",
        "session.object_id=9",
        "object=mesh",
        f"object.path={model}",
        "object.scale=0.001",
        f"object.symmetry={dataset / 'models' / 'models_info.json'}",
        "method=anchored",
        "recording=mcap",
        f"logs={tmp_path}",
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (path,) = tmp_path.glob("probe/*/recording.mcap")
    assert main(["verify", str(path)]) == 0
    symmetry = read_recording(path).start.sdf.symmetry
    assert len(symmetry.rotations) == 4
    np.testing.assert_allclose(symmetry.centre, 0.0, atol=1e-6)
    out = tmp_path / "results.csv"
    write_export(exported_bop(read_recording(path), None), out, file_format="csv")
    table = pd.read_csv(out)
    assert list(table) == ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
    recording = read_recording(path)
    found = recording.hypotheses(recording.steps[-1])
    (estimates,) = read_results(out)
    assert (estimates.scene, estimates.image, estimates.object_id) == (2, 7, 9)
    kept = inverse(found.object_from_world[~found.duplicate])
    np.testing.assert_allclose(estimates.camera_from_object, kept, atol=1e-15)
    config = BopConfig(str(out), str(dataset), split="test", models="models")
    row = measured(estimates, config=config)
    assert row["surface"][0] < 0.0005
    assert row["projection"][0] < 0.5
    assert row["recall"] == {"surface": 1.0, "projection": 1.0}
    done = run(bop.main, str(out), f"dataset={dataset}")
    assert "AR of MSSD, of these objects: 1.000" in done.stdout


def test_a_pose_that_is_half_a_turn_off_is_right_by_what_the_dataset_declares(dataset, tmp_path):
    turned = POSES[4] @ np.diag([1.0, -1.0, -1.0, 1.0])
    moved = POSES[4].copy()
    moved[:3, 3] += [0.0, 0.0, 50.0]
    rows = [
        (2, 7, 4, score, *(" ".join(map(repr, part.ravel().tolist())) for part in parts), -1)
        for score, parts in (
            (0.5, (moved[:3, :3], moved[:3, 3])),
            (0.9, (turned[:3, :3], turned[:3, 3])),
        )
    ]
    columns = ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
    pd.DataFrame(rows, columns=columns).to_csv(tmp_path / "results.csv", index=False)
    (estimates,) = read_results(tmp_path / "results.csv")
    config = BopConfig("", str(dataset), split="test", models="models")
    row = measured(estimates, config=config)
    np.testing.assert_allclose(row["surface"], [0.0, 0.05], atol=1e-12)
    info = dataset / "models" / "models_info.json"
    declared = info.read_text()
    diameter = float(np.linalg.norm(SIDES))
    info.write_text(json.dumps({"4": {"diameter": diameter}}))
    plain = measured(estimates, config=config)
    info.write_text(declared)
    corner = np.hypot(SIDES[1], SIDES[2])  # a half turn about x moves it to the other side
    np.testing.assert_allclose(plain["surface"], [0.001 * corner, 0.05])
    assert plain["recall"]["surface"] == pytest.approx(
        (corner < 0.05 * np.arange(1, 11) * diameter).mean()
    )


@pytest.mark.parametrize(
    ("image", "object_id", "instance", "message"),
    [
        (8, 4, 0, r"image 8: scene_camera\.json has 1 images, 7 to 7, and not 8"),
        (7, 5, 0, "has 0 of object 5, so no instance 0; its objects are 4, 9"),
        (7, 4, 1, "has 1 of object 4, so no instance 1"),
    ],
)
def test_what_a_scene_does_not_have_is_one_line(dataset, image, object_id, instance, message):
    with pytest.raises(SessionError, match=message):
        read_bop_frame(scene(dataset), image, object_id=object_id, instance=instance)


def test_a_scene_without_its_files_is_one_line(dataset, tmp_path):
    with pytest.raises(SessionError, match=r"scene_camera\.json cannot be read"):
        read_bop_frame(tmp_path, 7, object_id=4)
    (tmp_path / "scene_camera.json").write_text("[]")
    with pytest.raises(SessionError, match=r"scene_camera\.json is no mapping"):
        read_bop_frame(tmp_path, 7, object_id=4)
    (tmp_path / "results.csv").write_text("scene_id,im_id\n1,2\n")
    with pytest.raises(SessionError, match=r"results\.csv: no obj_id; accepted: a \.csv with"):
        next(read_results(tmp_path / "results.csv"))
