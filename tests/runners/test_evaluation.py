"""Parts of an evaluation: plans, contenders, failed tasks and sets from outside."""

import json
import os
import signal
import time
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from distributed import get_client

from chsel.errors import ChselError, SettingError
from chsel.methods.icp import Icp
from chsel.numerics.arrays import FloatArray
from chsel.plausible.plausible_set import read_plausible
from chsel.plausible.plausible_settings import plausible_settings
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import object_symmetry
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.settings import settings_mapping
from replay.comparing.verification import EQUAL, NO_RESULT, verify
from replay.mcap.reader import read_recording
from runners.evaluation import tasks
from runners.evaluation.contenders import Contender, chosen_contenders
from runners.evaluation.experiment import collect, join_experiment
from runners.evaluation.metrics import MetricsConfig
from runners.evaluation.plan import OWN, Plan, Task, Trial
from runners.evaluation.run_method import ResultRows, read_external
from runners.evaluation.tasks import connected, do_tasks, is_finished, tasks_of
from runners.evaluation.trial_configurations import chosen_names, chosen_seeds, configurations_of
from runners.evaluation.trial_session import open_recorded, problems
from runners.sessions.probing_settings import ProbingSettings
from tests.runners.in_process import do_task

TRIAL = Trial(0, "mustard")
FAST = {"chsel": {"descent": {"restarts": 1}, "emitter": {"iterations": 20}}}
FAST["chsel_cma_me"] = FAST["chsel"]


def plan_in(folder, methods=("icp",), **changes):
    """A plan of two steps of a kinematic session, with a small grid of plausible poses."""
    definition = settings_mapping(plausible_settings("default", 1.0))
    definition["grid"] |= {"rotations": 300, "upright": 4}
    plan = Plan(
        folder=folder,
        preset="default",
        session={"kind": "kinematic", **settings_mapping(ProbingSettings())},
        objects="models",
        definition={**definition, "epsilon": None},
        metrics=MetricsConfig(points=50),
        steps="4..5",
        starts=OWN,
        every=None,
        recordings=True,
        assets=folder,
        contenders=chosen_contenders(list(methods), FAST, preset="default"),
        outside={},
    )
    return replace(plan, **changes)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A trial's folder with its session and plausible sets."""
    plan = plan_in(tmp_path_factory.mktemp("session"))
    assert do_task(plan, Task(TRIAL)) == ""
    return TRIAL.folder(plan)


@pytest.fixture
def make_plan(session, tmp_path):
    """Makes a plan in a folder of its own, whose session is there already."""

    def make(methods=("icp",), **changes):
        plan = plan_in(tmp_path / "out", methods, **changes)
        join_experiment(plan, "test", configurations=[TRIAL.configuration], seeds=[TRIAL.seed])
        there = TRIAL.folder(plan)
        (there / "plausible").mkdir(parents=True)
        for path in [*session.glob("session.*"), *session.glob("plausible/*")]:
            (there / path.relative_to(session)).hardlink_to(path)
        return plan

    return make


def results(plan):
    return collect(plan.folder).to_pylist()


def test_configurations_and_seeds_are_named_alone_by_patterns_by_object_or_in_lists():
    found = configurations_of("kinematic")
    existing = {name: one.object for name, one in found.items() if one.faults == "clean"}
    for value, names in {
        "drill": "drill",
        "drill*": "drill drill_opposite drill_slanted drill_fallen",
        "cracker_box": "box box_fallen",
        "clamp*,can": "can clamp clamp_sideways",
    }.items():
        assert chosen_names("configurations", value, existing=existing, objects=existing) == tuple(
            names.split()
        )
    assert chosen_names("configurations", ["can", "box"], existing=existing) == ("box", "can")
    assert len(chosen_names("configurations", "all", existing=existing)) == 17
    assert chosen_seeds(3) == (3,)
    assert chosen_seeds([1, 0, 1]) == (0, 1)
    assert chosen_seeds("7,0..1") == (0, 1, 7)


