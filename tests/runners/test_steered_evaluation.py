"""`python -m runners.evaluate` with policies: small sessions for real, their rows and a report."""

import json
import re

import numpy as np
import pyarrow.parquet
import pytest
import trimesh
from scipy.stats import chi2

from chsel.belief import PoseBelief
from chsel.errors import SettingError
from chsel.methods.anchored.anchored import Anchored
from chsel.problem.object_symmetry import ObjectSymmetry
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse, rotation_vector
from chsel.problem.registration_problem import Hypotheses, Trust
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from chsel.problem.surface import outline_in_world
from replay.mcap.reader import read_recording
from runners import evaluate, probe
from runners.evaluation.contenders import chosen_policies
from runners.evaluation.experiment import collect, join_experiment
from runners.evaluation.plan import Task, Trial
from runners.evaluation.run_policy import belief_numbers, mode_distance, spread_of, usual_stop
from tests.runners.in_process import do_task, run
from tests.runners.test_evaluate import stamps
from tests.runners.test_evaluation import plan_in

POLICY = ("policy.probes=3", "policy.belief.poses=20")
SMALL = (
    "experiment=next_probe",
    "configurations=[can,mustard]",
    "seeds=20",
    "settings.anchored.size=small",
    "recordings=true",
    "workers=1",
    *POLICY,
)
POLICIES = "policies=[grid,information]"
LABELS = ("grid", "information")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished evaluation of two policies on two configurations."""
    folder = tmp_path_factory.mktemp("steered") / "out"
    done = run(evaluate.main, *SMALL, POLICIES, f"out={folder}")
    assert (done.returncode, done.stderr) == (0, "")
    assert "2 trials, 2 policies, 4 tasks, of which 0 are finished" in done.stdout
    assert "Probes until the error of the set is below a limit" in done.stdout
    assert "probes.parquet, probes.csv: 12 rows" in done.stdout
    return folder


def rows_of(folder):
    return pyarrow.parquet.read_table(folder / "probes.parquet").to_pylist()


def test_every_probe_has_a_row_that_the_recording_confirms(folder):
    rows = rows_of(folder)
    keys = [(row["configuration"], row["policy"], row["probes"]) for row in rows]
    names = [("can", "cracker_box"), ("mustard", "mustard")]
    assert sorted(keys) == [
        (name, label, probes) for name, _ in names for label in LABELS for probes in (1, 2, 3)
    ]
    for row in rows:
        assert (row["status"], row["step"], row["poses"]) == ("ok", row["probes"] - 1, 20)
        trial = folder / "trials" / row["configuration"] / "seed_20"
        recording = read_recording(trial / f"{row['policy']}.mcap")
        assert recording.probes[row["step"]].outcome == ("contact" if row["hit"] else "free")
        if row["contacts"] > 0:  # from the first contact on
            assert row["digest"] == recording.hypotheses(row["step"]).digest
            assert row["problem_digest"] == recording.problem(row["step"]).digest
            found = recording.hypotheses(row["step"]).object_from_world
            errors = mean_error(recording.start, found)
            assert row["error"] == pytest.approx(errors.mean())
            assert row["best_error"] == pytest.approx(errors[0])
        else:
            assert (row["digest"], row["seconds"], row["grasp_chance"]) == (None, None, None)
            assert row["error"] == row["belief_error"]
        if row["policy"] == "information":
            check_decision(row, recording)
        else:
            assert {row[name] for name in ("action", "hit_forecast", "decision_seconds")} == {None}


def mean_error(start, poses):
    """Distances (B,) of poses (B, 4, 4) from the true one, over points of both surfaces."""
    truth = inverse(start.world_from_object[None])
    places = outline_in_world(start.sdf, Poses.of(np.concatenate([poses, truth])))

    def squares(pose, points):
        return start.sdf.at(apply(pose, points), lookup="trilinear")[0] ** 2

    both = [
        [squares(truth[0], there), squares(pose, places[-1])]
        for pose, there in zip(poses, places[:-1], strict=True)
    ]
    return np.sqrt(np.mean(both, axis=(1, 2)))


def check_decision(row, recording):
    """The forecasts are those of the decision before the probe, the rest of the one after it."""
    before = recording.decision(row["step"] - 1)
    after = recording.decision(row["step"])
    chosen = before.decision.chosen
    assert row["action"] == chosen
    assert row["hit_forecast"] == before.decision.hit_chance[chosen]
    assert row["forecast_spread"] == before.decision.expected_spread[chosen]
    assert row["surprise"] == after.surprise
    assert row["spread"] == after.decision.spread
    belief = after.problem.belief
    assert spread_of(recording.start.sdf, belief) == pytest.approx(row["spread"], rel=1e-12)
    errors = mean_error(recording.start, belief.object_from_world)
    assert row["belief_error"] == pytest.approx(belief.weights @ errors)
    best = after.decision.expected_spread[np.isfinite(after.decision.score)].min()
    assert row["promised"] == row["spread"] - best
    assert row["decision_seconds"] > 0.0


def test_the_usual_rules_stop_at_a_narrow_belief_or_where_little_is_promised():
    assert usual_stop(0.005, 0.05, diameter=0.2, verdict="") == "spread"
    assert usual_stop(0.005, 0.05, diameter=0.2, verdict="determined") == "spread"
    assert usual_stop(0.005, 0.05, diameter=0.2, verdict="wide") == ""
    assert usual_stop(0.005, 0.0001, diameter=0.2, verdict="wide") == "gain"
    assert (
        usual_stop(0.1, 0.05, diameter=0.2, verdict="wide")
        == usual_stop(0.1, None, diameter=0.2, verdict="wide")
        == ""
    )


def believed(sdf, world_from_object, *, modes=0):
    """The belief of members at these poses (K, 4, 4); the first so many are those of modes."""
    count = len(world_from_object)
    trust = Trust(
        noise=0.001,
        outliers=0.0,
        misfit=0.5,
        modes=modes,
        spread=0.01,
        verdict="several modes" if modes else "wide",
        redundancy=6,
        best_of_modes=tuple(range(modes)),
    )
    found = Hypotheses(
        inverse(world_from_object),
        np.arange(count) * 1.0,
        duplicate=np.zeros(count, dtype=bool),
        cell=np.full(count, -1),
        elites=np.zeros((0, 4, 4)),
        trust=trust,
    )
    return PoseBelief(sdf, found)


def test_the_middle_of_the_members_has_the_true_pose_or_not():
    mesh = trimesh.creation.box([0.05, 0.06, 0.07])
    sdf = SdfGrid.from_mesh(mesh, 0.005)
    x, y, z = np.meshgrid(*(np.linspace(0.0, side, 11) for side in (0.2, 0.1, 0.4)), indexing="ij")
    places = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    members = compose(np.broadcast_to(np.eye(3), (len(places), 3, 3)), places)
    key = StreamKey(0, 0)
    for place, middles in (
        ([0.11, 0.05, 0.2], (1, 1)),
        ([0.11, 0.09, 0.2], (2 / 3, 1)),
        ([0.11, 0.093, 0.2], (2 / 3, 1)),  # as far as between the last two of eleven places
        ([0.11, 0.101, 0.2], (2 / 3, 2 / 3)),
        ([0.11, 0.09, 0.6], (1 / 3, 2 / 3)),
        ([0.3, 0.2, 0.6], (0, 0)),
    ):
        truth = compose(np.eye(3), np.array(place))
        row = belief_numbers(
            believed(sdf, members), mesh, sdf=sdf, world_from_object=truth, key=key
        )
        assert (row["middle_50"], row["middle_90"]) == pytest.approx(middles)


def test_an_ellipsoid_of_90_percent_holds_what_a_normal_distribution_does():
    """Of poses of a normal distribution 90 % are in that of the mode that it is widened to be."""
    mesh = trimesh.creation.box([0.05, 0.06, 0.07])
    mesh.apply_translation([0.06, -0.04, 0.02])  # so that origin and centre differ
    sdf = SdfGrid.from_mesh(mesh, 0.005)
    random = np.random.default_rng(3)
    around = compose(rotation_vector(np.array([[0.5, 1.0, -0.7]]))[0], np.array([0.2, 0.4, 0.1]))
    (mode,) = believed(sdf, around[None], modes=1).modes
    lower = np.linalg.cholesky(mode.wide_covariance)
    off = random.standard_normal((4000, 6)) @ lower.T
    centre = mesh.bounds.mean(axis=0)
    turned = rotation_vector(off[:, 3:]) @ around[:3, :3]
    centres = around[:3, :3] @ centre + around[:3, 3] + off[:, :3]
    poses = compose(turned, centres - turned @ centre)
    symmetry = ObjectSymmetry(centre=centre)
    squares = np.array([mode_distance(mode, pose, symmetry=symmetry) for pose in poses])
    assert (squares <= chi2.ppf(0.9, 6)).mean() == pytest.approx(0.9, abs=0.015)
    in_centre = np.linalg.solve(lower, off.T).T
    np.testing.assert_allclose(squares, (in_centre**2).sum(axis=1), rtol=0.2)


def test_turns_count_by_how_far_they_move_the_surface():
    """Members are 0.1 m apart along each axis, and turned by up to 0.5 rad: that is 13 mm.

    So shifts are the three widest directions, and the truth is among them, though turned farther.
    """
    mesh = trimesh.creation.box([0.05, 0.06, 0.07])
    sdf = SdfGrid.from_mesh(mesh, 0.005)
    random = np.random.default_rng(0)
    places = random.uniform(-0.05, 0.05, (400, 3))
    angles = random.uniform(-0.5, 0.5, 400)
    turns = axis_angle(np.tile([0.0, 0.0, 1.0], (400, 1)), angles)
    truth = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.7)), np.zeros(3))
    members = believed(sdf, compose(turns, places))
    row = belief_numbers(members, mesh, sdf=sdf, world_from_object=truth, key=StreamKey(0, 0))
    assert (row["middle_50"], row["middle_90"]) == (1.0, 1.0)


def test_the_best_grasp_works_where_most_members_have_the_object():
    mesh = trimesh.creation.box([0.05, 0.06, 0.07])
    sdf = SdfGrid.from_mesh(mesh, 0.005)
    here = np.eye(4)
    there = compose(np.eye(3), np.array([0.0, 1.0, 0.0]))
    belief = believed(sdf, np.stack([here, here, there]))
    for truth, works in ((here, True), (there, False)):
        row = belief_numbers(belief, mesh, sdf=sdf, world_from_object=truth, key=StreamKey(0, 0))
        assert row["grasp_chance"] == pytest.approx(2 / 3)
        assert row["grasp_works"] is works


def test_sessions_are_those_of_runners_probe(folder, tmp_path):
    done = run(
        probe.main,
        *("object=mustard", "session=kinematic", "seed=20", "recording=mcap"),
        *("method=anchored", "method.size=small", "policy=information", f"logs={tmp_path}"),
        *(*POLICY, "policy.stop.spread=0", "policy.stop.gain=0"),
    )
    assert (done.returncode, done.stderr) == (0, "")
    (path,) = tmp_path.glob("probe/*/recording.mcap")
    recording = read_recording(path)
    rows = [
        row
        for row in rows_of(folder)
        if (row["configuration"], row["policy"]) == ("mustard", "information")
    ]
    assert [recording.decision(row["step"]).decision.digest for row in rows] == [
        row["decision_digest"] for row in rows
    ]
    assert [row["digest"] for row in rows if row["digest"]] == [
        recording.hypotheses(row["step"]).digest for row in rows if row["digest"]
    ]


def test_what_is_finished_is_not_done_again_and_policies_may_become_more(folder):
    before = stamps(folder)
    again = run(evaluate.main, *SMALL, POLICIES, f"out={folder}")
    assert "4 tasks, of which 4 are finished" in again.stdout
    assert stamps(folder) == before
    told = json.loads((folder / "experiment.json").read_text())
    assert list(told["policies"]) == ["grid", "information"]
    assert told["policies"]["grid"]["settings"]["probes"] == 3


def test_policies_that_do_not_exist_are_refused():
    for policies, settings, message in (
        (["grid", "informative"], {}, "policy is 'informative'"),
        ("grid,grid", {}, "policies has grid twice"),
        ("grid@paper", {}, "policies has 'grid@paper'"),
        ("all", {"budget": 4}, "policy.budget does not exist"),
    ):
        with pytest.raises(SettingError, match=re.escape(message)):
            chosen_policies(policies, settings)


def test_a_policy_has_the_changes_of_all_and_its_own():
    fine = {"name": "information", "label": "fine", "settings": {"noise": 0.001}}
    found = chosen_policies(["information#a", fine], {"probes": 5, "noise": 0.004})
    settings = {label: one.policy().settings for label, one in found.items()}
    assert {label: (one.probes, one.noise) for label, one in settings.items()} == {
        "information#a": (5, 0.004),
        "fine": (5, 0.001),
    }
    assert chosen_policies(None, {}) == {}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["policy.probes=4"], "policies.grid.settings.probes is 4, was 3"),
        (["methods=[anchored,icp]"], "policies have 2 methods"),
        (["methods=chsel"], "methods is ['chsel'], was ['anchored']"),
        (["steps=1"], "steps=1"),
        (["policies=null"], "policy.probes has no effect: policies is null"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line_on_stderr(folder, arguments, message):
    before = stamps(folder)
    done = run(evaluate.main, *SMALL, POLICIES, f"out={folder}", *arguments)
    assert (done.returncode, message in done.stderr) == (2, True), done.stderr
    assert stamps(folder) == before


def test_a_registration_that_fails_is_a_row_with_the_error_of_the_one_before(tmp_path, monkeypatch):
    register = Anchored.register

    def sometimes(method, problem, *observer):
        if problem.key.step == 1:
            raise ValueError("no luck")
        return register(method, problem, *observer)

    monkeypatch.setattr(Anchored, "register", sometimes)
    plan = plan_in(
        tmp_path / "out",
        [{"name": "anchored", "settings": {"size": "small"}}],
        policies=chosen_policies("grid", {"probes": 2}),
        steps=None,
        plausible=False,
        recordings=False,
    )
    plan.session.update(start_contacts=1, start_probe=0)
    join_experiment(plan, "test", configurations=["mustard"], seeds=[20])
    assert do_task(plan, Task(Trial(20, "mustard"), "grid")) == ""
    first, second = collect(plan.folder).to_pylist()
    assert (first["status"], second["status"]) == ("ok", "failed: ValueError: no luck")
    assert second["error"] == first["error"] > 0.0
    assert (second["hypotheses"], second["seconds"]) == (None, None)
