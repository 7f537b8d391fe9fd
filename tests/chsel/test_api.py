import dataclasses
import re
import warnings
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import chsel
from chsel.methods import build_method, preset_settings
from chsel.problem.poses import apply, axis_angle, compose, inverse
from chsel.problem.streams import StreamKey

BOX = trimesh.creation.box((0.1, 0.06, 0.04))
POSE = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.4)), np.array([0.3, 0.1, 0.2]))
SURFACE = apply(POSE, trimesh.sample.sample_surface(BOX, 40, seed=0)[0])
QUICK = {"descent": {"restarts": 2, "iterations": 10}, "emitter": {"iterations": 5}}
DOWN = np.diag([1.0, -1.0, -1.0])
POINT = [[0.1, 0.2, 0.3]]


def register(**arguments):
    return chsel.register(BOX, **{"method": "chsel", "settings": QUICK, **arguments})


def test_a_mesh_and_points_are_all_it_takes():
    found = chsel.register(BOX, surface=torch.tensor(SURFACE))
    assert found.object_from_world.shape == (30, 4, 4)
    world = inverse(found.object_from_world)
    # A box looks the same after half turns about its axes, so only its centre is unique.
    assert np.abs(world[0, :3, 3] - POSE[:3, 3]).max() < 0.005


def test_a_grid_a_mesh_lists_and_tensors_give_the_same_bits():
    grid = chsel.SdfGrid.from_mesh(BOX, 0.002)
    digests = {
        register(surface=SURFACE).digest,
        register(surface=SURFACE.tolist()).digest,
        register(surface=torch.tensor(SURFACE)).digest,
        chsel.register(grid, surface=SURFACE, method="chsel", settings=QUICK).digest,
    }
    assert len(digests) == 1
    assert register(surface=SURFACE, seed=1).digest not in digests


@pytest.mark.filterwarnings("ignore:the SDF grid of an object:chsel.MeshWarning")
def test_a_thin_plate_is_found_and_its_grid_is_made_once(monkeypatch):
    monkeypatch.setattr("chsel.problem.sdf_grid.DEFAULT_NODES", 40_000)
    plate = trimesh.creation.box((0.1, 0.06, 0.002))
    touched = trimesh.sample.sample_surface(plate, 40, seed=0)[0]
    rim = np.array([[0.05, 0.01, 0.0], [0.05, -0.02, 0.0], [-0.05, 0.01, 0.0], [0.01, 0.03, 0.0]])
    surface = apply(POSE, np.concatenate([touched, rim]))
    found = chsel.register(plate, surface=surface, method="anchored")
    corners = apply(found.object_from_world[0], apply(POSE, np.asarray(plate.vertices)))
    expected = np.tile(plate.extents / 2.0, (8, 1))  # after half turns, too
    np.testing.assert_allclose(np.abs(corners), expected, atol=5e-4)
    monkeypatch.setattr("chsel.problem.sdf_grid.mesh_sdf", None)
    again = chsel.register(plate, surface=surface, method="anchored")
    assert again.digest == found.digest


def test_points_added_later_start_from_the_previous_result():
    first = register(surface=SURFACE[:20])
    second = register(surface=SURFACE, previous=first, step=1)
    cost = chsel.RelaxedCost(chsel.SdfGrid.from_mesh(BOX, 0.002), chsel.KnownPoints(known=SURFACE))
    assert second.cost[0] <= cost.evaluate(first.elites).min() + 1e-12
    assert second.digest != register(surface=SURFACE, step=1).digest


