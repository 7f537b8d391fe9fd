"""Two checkouts compared: ratios, pairs in turn, and this checkout beside itself."""

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from runners import benchmark
from runners.benchmarks.checkouts import (
    ROOT,
    Answer,
    CheckoutError,
    ComparedRow,
    Comparison,
    checkout,
    commit_of,
)
from tests.runners.in_process import run as in_process


def comparison(measure, *, repeats=2, **how):
    """The rows of two stand-ins for checkouts, by a function of their names."""
    compared = Comparison.__new__(Comparison)
    compared.sides = {name: SimpleNamespace(name=name) for name in ("other", "this")}
    compared.repeats = repeats
    return list(compared.rows("case", lambda side: measure(side.name), **how))


def test_a_ratio_is_how_many_times_as_fast_this_checkout_is_by_pair():
    times = ComparedRow("case", "ms", "processor", other=(10.0, 30.0), this=(5.0, 10.0))
    assert times.ratios == (2.0, 3.0)
    rates = ComparedRow("case", "1/min", "wall", other=(10.0,), this=(40.0,))
    assert rates.ratios == (4.0,)
    assert ComparedRow("case", "ms", "processor", other=(), this=(5.0,)).ratios == ()
    assert times.mapping()["ratios"] == (2.0, 3.0)


def test_sides_take_turns_and_what_comes_first_does_not_count():
    order = []

    def measure(name):
        order.append(name)
        taken = {"processor": 0.001 * len(order), "wall": 1.0}
        return Answer({"": taken, "memory": {"bytes": 3e6}}, count=5)

    time, memory = comparison(measure)
    assert order == ["other", "this", "this", "other", "other", "this"]
    assert time.other == pytest.approx((4.0, 5.0))
    assert time.this == pytest.approx((3.0, 6.0))
    assert (memory.case, memory.unit, memory.other) == ("case, memory", "MB", (3.0, 3.0))
    (rate, _) = comparison(measure, unit="1/min", clock="wall", repeats=1, warm=False)
    assert rate.this == (300.0,)


def test_a_side_that_cannot_do_a_measurement_says_why_and_the_other_goes_on():
    def measure(name):
        if name == "other":
            raise CheckoutError("no such method")
        return Answer({"": {"processor": 0.5}})

    (row,) = comparison(measure, unit="s")
    assert (row.other, row.this, row.ratios) == ((), (0.5, 0.5), ())
    assert row.missing == "other: no such method"


def test_a_revision_is_checked_out_for_as_long_as_it_is_needed(tmp_path):
    if not (ROOT / ".git").exists():
        pytest.skip("not a checkout of git")
    with checkout("HEAD") as folder:
        assert folder != ROOT
        assert (folder / "chsel" / "__init__.py").exists()
        assert commit_of(folder) == commit_of(ROOT).removesuffix("-dirty")
    assert not folder.exists()
    listed = subprocess.check_output(["git", "worktree", "list"], cwd=ROOT, text=True)
    assert str(folder) not in listed
    with checkout(str(ROOT)) as folder:
        assert folder == ROOT


def test_this_checkout_beside_itself_has_a_ratio_for_every_stage(tmp_path):
    command = [sys.executable, "-m", "runners.benchmark", f"against={ROOT}", "quick=true"]
    environment = {**os.environ, "COLUMNS": "80", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, "rows=[stages]", f"logs={tmp_path}"],
        capture_output=True,
        text=True,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "benchmark").iterdir()
    rows = json.loads((folder / "benchmark.json").read_text())["rows"]
    for row in rows:
        assert len(row["other"]) == len(row["this"]) == 2
        np.testing.assert_allclose(row["ratios"], np.divide(row["other"], row["this"]))
    assert {row["case"].rpartition(", ")[2] for row in rows} == {
        *("sample", "fit", "search", "descend", "spread", "other")
    }
    page = (folder / "comparison.md").read_text()
    assert page.endswith(done.stdout.partition("written: ")[0])
    assert "load" in page
    assert f"this: {commit_of(ROOT)}" in page


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("against=no-such-revision", "is neither a folder with a checkout nor a revision"),
        ("against=EMPTY", "has no package chsel"),
        ("against=BROKEN", "cannot be used: its process ended: ImportError: broken"),
        ("against=. rows=[all]", "rows is 'all'; accepted: anchored, methods, stages"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(tmp_path, override, message):
    for name, text in (("EMPTY", None), ("BROKEN", "raise ImportError('broken')")):
        package = tmp_path / name / "chsel"
        package.mkdir(parents=True)
        if text is not None:
            (package / "__init__.py").write_text(text)
    for name in ("EMPTY", "BROKEN"):
        override = override.replace(name, str(tmp_path / name))
    done = in_process(benchmark.main, *override.split(), f"logs={tmp_path / 'logs'}")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith("error: ")
    assert message in done.stderr
    assert not (tmp_path / "logs").exists()
