"""Two checkouts compared: ratios, pairs in turn, and this checkout beside itself."""

import json
import subprocess
from collections import defaultdict
from types import SimpleNamespace

import numpy as np
import pytest

from runners import benchmark
from runners.benchmarks.benchmark_report import comparison_page
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


def readings(clock, *values):
    return tuple({clock: value} for value in values)


def test_a_ratio_is_how_many_times_as_fast_this_checkout_is_by_pair():
    other, this = readings("processor", 0.01, 0.03), readings("processor", 0.005, 0.01)
    times = ComparedRow("case", "ms", "processor", other=other, this=this)
    np.testing.assert_allclose(times.numbers(times.other), [10.0, 30.0])
    np.testing.assert_allclose(times.ratios, [2.0, 3.0])
    np.testing.assert_allclose(times.mapping()["ratios"], [2.0, 3.0])
    other, this = readings("wall", 2.0), readings("wall", 0.5)
    rates = ComparedRow("case", "1/min", "wall", other=other, this=this)
    np.testing.assert_allclose(rates.numbers(rates.this), [120.0])
    np.testing.assert_allclose(rates.ratios, [4.0])
    assert len(ComparedRow("case", "1/min", "wall", other=(), this=this).ratios) == 0


def test_sides_take_turns_and_what_comes_first_does_not_count():
    order = []

    def measure(name):
        order.append(name)
        taken = {"processor": 0.001 * len(order), "wall": 1.0}
        return Answer({"": taken, "memory": {"bytes": 3e6}})

    time, memory = comparison(measure)
    assert order == ["other", "this", "this", "other", "other", "this"]
    np.testing.assert_allclose(time.numbers(time.other), [4.0, 5.0])
    np.testing.assert_allclose(time.numbers(time.this), [3.0, 6.0])
    assert (memory.case, memory.unit) == ("case, memory", "MB")
    np.testing.assert_allclose(memory.numbers(memory.this), [3.0, 3.0])
    order.clear()
    (rate, _) = comparison(measure, unit="1/min", clock="wall", seldom=True, warm=False)
    assert order == ["this", "other"]
    assert rate.numbers(rate.this) == [60.0]


def test_a_side_that_cannot_do_a_measurement_says_why_and_the_other_goes_on():
    def measure(name):
        if name == "other":
            raise CheckoutError("no such method")
        return Answer({"": {"processor": 0.5}})

    (row,) = comparison(measure, unit="s")
    assert (row.other, len(row.this), len(row.ratios)) == ((), 2, 0)
    assert row.missing == "other: no such method"
    cells = comparison_page([row], {"machine": defaultdict(float), "checkouts": {}})[-4]
    assert [cell.strip() for cell in cells.split("|")[4:7]] == ["-", "0.5", ""]
    assert comparison_page([row], {"machine": defaultdict(float), "checkouts": {}})[-2] == (
        "case: other: no such method"
    )


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
    words = (f"against={ROOT}", "quick=true", "rows=[stages]", f"logs={tmp_path}")
    done = in_process(benchmark.main, *words)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "benchmark").iterdir()
    rows = json.loads((folder / "benchmark.json").read_text())["rows"]
    for row in rows:
        assert len(row["other"]) == len(row["this"]) == 2
        other, this = ([taken["processor"] for taken in row[side]] for side in ("other", "this"))
        np.testing.assert_allclose(row["ratios"], np.divide(other, this))
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
