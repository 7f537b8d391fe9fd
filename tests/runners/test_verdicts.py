"""What verdicts results get on points with known faults."""

from __future__ import annotations

from chsel.problem.registration_problem import VERDICTS
from runners.benchmarks.verdicts import counted, table


def test_a_fault_is_told_from_points_that_are_right() -> None:
    told: list[str] = []
    faults = ["none", "mesh 1.2 times too large"]
    counts = counted(["clamp"], ["anchored"], faults, told.append)
    assert [tuple(count) for count in counts.values()] == [("determined",), ("nothing fits",)]
    assert told == ["clamp, none, anchored", "clamp, mesh 1.2 times too large, anchored"]
    lines = table(counts)
    assert lines[0].split(" | ")[2:] == [*VERDICTS[:3], "nothing fits |"]
    assert lines[2] == "| none | anchored | 1 |  |  |  |"
    assert lines[3] == "| mesh 1.2 times too large | anchored |  |  |  | 1 |"
