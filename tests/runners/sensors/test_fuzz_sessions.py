"""A few changed logs and rigs; thousands by hand, see fuzz_sessions."""

from pathlib import Path

from tests.tools.fuzz_sessions import run_case, whole_log
from tests.tools.fuzzing import Tally

CASES = 16


def test_sessions_of_changed_logs_end_in_an_error_or_in_sound_events(tmp_path: Path) -> None:
    whole, tally = whole_log(), Tally()
    for index in range(CASES):
        run_case(index, 2, whole, tmp_path, tally)
    assert tally.outcomes.total() == CASES
    assert tally.outcomes["contacts"] > 5
    assert tally.outcomes["refused"] > 2
