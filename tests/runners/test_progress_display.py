"""The table that an evaluation prints at its end."""

from __future__ import annotations

import pyarrow as pa
import pytest

from runners.evaluation.progress_display import ProgressDisplay
from runners.evaluation.table import RESULTS
from tests.runners.made_up_evaluations import row


def test_the_summary_is_medians_by_object_in_mm2_and_milliseconds(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = [
        row("can", seed, "icp", 4, diversity=value, root=1.0, seconds=0.001 * value)
        for seed, value in enumerate((1.0, 2.0, 60.0))
    ]
    rows += [row("box", 0, "icp", 4, diversity=1234.0, seconds=0.003)]
    rows += [row("box", 1, "icp", 4) | {"status": "failed: no reason"}]
    rows += [row("can", 0, "svgd", 4, diversity=7.0)]
    table = pa.Table.from_pylist(rows, schema=RESULTS)
    ProgressDisplay().summary(table, ["icp", "svgd", "cvo"], "wide_sums, by sums")
    told = capsys.readouterr().out.splitlines()
    assert "PD in mm²" in told[0]
    cells = [line.split() for line in told]
    assert ["method", "can", "box", "ms"] in cells
    assert ["icp", "2", "1234", "2.5"] in cells  # of 1, 2, 60 and 3 ms
    assert ["svgd", "7"] in cells
    assert not any(line.startswith("cvo") for line in told)
    assert told[-1] == "plausible sets: wide_sums, by sums"
