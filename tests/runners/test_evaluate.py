"""`python -m runners.evaluate` as a user runs it: tables, metrics, interruptions."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from glob import glob  # which passes over folders that vanish meanwhile, as Path.rglob does not
from pathlib import Path
from subprocess import PIPE

import psutil
import pyarrow as pa
import pyarrow.parquet
import pytest

from replay.comparing.verification import EQUAL, verify
from replay.mcap.reader import read_recording
from runners import evaluate, plausible, probe
from runners.command.choices import CONF
from runners.evaluation.metrics import definition_label
from runners.evaluation.plan import Plan, Trial
from runners.reporting.tables import number
from tests.runners.in_process import run
from tests.runners.test_plausible import rows

SMALL = (
    "session=kinematic",
    "configurations=mustard",
    "seeds=0",
    "steps=4..5",
    "settings.chsel.descent.restarts=1",
    "settings.chsel.emitter.iterations=10",
    "definition.grid.rotations=300",
    "definition.grid.upright=4",
    "metrics.points=50",
)
METHODS = "methods=[chsel,icp]"
DEFINITION_OF = {
    "anchored": "wide_means",
    "anchored_10mm": "wide_means_10mm",
    "anchored_sums": "wide_sums",
    "paper_real": "default",
    "paper_sim": "default",
}
TRIAL = Path("trials") / "mustard" / "seed_0"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished evaluation of two methods."""
    folder = tmp_path_factory.mktemp("evaluate") / "out"
    done = evaluated(folder, METHODS)
    assert (done.returncode, done.stderr) == (0, "")
    assert "1 trials, 2 methods, 3 tasks, of which 0 are finished" in done.stdout
    assert re.search(r"Plausible sets: default~\w{8}, cost by means over points, ", done.stdout)
    return folder


def evaluated(folder, *arguments):
    """Run the command in this process, with one worker."""
    switches = [word for word in arguments if word.startswith("-")]
    rest = [word for word in arguments if word not in switches]
    return run(evaluate.main, *switches, *SMALL, f"out={folder}", "workers=1", *rest)


def table(folder, name="results"):
    return pa.parquet.read_table(folder / f"{name}.parquet").to_pylist()


@pytest.mark.parametrize("path", sorted(CONF.glob("experiment/*.yaml")), ids=lambda path: path.stem)
def test_every_experiment_can_be_planned(path, tmp_path, monkeypatch):
    planned: list[tuple[Plan, list[Trial]]] = []

    def instead(plan, trials, **_):
        planned.append((plan, trials))
        return False

    monkeypatch.setattr(evaluate, "evaluate", instead)
    done = run(evaluate.main, f"experiment={path.stem}", f"out={tmp_path}")
    assert (done.returncode, done.stderr) == (0, "")
    ((plan, trials),) = planned
    assert plan.contenders
    assert trials
    if path.stem in DEFINITION_OF:
        assert definition_label(plan.definition) == DEFINITION_OF[path.stem]
    if path.stem == "anchored_10mm":  # what it is for, beside what it takes from `anchored`
        settings = plan.plausible_settings(0.001)
        assert (settings.cost.tolerance, settings.fill_to) == (0.01, 300)


def test_the_table_has_a_row_a_registration_that_the_recordings_confirm(folder):
    results = table(folder)
    assert [(row["method"], row["step"]) for row in results] == [
        ("chsel", 4),
        ("chsel", 5),
        ("icp", 4),
        ("icp", 5),
    ]
    for row in results:
        assert row["status"] == "ok"
        assert (row["object"], row["configuration"], row["seed"]) == ("mustard", "mustard", 0)
        assert re.fullmatch(r"default~[0-9a-f]{8}", row["definition"])  # of a smaller grid
        assert row["diversity"] == pytest.approx(row["coverage"] + row["plausibility"])
        assert row["root"] == pytest.approx(row["diversity"] ** 0.5)
        assert row["seconds"] > 0.0
        assert 0.0 <= row["exact_members"] <= 1.0
        assert 0.0 <= row["precision"] <= 1.0
        assert 0.0 <= row["recall"] <= 1.0
        recording = read_recording(folder / TRIAL / f"{row['method']}.mcap")
        step = row["step"]
        assert row["digest"] == recording.hypotheses(step).digest
        assert row["problem_digest"] == recording.problem(step).digest
        assert row["best_cost"] == recording.hypotheses(step).cost[0]
    for method in ("chsel", "icp"):
        verdicts = list(verify(read_recording(folder / TRIAL / f"{method}.mcap")))
        assert [verdict.outcome for verdict in verdicts] == [EQUAL, EQUAL]


