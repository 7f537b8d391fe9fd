"""An evaluation beside the one that is kept: equal bits, its place, and what has no counterpart."""

import pytest

from runners import rank
from runners.reporting.ranking import ranking
from runners.reporting.tables import Table
from tests.runners.in_process import run
from tests.runners.made_up_evaluations import row, write_evaluation


def test_an_entry_is_compared_to_the_bit_and_put_beside_the_others(tmp_path):
    pd = {"package": (100.0, 200.0), "icp": (50.0, 50.0)}
    kept = [
        row("can", 0, method=name, step=step, diversity=pd[name][step])
        for name in pd
        for step in (0, 1)
    ]
    own = [one for one in kept if one["method"] == "icp"]
    own[1] = own[1] | {"diversity": 50.000000000000007}  # the next number after 50
    own += [row("can", 0, method="mine", step=step, diversity=20.0) for step in (0, 1)]
    write_evaluation(tmp_path / "kept/made_up", kept, methods={"icp": {}}, outside={"package": ""})
    mine = write_evaluation(tmp_path / "mine", own, methods={"icp": {}, "mine": {}})
    agreed, differs, table = ranking(mine, tmp_path / "kept")
    assert agreed == "1 of 2 rows that both have are the same to the bit"
    assert "'step': 1, 'method': 'icp'" in differs
    assert isinstance(table, Table)
    ratio = table.header.index("ratio to package [95 %]")
    found = {line[0]: float(line[ratio]) for line in table.rows}  # roots of .5 .25 and of .2 .1
    assert found == pytest.approx({"mine": 0.1414, "ICP": 0.3536, "package": 1.0}, abs=1e-3)


def test_what_has_no_counterpart_is_one_line(tmp_path):
    rows = [row("can", 0, method="icp", step=1)]
    methods = {"icp": {}}
    smoke = write_evaluation(tmp_path / "smoke", rows, methods=methods, name="smoke")
    other = write_evaluation(tmp_path / "other", rows, methods=methods, name="next_probe_scans")
    for words, message in (
        ([str(smoke)], "nothing is kept beside evaluation 'smoke'; accepted: anchored, anchored_"),
        ([str(other)], "is of methods, and the kept one is not; accepted: another name for it"),
        ([str(tmp_path)], f"{tmp_path}/experiment.json cannot be read"),
        ([], "dir is missing; pass the folder of an evaluation"),
    ):
        done = run(rank.main, *words)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.count("\n") == 1
        assert message in done.stderr