def test_a_contender_has_its_preset_and_changes_by_method_label_and_entry():
    entries = [
        "chsel",
        "chsel@paper#bins",
        {"name": "chsel", "label": "small", "settings": {"archive": {"bins": 8}}},
    ]
    settings = {"chsel": {"passes": 2}, "chsel@paper#bins": {"archive": {"bins": 9}}}
    plain, marked, small = chosen_contenders(entries, settings, preset="default").values()
    assert [one.label for one in (plain, marked, small)] == ["chsel", "chsel@paper#bins", "small"]
    assert [one.settings["archive"]["bins"] for one in (plain, marked, small)] == [56, 9, 8]
    assert [one.settings["passes"] for one in (plain, marked, small)] == [2, 2, 2]
    assert [one.preset for one in (plain, marked, small)] == ["default", "paper", "default"]
    assert marked.settings["cost"]["lookup"] == "nearest"
    assert list(chosen_contenders("icp", {}, preset="default", draws=3)) == [
        "icp",
        "icp+1",
        "icp+2",
    ]
    with pytest.raises(SettingError, match=r"methods has icp\+1 twice"):
        chosen_contenders(["icp", {"name": "icp", "label": "icp+1"}], {}, preset="default", draws=2)


@pytest.fixture(scope="module")
def cluster():
    """A cluster of one worker."""
    with connected(None, 1) as cluster:
        yield cluster


def finished(plan, cluster):
    """Do all tasks of the trial that are not done; why each failed, by its label."""
    missing = [task for task in tasks_of(plan, [TRIAL]) if not is_finished(plan, task)]
    return {
        task.label: failure
        for task, failure in do_tasks(plan, missing, client=cluster[0], workers=cluster[1])
    }


def _dies(plan, task):
    """Kills its worker, always or once, by the label of the task."""
    mark = plan.folder / "tried"
    if task.label == "always" or (task.label == "once" and not mark.exists()):
        mark.touch()
        # Dask does not replace a worker that dies before its nanny knows that it has begun.
        while set(get_client().run(_status, nanny=True).values()) != {"running"}:
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGKILL)
    tasks.do_task(plan, task)


async def _nothing():
    pass


def _status(dask_worker):
    return dask_worker.status.name


def test_workers_that_dask_does_not_replace_are_started_anew(make_plan, monkeypatch):
    """As may be where one dies before its nanny knows that it has begun."""
    monkeypatch.setattr(tasks, "do_task", _dies)
    monkeypatch.setattr(tasks, "_PATIENCE", 1.0)
    plan = make_plan([{"name": "icp", "label": "once"}])
    with connected(None, 1) as own:
        (nanny,) = own[0].cluster.workers.values()
        monkeypatch.setattr(nanny, "instantiate", _nothing)
        assert finished(plan, own)["once"] == ""


def test_a_worker_that_dies_once_costs_nothing_and_twice_its_task_alone(
    make_plan, cluster, monkeypatch
):
    monkeypatch.setattr(tasks, "do_task", _dies)
    plan = make_plan([{"name": "icp", "label": label} for label in ("always", "once", "fine")])
    ended = finished(plan, cluster)
    assert (ended["once"], ended["fine"]) == ("", "")
    assert ended["always"] == "its worker died 2 times, as of a lack of memory"
    status = {row["method"]: row["status"] for row in results(plan)}
    assert status["once"] == status["fine"] == "ok"
    failed = [row for row in results(plan) if row["method"] == "always"]
    assert [row["step"] for row in failed] == [4, 5]
    assert {row["status"] for row in failed} == {f"failed: {ended['always']}"}
    assert {row["diversity"] for row in failed} == {None}
    monkeypatch.undo()
    assert finished(plan, cluster) == {"always": ""}  # the same command tries again
    assert {row["status"] for row in results(plan)} == {"ok"}
    assert not list(TRIAL.folder(plan).glob("*failed*"))


class _FailsAtFour(Icp):
    def register(self, problem, observer=None):
        if problem.key.step == 4:
            raise ChselError("nothing\nto see")
        return super().register(problem, observer)


