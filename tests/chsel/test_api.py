"""`chsel.register` and the public names: what they accept, warn of and refuse."""

import dataclasses
import re
import warnings
from functools import partial
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import chsel
from chsel.methods import build_method, preset_settings
from chsel.problem.poses import apply, axis_angle, compose, inverse

BOX = trimesh.creation.box((0.1, 0.06, 0.04))
POSE = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.4)), np.array([0.3, 0.1, 0.2]))
SURFACE = apply(POSE, trimesh.sample.sample_surface(BOX, 40, seed=0)[0])
QUICK = {"descent": {"restarts": 2, "iterations": 10}, "emitter": {"iterations": 5}}
POINT = [[0.1, 0.2, 0.3]]


def register(**arguments):
    return chsel.register(BOX, **{"method": "chsel", "settings": QUICK, **arguments})


def test_a_mesh_and_points_are_all_it_takes():
    found = chsel.register(BOX, contacts=torch.tensor(SURFACE))
    assert found.object_from_world.shape == (30, 4, 4)
    # A box looks the same after half turns about its axes, so only its centre is unique.
    best = inverse(found.object_from_world[0])
    assert np.abs(best[:3, 3] - POSE[:3, 3]).max() < 0.005


def test_contacts_are_points_on_the_surface_and_have_a_name():
    expected = register(contacts=SURFACE)
    assert register(contacts=SURFACE).digest == expected.digest
    np.testing.assert_array_equal(expected.world_from_object, inverse(expected.object_from_world))
    with pytest.raises(chsel.ChselError, match=r"accepted: chsel\.register\(mesh, contacts=points"):
        chsel.register(BOX, SURFACE)


def test_normals_of_contacts_are_those_of_the_problem(monkeypatch):
    posed = []
    pose_problem = chsel.api.posed_problem

    def spied(sdf, points, **named):
        posed.append(points)
        return pose_problem(sdf, points, **named)

    monkeypatch.setattr(chsel.api, "posed_problem", spied)
    repeated = np.concatenate([SURFACE[:3], SURFACE[:1]])
    normals = [[0, 0, 1], [0, 0, 0], [1, 0, 0], [0, 1, 0]]
    register(
        contacts=repeated,
        normals=normals,
        normal_noise=[0.1, 0.2, 0.3, 0.4],
        known=POINT,
        known_sdf=[0.0],
    )
    (points,) = posed
    np.testing.assert_array_equal(points.normals, [*normals[:3], [0, 0, 0]])
    np.testing.assert_array_equal(points.normal_noise, [0.1, 0.0, 0.3, 0.0])
    for wrong in ({"normals": normals}, {"contacts": POINT, "normal_noise": 0.1}):
        with pytest.raises(chsel.ChselError, match="normals"):
            register(**wrong)


def test_a_grid_that_is_kept_a_mesh_lists_and_tensors_give_the_same_bits(monkeypatch):
    grid = chsel.SdfGrid.from_mesh(BOX, 0.002)
    digest = register(contacts=SURFACE).digest
    assert register(contacts=SURFACE.tolist()).digest == digest
    assert chsel.register(grid, contacts=SURFACE, method="chsel", settings=QUICK).digest == digest
    monkeypatch.setattr("chsel.problem.sdf_grid.mesh_sdf", None)
    assert register(contacts=SURFACE, seed=1).digest != digest


def test_points_added_later_start_from_the_previous_result():
    first = register(contacts=SURFACE[:20])
    second = register(contacts=SURFACE, previous=first, step=1)
    cost = chsel.RelaxedCost(chsel.SdfGrid.from_mesh(BOX, 0.002), chsel.KnownPoints(known=SURFACE))
    assert second.cost[0] <= cost.evaluate(first.elites).min() + 1e-12
    bare = dataclasses.replace(first, trust=None)  # which changes nothing
    assert bare.digest == first.digest
    assert register(contacts=SURFACE, previous=bare, step=1).digest == second.digest