@pytest.mark.parametrize(
    "points",
    [
        {"surface": POINT},
        {"free": POINT},
        {"occupied": POINT},
        {"known": POINT, "known_sdf": [0.02]},
        {"surface": np.zeros((30, 3)), "free": np.zeros((50, 3))},
        {"surface": [[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]},
        {"free": np.full((1, 3), 50.0), "surface": POINT},
    ],
)
@pytest.mark.parametrize("preset", ["default", "paper", "reference"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_odd_points_have_a_defined_result(points, preset):
    found = register(**points, preset=preset, hypotheses=5)
    assert found.object_from_world.shape == (5, 4, 4)
    assert np.isfinite(found.object_from_world).all()
    assert np.isfinite(found.cost).all()


def warned(**arguments):
    """The warnings of a registration, each of this file's line that asked for it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        chsel.register(BOX, **{"method": "chsel", "settings": QUICK, **arguments})
    mine = [each for each in caught if issubclass(each.category, chsel.InputWarning)]
    assert {Path(each.filename).name for each in mine} <= {"test_api.py"}
    return [each.message for each in mine if isinstance(each.message, chsel.InputWarning)]


FREE = np.random.default_rng(0).uniform(-0.3, 0.3, (4000, 3)) + POSE[:3, 3]
FREE = FREE[
    chsel.SdfGrid.from_mesh(BOX, 0.005, padding=0.5).at(apply(inverse(POSE), FREE))[0] > 0.005
]


@pytest.mark.parametrize(
    ("method", "settings"), [("chsel", QUICK), ("anchored", {"size": "small"})]
)
def test_good_points_give_no_warning(method, settings):
    room = chsel.Workspace.around(SURFACE, 0.1)
    assert (
        warned(surface=SURFACE, free=FREE, workspace=room, method=method, settings=settings) == []
    )


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ({"free": FREE}, "no_contact"),
        ({"surface": SURFACE, "free": np.concatenate([FREE, SURFACE])}, "contacts_in_free_space"),
        (
            {"surface": SURFACE, "workspace": chsel.Workspace((0.38, 0, 0), (0.6, 0.3, 0.3))},
            "contacts_outside",
        ),
        ({"surface": np.concatenate([SURFACE, [[3.0, 0, 0]]])}, "contacts_apart"),
        ({"surface": SURFACE, "free": FREE + 5.0}, "contacts_far_from_free"),
        ({"surface": 3.0 * SURFACE}, "no_fit"),
    ],
)
def test_points_that_are_hardly_meant_give_a_warning(arguments, code):
    assert code in [warning.code for warning in warned(**arguments)]


def test_points_13_noise_levels_from_all_poses_give_a_warning():
    noise = np.random.default_rng(0).normal(0.0, 0.004, SURFACE.shape)
    settings = {"size": "small", "noise": 0.0001}
    found = warned(surface=SURFACE + noise, method="anchored", settings=settings)
    assert [warning.code for warning in found] == ["above_noise"]


@pytest.mark.parametrize("method", ["chsel", "icp"])
def test_points_far_off_all_poses_give_one_warning_with_any_method(method):
    """Two calls with other points, whose misfits differ, at one line, as Python shows them."""
    mesh = BOX.copy().apply_scale(3.0)
    misfits = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for seed in range(2):
            noise = np.random.default_rng(seed).normal(0.0, 0.012, SURFACE.shape)
            found = chsel.register(mesh, surface=3.0 * SURFACE + noise, method=method)
            assert found.trust is not None
            misfits.append(found.trust.misfit)
    assert 10.0 < min(misfits) < max(misfits)
    (warning,) = caught
    assert isinstance(warning.message, chsel.InputWarning)
    assert warning.message.code == "above_noise"


@pytest.mark.parametrize("points", [1000.0 * SURFACE, [[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]]])
def test_points_in_millimetres_are_an_error(points):
    with pytest.raises(chsel.ChselError, match=r"the object is 0\.1.* m: are they in mill"):
        register(surface=points)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "no point was given; accepted: surface, free"),
        ({"surface": [[0, 0, np.nan]]}, r"surface\[0\] is not finite"),
        ({"free": [[0, 0]]}, r"free has shape \(1, 2\); accepted: \(any, 3\)"),
        ({"known": POINT}, "known has 1 points and known_sdf 0"),
        ({"surface": POINT, "method": "magic"}, "method is 'magic'; accepted: chsel"),
        ({"surface": POINT, "preset": "best"}, "preset is 'best'; accepted: default"),
        ({"surface": POINT, "hypotheses": 0}, "hypotheses is 0"),
        ({"surface": POINT, "settings": {"alpha": 1}}, "settings.alpha does not exist"),
        ({"surface": POINT, "resolution": -0.1}, "SDF resolution is -0.1"),
        (
            {"surface": POINT, "initial_set": np.zeros((2, 4, 4))},
            r"initial_set\[0\] is not a rigid",
        ),
        ({"surface": POINT, "initial_set": np.zeros((0, 4, 4))}, "initial_set is empty"),
        ({"surface": POINT, "initial_set": np.eye(4)}, r"initial_set has shape \(4, 4\); accepted"),
        ({"surface": POINT, "previous": np.eye(4)[None]}, "previous is .*; accepted: the Hypoth"),
        ({"surface": POINT, "seed": 1.5}, r"seed is 1.5; accepted: an integer from 0 to 2\*\*64"),
        ({"surface": POINT, "step": -1}, r"step is -1; accepted: an integer from 0 to 2\*\*32"),
        ({"surface": POINT, "hypotheses": 2.5}, "hypotheses is 2.5; accepted: an integer"),
        (
            {"surface": POINT, "workspace": [[0, 0, 0], [1, 1, 1]]},
            r"workspace is \[\[0.*; accepted: chsel\.Workspace\(lower, upper\)",
        ),
        ({"surface": POINT, "settings": "fast"}, "settings is 'fast'; accepted: a mapping, or"),
        ({"surface": POINT, "settings": {"emitter": 3}}, "emitter is 3; accepted: a group of set"),
        ({"surface": POINT, "resolution": 5e-324}, "SDF resolution is 5e-324; accepted: 1e-06"),
        ({"surface": POINT, "free_resolution": -0.01}, "free_resolution is -0.01; accepted: a f"),
    ],
)
def test_mistakes_say_what_is_accepted(arguments, message):
    with pytest.raises(chsel.ChselError, match=message) as caught:
        register(**arguments)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_a_target_that_is_no_mesh_is_refused():
    message = (
        r"target is 'box\.obj'; accepted: a mesh such as chsel\.load_mesh\('box\.obj'\), a Trim"
    )
    with pytest.raises(chsel.ChselError, match=message):
        chsel.register("box.obj", surface=POINT)
    with pytest.raises(
        chsel.ChselError, match=r"target is .*; accepted: .*load_mesh\('box\.obj'\)"
    ):
        chsel.register(Path("box.obj"), surface=POINT)
    with pytest.raises(chsel.ChselError, match=r"target is a Scene; accepted: .*chsel\.load_mesh"):
        chsel.register(trimesh.Scene(BOX), surface=POINT)


def test_integers_of_numpy_are_seeds_and_steps_too():
    key = StreamKey(np.int64(3), np.uint8(2))
    assert key == StreamKey(3, 2)
    assert type(key.seed) is type(key.step) is int


def test_the_default_is_anchored_and_in_the_presets_of_the_paper_chsel():
    points = {"surface": SURFACE[:5], "settings": None}
    default = chsel.register(BOX, **points)
    assert default.digest == chsel.register(BOX, **points, method="anchored").digest
    quick = {"surface": SURFACE[:5], "settings": QUICK, "preset": "paper"}
    assert chsel.register(BOX, **quick).digest == register(**quick).digest
    with pytest.raises(chsel.ChselError, match="method=anchored: settings"):
        chsel.register(BOX, surface=POINT, settings=QUICK)


def test_all_names_of_the_package_are_there():
    assert chsel.__version__ == metadata.version("chsel-replay")
    assert all(getattr(chsel, name) is not None for name in chsel.__all__)


HAND = chsel.HandShape.of(BOX)
ACTIONS = chsel.Actions(np.eye(4)[None], np.ones(1))
POLICY = chsel.build_policy("information")
ONLINE = build_method("icp").online
GRID, ROOM = chsel.SdfGrid.from_mesh(BOX, 0.02), chsel.Workspace((0, 0, 0), (1, 1, 1))
KNOWN = chsel.KnownPoints(known=SURFACE)


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (chsel.RelaxedCost, (BOX, KNOWN), r"sdf is .*; accepted: .*chsel\.SdfGrid\.from_mesh"),
        (chsel.RelaxedCost, (GRID, SURFACE), r"points is .*; accepted: chsel\.KnownPoints\("),
        (chsel.CompiledCost, (KNOWN, GRID), r"sdf is .*; accepted: .*chsel\.SdfGrid\.from_mesh"),
        (chsel.OnlineRegistration, (BOX, ROOM, 0.01, ONLINE), "sdf is .*; accepted: "),
        (
            chsel.OnlineRegistration,
            (GRID, [[0, 0, 0], [1, 1, 1]], 0.01, ONLINE),
            r"workspace is \[\[0, .*; accepted: chsel\.Workspace\(lower, upper\)",
        ),
        (chsel.OnlineRegistration, (GRID, ROOM, 0.01, "icp"), "settings is 'icp'; accepted: met"),
        (
            chsel.RegistrationProblem,
            (BOX, KNOWN, POSE[None], ROOM, 0.01, StreamKey(0, 0)),
            "sdf is .*; accepted: ",
        ),
        (
            chsel.Steering,
            ("information", GRID, ROOM, 0.01, ACTIONS, HAND),
            r"policy is 'information'; accepted: chsel\.build_policy",
        ),
        (chsel.Steering, (POLICY, BOX, ROOM, 0.01, ACTIONS, HAND), "sdf is .*; accepted: "),
        (chsel.Steering, (POLICY, GRID, ROOM, 0.01, POSE, HAND), "actions is .*; accepted: chs"),
        (chsel.Steering, (POLICY, GRID, ROOM, 0.01, ACTIONS, BOX), "hand is .*; accepted: chs"),
    ],
)
def test_values_of_another_class_are_refused(make, arguments, message):
    with pytest.raises(chsel.ChselError, match=message) as caught:
        make(*arguments)
    assert "\n" not in str(caught.value)


def test_arrays_in_place_of_known_points_are_refused():
    online = chsel.OnlineRegistration(GRID, ROOM, 0.01, ONLINE)
    with pytest.raises(chsel.ChselError, match=r"points is .*; accepted: chsel\.KnownPoints"):
        next(online.steps(enumerate([SURFACE])))
    steering = chsel.Steering(POLICY, GRID, ROOM, 0.01, ACTIONS, HAND)
    with pytest.raises(chsel.ChselError, match=r"points is .*; accepted: chsel\.KnownPoints"):
        steering.decide(0, SURFACE, None, np.ones(1, dtype=bool))


def test_single_settings_and_whole_settings_are_both_taken():
    whole = preset_settings("gradient_descent", "paper")
    a = chsel.register(BOX, surface=SURFACE[:5], method="gradient_descent", settings=whole)
    b = chsel.register(BOX, surface=SURFACE[:5], method="gradient_descent", preset="paper")
    assert a.digest == b.digest


def test_a_result_says_how_far_to_trust_it_and_its_digest_does_not():
    found = register(surface=SURFACE[:3])
    assert found.trust is not None
    assert found.trust.verdict in ("several modes", "wide")
    bare = dataclasses.replace(found, trust=None)
    assert bare.digest == found.digest
    assert register(surface=SURFACE, previous=found, step=1).digest == (
        register(surface=SURFACE, previous=bare, step=1).digest
    )


def test_own_starts_are_used():
    starts = np.tile(inverse(POSE), (4, 1, 1))
    found = register(surface=SURFACE, initial_set=starts, method="gradient_descent", settings=None)
    assert len(found.cost) == 4
    assert found.duplicate.tolist() == [False, True, True, True]


def test_the_example_in_the_readme_runs(tmp_path):
    readme = (Path(__file__).parents[2] / "README.md").read_text()
    examples = re.findall(r"```python\n(hand = chsel.*?)```", readme, re.DOTALL)
    examples += re.findall(r"```python\n(import chsel.*?)```", readme, re.DOTALL)
    examples += re.findall(r"```python\n(cost = chsel.*?)```", readme, re.DOTALL)
    examples += re.findall(r"```python\n(method = chsel\.build_method.*?)```", readme, re.DOTALL)
    examples += re.findall(r"```python\n(trust = hypotheses.*?)```", readme, re.DOTALL)
    examples += re.findall(r"```python\n(inside = chsel.*?)```", readme, re.DOTALL)
    assert len(examples) == 6
    BOX.export(tmp_path / "drill.obj")
    names = {
        "contacts": SURFACE,
        "free_points": SURFACE + 0.5,
        "free": SURFACE + 0.5,
        "mesh": BOX,
        "rotation": torch.eye(3, dtype=torch.float64)[None].requires_grad_(),
        "translation": torch.full((1, 3), 0.01, dtype=torch.float64).requires_grad_(),
        "chsel": chsel,
        "gripper_mesh": BOX,
        "world_from_hand": compose(
            np.array([DOWN, DOWN]), POSE[:3, 3] + [[0, 0, 0.2], [0.1, 0, 0.2]]
        ),
        "length": np.full(2, 0.3),
        "hypotheses": None,
        "available": np.ones(2, dtype=bool),
        "done": 0,
        "points": chsel.KnownPoints(known=SURFACE),
        "grid": chsel.SdfGrid.from_mesh(BOX, 0.002),
        "workspace": chsel.Workspace((0.0, -0.2, 0.0), (0.6, 0.4, 0.4)),
        "probes": [chsel.KnownPoints(known=part) for part in np.split(SURFACE, 2)],
    }
    for example in examples:
        exec(example.replace('"drill.obj"', repr(str(tmp_path / "drill.obj"))), names)
    assert names["best"].shape == (4, 4)
    assert names["trust"].verdict == "determined"
    assert np.abs(inverse(names["best"])[:3, 3] - POSE[:3, 3]).max() < 0.005
    assert names["online"].previous is names["step"].hypotheses
    assert names["step"].problem.points.count == len(SURFACE)
    assert float(names["translation"].grad.abs().sum()) > 0.0