def test_metrics_are_those_of_runners_plausible(folder):
    small = [word for word in SMALL if word.startswith(("definition", "metrics"))]
    done = run(plausible.main, str(folder / TRIAL / "icp.mcap"), *small)
    assert (done.returncode, done.stderr) == (0, "")
    mine = [row for row in table(folder) if row["method"] == "icp"]
    for cells, row in zip(rows(done.stdout), mine, strict=True):
        assert cells[-1] == "found"
        text = " ".join(cells)
        for name in ("coverage", "plausibility", "rank"):
            assert number(row[name]) in text


def test_registrations_are_those_of_runners_probe(folder, tmp_path):
    session = ("session=recorded", f"session.path={folder / TRIAL / 'session.mcap'}")
    done = run(probe.main, *session, "method=icp", "recording=mcap", f"logs={tmp_path}")
    assert (done.returncode, done.stderr) == (0, "")
    (path,) = tmp_path.rglob("recording.mcap")
    recording = read_recording(path)
    for row in table(folder):
        if row["method"] == "icp":
            assert recording.hypotheses(row["step"]).digest == row["digest"]


def test_what_is_finished_is_not_done_again(folder):
    before = stamps(folder)
    again = evaluated(folder, METHODS)
    assert "3 tasks, of which 3 are finished" in again.stdout
    assert stamps(folder) == before
    more = evaluated(folder, "methods=[icp,svgd]", "settings.svgd.iterations=5")
    assert (more.returncode, more.stderr) == (0, "")
    assert "3 tasks, of which 2 are finished" in more.stdout
    after = stamps(folder)
    assert {name: after[name] for name in before} == before
    new = {Path(name).name for name in after if name not in before}
    assert new == {"svgd.mcap", "svgd.parquet"}
    assert {row["method"] for row in table(folder)} == {"chsel", "icp", "svgd"}
    told = json.loads((folder / "experiment.json").read_text())
    assert list(told["methods"]) == ["chsel", "icp", "svgd"]
    assert told["methods"]["svgd"]["settings"]["iterations"] == 5


def stamps(folder):
    """When each finished file of the trials was written."""
    files = [path for path in (folder / "trials").rglob("[!.]*") if path.is_file()]
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in files}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["metrics.points=60"], "metrics.points is 60, was 50"),
        (["configurations=[mustard,teapot]"], "configurations names 'teapot'; accepted: all"),
        (["seeds=a"], "seeds names 'a'"),
        (["steps=99"], "steps is 99; accepted: steps that a configuration has"),
        (["methods=[chsel,chsell]"], "method is 'chsell'"),
        (["methods=[{name:chsel,label:a/b}]"], "'a/b' is not a label"),
        (["settings.cpd.iterations=1"], "settings of a method is 'cpd'"),
        (["session=recorded"], "session is 'recorded'; accepted: simulated, kinematic"),
        (["workers=2", "scheduler=tcp://127.0.0.1:1"], "workers are of this machine"),
        (["workers=10000"], "workers is 10000; accepted: an integer from 1 to 256"),
        (["objects=scans", "assets.dir=nowhere"], "mustard_bottle"),
        (["outside.mine=nowhere"], "nowhere; accepted: a folder"),
        (["outside.icp=."], "outside has icp, as methods has"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line_on_stderr(folder, arguments, message):
    before = stamps(folder)
    done = run(evaluate.main, *SMALL, METHODS, f"out={folder}", *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert stamps(folder) == before


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_run_goes_on_and_a_killed_one_leaves_nobody_at_work(tmp_path):
    slow = ("settings.chsel.emitter.iterations=1000000", "methods=chsel", "workers=1")
    command = [sys.executable, "-m", "runners.evaluate", *SMALL, f"out={tmp_path}", *slow]

    def started():
        """The command, at work on the method; in a process group of its own, as in a shell."""
        before = set(glob("trials/*/*/.chsel.mcap.*", root_dir=tmp_path))
        process = subprocess.Popen(
            command, stdout=PIPE, stderr=PIPE, text=True, start_new_session=True
        )
        while not set(glob("trials/*/*/.chsel.mcap.*", root_dir=tmp_path)) - before:
            assert process.poll() is None
            time.sleep(0.1)
        return process

    with started() as process:
        workers = children(process.pid)
        os.killpg(process.pid, signal.SIGINT)
        out, errors = process.communicate()
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert "interrupted: what is finished stays" in out
    assert table(tmp_path) == []
    told = json.loads((tmp_path / "experiment.json").read_text())
    assert told["commands"][0].startswith("python -m runners.evaluate session=kinematic")
    kept = stamps(tmp_path)
    assert len(kept) == 4  # the session's recording, what it tells, two plausible sets
    with started() as process:
        workers += children(process.pid)
        process.kill()
        out, _ = process.communicate()
    assert "2 tasks, of which 1 are finished" in out
    gone, alive = psutil.wait_procs(workers, timeout=600)
    assert len(gone) >= 2
    assert alive == []
    assert stamps(tmp_path) == kept


def children(process):
    return psutil.Process(process).children(recursive=True)