@pytest.mark.parametrize(
    "points",
    [
        {"free": POINT},
        {"occupied": POINT},
        {"known": POINT, "known_sdf": [0.02]},
        {"contacts": np.zeros((30, 3)), "free": np.zeros((50, 3))},
        {"contacts": [[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]},
        {"free": np.full((1, 3), 50.0), "contacts": POINT},
    ],
)
@pytest.mark.parametrize("preset", ["default", "reference"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_odd_points_have_a_defined_result(points, preset):
    found = register(**points, preset=preset, hypotheses=5)
    assert found.object_from_world.shape == (5, 4, 4)
    assert np.isfinite(found.object_from_world).all()
    assert np.isfinite(found.cost).all()


def warned(**arguments):
    """The codes of the warnings of a registration, which name this file's line as their place."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        chsel.register(BOX, **{"method": "chsel", "settings": QUICK, **arguments})
    mine = [each for each in caught if issubclass(each.category, chsel.InputWarning)]
    assert {Path(each.filename).name for each in mine} <= {"test_api.py"}
    return [each.message.code for each in mine]


FREE = np.random.default_rng(0).uniform(-0.3, 0.3, (4000, 3)) + POSE[:3, 3]
AWAY = (np.abs(apply(inverse(POSE), FREE)) - BOX.extents / 2).max(axis=1)
FREE = FREE[AWAY > 0.005]
NOISE = np.random.default_rng(0).normal(0.0, 0.004, SURFACE.shape)
ANCHORED = {"method": "anchored", "settings": {"size": "small", "noise": 0.0001}}
HALL = chsel.Workspace((-400, -400, -200), (400, 400, 200))
STARTS = inverse(compose(POSE[None, :3, :3], 1000.0 * POSE[None, :3, 3]))
ELSEWHERE = chsel.PosePrior(centre=POSE[:3, 3] + [0.1, 0.0, 0.0], centre_noise=0.01)
NEARBY = chsel.PosePrior(centre=POSE[:3, 3] + [0.01, 0.0, 0.0], centre_noise=0.01)
ASIDE = chsel.Workspace((0.38, 0, 0), (0.6, 0.3, 0.3))


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ({"free": FREE}, "no_contact"),
        ({"contacts": SURFACE, "free": np.concatenate([FREE, SURFACE])}, "contacts_in_free_space"),
        ({"contacts": SURFACE, "workspace": ASIDE}, "contacts_outside"),
        ({"contacts": np.concatenate([SURFACE, [[3.0, 0, 0]]])}, "contacts_apart"),
        ({"contacts": SURFACE, "free": FREE + 5.0}, "contacts_far_from_free"),
        ({"contacts": SURFACE, "workspace": HALL}, "wide_workspace"),
        ({"contacts": np.repeat(SURFACE, 2, axis=0)}, "repeated"),
        ({"contacts": 400.0 * POSE[None, :3, 3]}, "far_away"),
        ({"contacts": SURFACE, "initial_set": STARTS}, "far_away"),
        ({"contacts": 3.0 * SURFACE}, "no_fit"),
        ({"contacts": SURFACE + NOISE, **ANCHORED}, "above_noise"),
        ({"contacts": SURFACE, "free": FREE, "prior": ELSEWHERE}, "prior"),
    ],
)
def test_points_that_are_hardly_meant_give_a_warning_and_good_ones_none(arguments, code):
    assert code in warned(**arguments)
    room = chsel.Workspace.around(SURFACE, 0.1)
    assert warned(contacts=SURFACE, free=FREE, workspace=room, prior=NEARBY) == []


def test_points_far_off_all_poses_give_one_warning():
    """Two calls with other points, whose misfits differ, at one line, as Python shows them."""
    mesh = BOX.copy().apply_scale(3.0)
    misfits = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for scale in (3.0, 3.1):
            surface = 3.0 * SURFACE + scale * NOISE
            misfits.append(chsel.register(mesh, contacts=surface, method="icp").trust.misfit)
    assert 10.0 < misfits[0] != misfits[1] > 10.0
    assert [warning.message.code for warning in caught] == ["above_noise"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "no point was given; accepted: contacts, free"),
        ({"contacts": 1000.0 * SURFACE}, r"the object is 0\.1.* m: are they in mill"),
        ({"surface": POINT}, "surface was renamed; accepted: contacts="),
        ({"contacts": [[1e17, 0, 0]]}, r"contacts\[0\] has 1e\+17; accepted: up to 100000"),
        ({"free": [[1e8, 0, 0]]}, r"free\[0\] has 1e\+08; accepted: up to 100000"),
        ({"workspace": chsel.Workspace((0, 0, 0), (1e8, 1, 1))}, r"workspace\[1\] has 1e\+08"),
        ({"contacts": np.ma.masked_array(SURFACE, SURFACE > 0)}, "contacts has masked values"),
        ({"settings": {"noise": 0.5}, "method": None}, "noise is 0.5 m, and the object is 0.12"),
        ({"known": POINT}, "known_sdf has 0 entries; accepted: one per known point, 1"),
        ({"method": "magic"}, "method is 'magic'; accepted: chsel"),
        ({"method": "anchored"}, "method=anchored: settings"),
        ({"settings": {"alpha": 1}}, "settings.alpha does not exist"),
        ({"settings": "fast"}, "settings is 'fast'; accepted: a mapping, or"),
        ({"initial_set": np.zeros((2, 4, 4))}, r"initial_set\[0\] is not a rigid"),
        ({"initial_set": np.zeros((0, 4, 4))}, "initial_set is empty"),
        ({"previous": np.eye(4)[None]}, "previous is .*; accepted: the Hypoth"),
        ({"prior": {"centre": POINT[0]}}, r"prior is .*; accepted: chsel\.PosePrior"),
        ({"seed": 1.5}, r"seed is 1.5; accepted: an integer from 0 to 2\*\*64"),
        ({"hypotheses": 2.5}, "hypotheses is 2.5; accepted: an integer"),
        ({"workspace": [[0, 0, 0], [1, 1, 1]]}, r"workspace is \[\[0.*; accepted: chsel\.Workspa"),
        ({"free_resolution": -0.01}, "free_resolution is -0.01; accepted: a f"),
    ],
)
def test_mistakes_say_what_is_accepted(arguments, message):
    if arguments and not {"contacts", "surface", "free", "known"} & set(arguments):
        arguments = {"contacts": POINT, **arguments}
    with pytest.raises(chsel.ChselError, match=message) as caught:
        register(**arguments)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_the_default_is_anchored_and_in_the_presets_of_the_paper_chsel():
    default = chsel.register(BOX, contacts=SURFACE[:5])
    assert default.digest == chsel.register(BOX, contacts=SURFACE[:5], method="anchored").digest
    quick = {"contacts": SURFACE[:5], "settings": QUICK, "preset": "paper"}
    assert chsel.register(BOX, **quick).digest == register(**quick).digest


def test_own_starts_and_whole_settings_are_used():
    whole = preset_settings("gradient_descent", "default")
    starts = {"initial_set": np.tile(inverse(POSE), (4, 1, 1)), "method": "gradient_descent"}
    found = register(contacts=SURFACE, **starts, settings=None)
    assert register(contacts=SURFACE, **starts, settings=whole).digest == found.digest
    assert found.duplicate.tolist() == [False, True, True, True]


def test_all_names_of_the_package_are_there():
    assert chsel.__version__ == metadata.version("chsel-replay")
    assert all(getattr(chsel, name) is not None for name in chsel.__all__)


HAND = chsel.HandShape.of(BOX)
ACTIONS = chsel.Actions(np.eye(4)[None], np.ones(1))
POLICY = chsel.build_policy("information")
ONLINE = build_method("icp").online
GRID = chsel.SdfGrid.from_mesh(BOX, 0.02)
ROOM = chsel.Workspace((0, 0, 0), (1, 1, 1))
KNOWN = chsel.KnownPoints(known=SURFACE)
SDF = r"sdf is .*; accepted: .*chsel\.SdfGrid\.from_mesh"


def loop(workspace=ROOM, **changes):
    return chsel.Loop(GRID, workspace, **({"free_resolution": 0.01, "settings": ONLINE} | changes))


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (chsel.register, ("box.obj",), r"target is 'box\.obj'; accepted: a mesh such as chsel\.l"),
        (chsel.RelaxedCost, (BOX, KNOWN), SDF),
        (chsel.RelaxedCost, (GRID, SURFACE), r"points is .*; accepted: chsel\.KnownPoints\("),
        (chsel.CompiledCost, (KNOWN, GRID), SDF),
        (loop, (POINT,), "workspace is .*; accepted: chsel"),
        (partial(loop, settings="icp"), (), "settings is 'icp'; accepted: met"),
        (partial(loop, policy="grid"), (), r"policy is 'grid'; accepted: chsel\.build_p"),
        (loop(policy=POLICY).offer, (POSE, HAND), "actions is .*; accepted: chs"),
        (loop(policy=POLICY).offer, (ACTIONS, BOX), "hand is .*; accepted: chs"),
    ],
)
def test_values_of_another_class_are_refused(make, arguments, message):
    points = {"contacts": POINT} if make is chsel.register else {}
    with pytest.raises(chsel.ChselError, match=message) as caught:
        make(*arguments, **points)
    assert "\n" not in str(caught.value)


def test_arrays_in_place_of_known_points_are_refused():
    probe = chsel.Probe(step=0, outcome="points", new_points=SURFACE)
    with pytest.raises(chsel.ChselError, match=r"points is .*; accepted: chsel\.KnownPoints"):
        loop().perceive(probe)
    with pytest.raises(chsel.ChselError, match=r"points is .*; accepted: chsel\.KnownPoints"):
        loop(points=SURFACE)


def test_the_examples_of_the_library_run(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "session.md").read_text()
    BOX.export(tmp_path / "drill.obj")
    names = {
        "contacts": SURFACE,
        "free_points": SURFACE + 0.5,
        "free": SURFACE + 0.5,
        "mesh": BOX,
        "rotation": torch.eye(3, dtype=torch.float64)[None].requires_grad_(),
        "translation": torch.full((1, 3), 0.01, dtype=torch.float64).requires_grad_(),
        "chsel": chsel,
        "sdf": chsel.SdfGrid.from_mesh(BOX, 0.005),
        "workspace": chsel.Workspace.around(SURFACE, 0.2),
        "probes": [chsel.Probe(step=0, outcome="points", new_points=KNOWN)],
    }
    for start in ("import chsel\n\nhypotheses", "trust = hyp", "cost = chsel", "method = chsel"):
        (example,) = re.findall(rf"```python\n({start}.*?)```", page, re.DOTALL)
        exec(example.replace('"drill.obj"', repr(str(tmp_path / "drill.obj"))), names)
        assert "trust" not in names or names["trust"].verdict == "determined"
    assert np.abs(names["best"][:3, 3] - POSE[:3, 3]).max() < 0.005
    assert float(names["translation"].grad.abs().sum()) > 0.0
