"""The pages of results are what the tables beside them say."""

import pytest

from docs.results import make
from runners.reporting.tables import Table
from tests.runners.made_up_evaluations import row, write_evaluation


def test_pages_are_written_from_the_tables_as_they_are():
    assert make.write(checked=True) == []


def test_an_entry_is_compared_to_the_bit_and_put_beside_the_others(tmp_path, monkeypatch):
    monkeypatch.setattr(make, "HERE", tmp_path / "kept")
    make.evaluation.cache_clear()
    pd = {"package": (100.0, 200.0), "icp": (50.0, 50.0)}
    kept = [row("can", 0, name, step, diversity=pd[name][step]) for name in pd for step in (0, 1)]
    own = [one for one in kept if one["method"] == "icp"]
    own[1] = own[1] | {"diversity": 50.000000000000007}  # the next number after 50
    own += [row("can", 0, "mine", step, diversity=20.0) for step in (0, 1)]
    write_evaluation(tmp_path / "kept/made_up", kept, methods={"icp": {}}, outside={"package": ""})
    mine = write_evaluation(tmp_path / "mine", own, methods={"icp": {}, "mine": {}})
    agreed, differs, table = make.rank(mine)
    make.evaluation.cache_clear()
    assert agreed == "1 of 2 rows that both have are the same to the bit"
    assert "'step': 1, 'method': 'icp'" in differs
    assert isinstance(table, Table)
    ratio = table.header.index("ratio to package [95 %]")
    found = {line[0]: float(line[ratio]) for line in table.rows}  # roots of .5 .25 and of .2 .1
    assert found == pytest.approx({"mine": 0.1414, "ICP": 0.3536, "package": 1.0}, abs=1e-3)