def test_a_registration_that_fails_is_a_row_and_the_session_goes_on(make_plan, monkeypatch):
    plan = make_plan()
    monkeypatch.setattr(Contender, "method", lambda self: _FailsAtFour())
    assert do_task(plan, Task(TRIAL, "icp")) == ""
    first, second = results(plan)
    assert first["status"] == "failed: nothing to see"
    assert first["members"] > 0
    assert first["seconds"] is first["digest"] is first["diversity"] is None
    assert second["status"] == "ok"
    verdicts = verify(read_recording(TRIAL.folder(plan) / "icp.mcap"))
    assert [verdict.outcome for verdict in verdicts] == [NO_RESULT, EQUAL]


def test_a_session_that_fails_fails_its_methods_and_no_others(tmp_path, cluster):
    plan = plan_in(tmp_path, objects="scans", assets=tmp_path / "nowhere")
    join_experiment(plan, "test", configurations=[TRIAL.configuration], seeds=[TRIAL.seed])
    ended = finished(plan, cluster)
    assert ended["icp"] == f"session: {ended['']}" != "session: "
    (row,) = results(plan)
    assert row["step"] is None
    assert row["status"].startswith("failed: session: ")


def test_sets_from_outside_rank_as_methods_do(make_plan, tmp_path):
    folders = {name: tmp_path / name for name in ("perfect", "text", "absent")}
    for folder in folders.values():
        (folder / "mustard").mkdir(parents=True)
    plan = make_plan(outside=folders)
    sets = {}
    for path in (TRIAL.folder(plan) / "plausible").iterdir():
        found = read_plausible(path)
        sets[f"step_{step_of(plan, found.points_digest)}"] = found.world_from_object
    np.savez(folders["perfect"] / "mustard" / "seed_0.npz", **sets, seconds_4=0.5)
    shifted = sets["step_5"].copy()
    shifted[:, 0, 3] += 0.3
    listed = {"step_5": shifted.tolist(), "cost_5": list(range(len(shifted)))[::-1]}
    (folders["text"] / "mustard" / "seed_0.json").write_text(json.dumps(listed))
    for label in ("icp", *folders):
        assert do_task(plan, Task(TRIAL, label)) == ""
    by = {(row["method"], row["step"]): row for row in results(plan)}
    for step in (4, 5):
        own = by["perfect", step]
        assert own["status"] == "ok"
        assert own["preset"] == "outside"
        assert own["diversity"] < 1e-6  # mm^2
        assert own["exact_members"] == 1.0
        assert own["best_cost"] is own["problem_digest"] is None
        assert own["diversity"] < 1e-3 * by["icp", step]["diversity"]
        assert by["absent", step]["status"].startswith("failed: there is no ")
    assert (by["perfect", 4]["seconds"], by["perfect", 5]["seconds"]) == (0.5, None)
    assert by["text", 4]["status"].endswith("seed_0.json has no set of this step")
    assert by["text", 5]["best_cost"] == 0.0
    assert by["text", 5]["diversity"] > 1e4
    assert by["text", 5]["exact_members"] == 0.0
    task = Task(TRIAL, "text")
    assert is_finished(plan, task)
    listed["step_4"] = sets["step_4"].tolist()
    (folders["text"] / "mustard" / "seed_0.json").write_text(json.dumps(listed))
    assert not is_finished(plan, task)


def step_of(plan, points_digest):
    """The step whose known points have a digest."""
    found = problems(plan, TRIAL, session=open_recorded(plan, TRIAL))
    return next(one.key.step for one in found if one.points.digest == points_digest)


POSE = np.eye(4)
SCALED = np.diag([1.1, 1.0, 1.0, 1.0])


def test_a_set_from_outside_that_is_wrong_is_told(tmp_path):
    (tmp_path / "mustard").mkdir()
    plan = plan_in(tmp_path, outside={"mine": tmp_path})
    for values, message in (
        ({"step_3": [POSE, SCALED]}, r"step_3\[1\] is not a rigid transform"),
        ({"step_3": [POSE[:3]]}, r"step_3 has shape \(1, 3, 4\)"),
        ({"step_3": np.zeros((0, 4, 4))}, "step_3 is empty"),
        ({"step_99": [POSE]}, "has step_99; accepted: steps 0 to 15 of mustard"),
        ({"poses": [POSE]}, "has 'poses'; accepted: step_K, cost_K and seconds_K"),
        ({"step_3": [POSE, POSE], "cost_3": [1.0]}, "cost_3 is not as long as step_3"),
    ):
        np.savez(tmp_path / "mustard" / "seed_0.npz", **values)
        with pytest.raises(ChselError, match=message):
            read_external(plan, TRIAL, label="mine")


