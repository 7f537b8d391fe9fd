from __future__ import annotations

import numpy as np
import pytest
import torch

from chsel import KnownPoints, Workspace
from chsel.errors import PointsError, PoseError, SettingError
from chsel.methods import METHODS, ChselSettings, build_method, preset_settings
from chsel.problem.points import FreeVoxels, Lattice
from chsel.problem.poses import check_rigid, nearest_rigid
from chsel.problem.settings import PRESETS, build_settings, settings_mapping
from chsel.problem.streams import Purpose, StreamKey


def test_points_are_copied_and_can_not_be_changed() -> None:
    mine = np.zeros((2, 3))
    points = KnownPoints(free=mine)
    mine += 1.0
    assert (points.free == 0.0).all()
    with pytest.raises(ValueError, match="read-only"):
        points.free[0] = 1.0


def test_tensors_lists_and_arrays_of_other_types_are_taken() -> None:
    for given in ([[1, 2, 3]], torch.tensor([[1.0, 2.0, 3.0]]), np.array([[1, 2, 3]], np.int8)):
        points = KnownPoints(known=given)  # type: ignore[arg-type]
        assert points.known.dtype == np.float64
        np.testing.assert_array_equal(points.known, [[1.0, 2.0, 3.0]])
        np.testing.assert_array_equal(points.sdf, [0.0])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"free": np.zeros((2, 2))}, r"free has shape \(2, 2\); accepted: \(any, 3\)"),
        ({"occupied": [[0, 0, np.inf]]}, r"occupied\[0\] is not finite"),
        ({"known": [["a", 0, 0]]}, "known is not an array of numbers"),
        ({"known": np.zeros((2, 3)), "known_sdf": [0.0]}, "known_sdf has 1 entries"),
        ({"free": np.zeros(3)}, r"free has shape \(3,\)"),
    ],
)
def test_malformed_points_are_named(arrays: dict[str, object], message: str) -> None:
    with pytest.raises(PointsError, match=message):
        KnownPoints(**arrays)  # type: ignore[arg-type]


def test_merging_appends_class_by_class_and_changes_the_digest() -> None:
    first = KnownPoints(free=[[0, 0, 0]], known=[[1, 1, 1]], known_sdf=[0.1])
    second = KnownPoints(free=[[2, 2, 2]], occupied=[[3, 3, 3]], known=[[4, 4, 4]])
    both = first.merged(second)
    np.testing.assert_array_equal(both.free, [[0, 0, 0], [2, 2, 2]])
    np.testing.assert_array_equal(both.sdf, [0.1, 0.0])
    np.testing.assert_array_equal(both.contacts, [[4, 4, 4]])
    assert both.count == 5
    assert len({first.digest, second.digest, both.digest, second.merged(first).digest}) == 4


def test_digest_tells_classes_apart() -> None:
    assert KnownPoints(free=[[1, 2, 3]]).digest != KnownPoints(occupied=[[1, 2, 3]]).digest


def test_voxels_keep_one_point_each_at_their_centres() -> None:
    voxels = FreeVoxels(Lattice((0.1, 0.0, 0.0), 0.025))
    new = voxels.add(np.array([[0.101, 0.0, 0.0], [0.11, 0.001, 0.0], [0.15, -0.03, 0.0]]))
    np.testing.assert_allclose(new, [[0.1, 0.0, 0.0], [0.15, -0.025, 0.0]])
    assert len(voxels.add(np.array([[0.099, 0.0, 0.0], [0.15, -0.02, 0.001]]))) == 0
    assert voxels.add(np.zeros((0, 3))).shape == (0, 3)
    assert len(voxels) == 2


def test_workspace_must_have_an_inside() -> None:
    with pytest.raises(PointsError, match="lower bound below its upper"):
        Workspace((0, 0, 0), (1, 0, 1))
    around = Workspace.around(np.array([[0.0, 1.0, 2.0], [0.5, 1.0, 2.0]]), 0.1)
    np.testing.assert_allclose(around.bounds, [[-0.1, 0.9, 1.9], [0.6, 1.1, 2.1]])


def test_transforms_that_are_not_rigid_are_named() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    check_rigid("poses", poses)
    for row, column, value in ((0, 0, 1.1), (0, 0, -1.0), (3, 0, 0.5)):
        broken = poses.copy()
        broken[2, row, column] = value
        with pytest.raises(PoseError, match=r"poses\[2\] is not a rigid transform"):
            check_rigid("poses", broken)
    rounded = np.round(poses + 1e-5 * np.arange(16).reshape(4, 4) * (np.arange(4)[:, None] < 3), 7)
    check_rigid("poses", nearest_rigid("poses", rounded))


def test_streams_differ_by_seed_step_purpose_and_index() -> None:
    keys = [
        (0, 0, 1, 0),
        (1, 0, 1, 0),
        (0, 1, 1, 0),
        (0, 0, 2, 0),
        (0, 0, 1, 1),
        (2**64 - 1, 0, 1, 0),
    ]
    draws = [StreamKey(a, b).stream(Purpose(c), d).random(4).tobytes() for a, b, c, d in keys]
    assert len(set(draws)) == len(keys)
    assert StreamKey(0, 0).stream(Purpose(1)).random(4).tobytes() == draws[0]


def test_streams_are_those_of_every_recording_so_far() -> None:
    stream = StreamKey(7, 3).stream(Purpose.INITIAL_POSES)
    np.testing.assert_array_equal(stream.random(2), [0.8459854787595069, 0.09607046650201434])


@pytest.mark.parametrize(("seed", "step"), [(-1, 0), (2**64, 0), (0, -1), (0, 2**32)])
def test_keys_out_of_range_are_refused(seed: int, step: int) -> None:
    with pytest.raises(SettingError, match="accepted: an integer from 0"):
        StreamKey(seed, step)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("method", METHODS)
def test_every_preset_survives_the_way_through_a_mapping(method: str, preset: str) -> None:
    settings = preset_settings(method, preset)
    assert build_method(method, settings_mapping(settings)).settings == settings


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"cots": {}}, r"method.cots does not exist; did you mean cost\? accepted: archive, cost"),
        ({"cost": {"free_scale": "x"}}, r"method.cost.free_scale is 'x'; accepted: a number"),
        ({"passes": 1.5}, r"method.passes is 1.5; accepted: an integer"),
        ({"passes": True}, r"method.passes is True; accepted: an integer"),
        ({"cost": 3}, r"method.cost is 3; accepted: a group"),
        ({"cost": {"lookup": None}}, r"method.cost.lookup is None; accepted: a text"),
        ({"plane": {"axis": [0, 1], "offset": 0}}, r"method.plane.axis has 2 entries; accepted: 3"),
        ({"archive": {"bins": 0}}, r"method.archive: bins is 0"),
    ],
)
def test_wrong_settings_name_the_key_and_what_is_accepted(
    mapping: dict[str, object], message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        build_settings(ChselSettings, mapping, "method")
