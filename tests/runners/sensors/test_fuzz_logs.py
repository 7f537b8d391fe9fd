"""Some hundred changed logs; thousands by hand, see fuzz_logs."""

from pathlib import Path

from tests.tools.fuzz_logs import originals, run_case
from tests.tools.fuzzing import Tally

CASES = 160


def test_changed_logs_end_in_an_error_or_in_sound_messages(tmp_path: Path) -> None:
    whole, tally = originals(tmp_path), Tally()
    for index in range(CASES):
        run_case(index, 1, whole, tmp_path, tally)
    assert tally.outcomes.total() == CASES
    for outcome in ("raw: some, with faults", "cut: some, with faults", "messages: the same"):
        assert tally.outcomes[outcome] < CASES / 4
    assert tally.outcomes["messages: some, with faults"] > 10