def test_searches_are_measured_from_the_same_starts(make_plan):
    plan = make_plan(["chsel", "chsel_cma_me"], starts="gradient_descent", every=5)
    for label in plan.contenders:
        assert do_task(plan, Task(TRIAL, label)) == ""
    rows = results(plan)
    starts = {(row["step"], row["problem_digest"]) for row in rows}
    assert len(starts) == 2  # one a step, whatever the method
    measured = pa.parquet.read_table(plan.folder / "iterations.parquet").to_pylist()
    assert [row["iteration"] for row in measured] == [0, 5, 10, 15, 20] * 4
    for row in rows:
        own = [m for m in measured if (m["method"], m["step"]) == (row["method"], row["step"])]
        for name in ("coverage", "plausibility", "diversity"):
            assert own[-1][name] == pytest.approx(row[name], rel=1e-9)
        assert own[-1]["mean_cost"] == pytest.approx(row["mean_cost"], rel=1e-6)
        costs = [one["best_cost"] for one in own]
        assert costs == sorted(costs, reverse=True)
        assert own[-1]["filled"] > own[0]["filled"]
    for label in plan.contenders:
        recording = read_recording(TRIAL.folder(plan) / f"{label}.mcap")
        assert {verdict.outcome for verdict in verify(recording)} == {EQUAL}
        assert [snapshot.iteration for snapshot in recording.snapshots(4)] == [0, 5, 10, 15, 20]


def test_a_session_with_faults_is_measured_by_the_plausible_sets_of_that_without(
    make_plan, monkeypatch
):
    plan = make_plan(steps="5")
    faulty = Trial(0, "mustard+noise_3mm")
    join_experiment(plan, "test", configurations=[faulty.configuration], seeds=[0])
    asked: list[FloatArray] = []

    def holds(self, problem, found, poses):
        asked.append(poses)
        return np.array([problem.key.step == 5])

    monkeypatch.setattr(Icp, "holds", holds, raising=False)
    for task in (Task(faulty), Task(faulty, "icp"), Task(TRIAL, "icp")):
        assert do_task(plan, task) == ""
    assert not (faulty.folder(plan) / "plausible").exists()
    clean, noisy = results(plan)
    assert [one["faults"] for one in (clean, noisy)] == ["clean", "noise_3mm"]
    assert (clean["members"], clean["true_cost"]) == (noisy["members"], noisy["true_cost"])
    assert clean["status"] == noisy["status"] == "ok"
    assert clean["problem_digest"] != noisy["problem_digest"]
    assert clean["truth_held"] is noisy["truth_held"] is True

    recording = read_recording(faulty.folder(plan) / "icp.mcap")
    start = recording.start
    truth = recording.start.world_from_object
    assert start.config["session"]["faults"]["contact_noise"] == 0.003
    without = read_recording(TRIAL.folder(plan) / "session.mcap").start
    np.testing.assert_array_equal(truth, without.world_from_object)
    np.testing.assert_allclose(asked[0][0] @ truth, np.eye(4), atol=1e-12)
    found = recording.hypotheses(5).object_from_world
    symmetry = object_symmetry(start.mesh)
    position, rotation = pose_errors(found, truth, symmetry=symmetry)
    nearest = int(np.argmin(np.abs(position - noisy["nearest_position"])))
    assert rotation[nearest] == pytest.approx(noisy["nearest_rotation"])
    assert 0.0 < noisy["nearest_hypothesis"] < 0.1

    rows = ResultRows(plan, faulty, session=open_recorded(plan, faulty), label="icp")
    true = inverse(truth[None])
    exact = Hypotheses(
        true, np.zeros(1), duplicate=np.zeros(1, dtype=bool), cell=np.full(1, -1), elites=true
    )
    assert (
        rows.row(recording.problem(5), exact)["exact_members"] == 1.0
    )  # by contacts without noise
