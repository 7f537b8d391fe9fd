"""Changed recordings with a fixed seed: a clear error or a right answer, never a wrong "equal"."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.writer import MCAP0_MAGIC

from chsel.errors import RecordingError
from replay.comparing.verification import verify
from replay.events import Event
from replay.mcap.reader import read_recording
from tests.replay.conftest import same_bits
from tests.tools.fuzz_recordings import Original, main, originals, run_case
from tests.tools.fuzzing import Tally, peak_memory, quiet

CASES = 150  # of each of three blocks; thousands by hand, see fuzz_recordings
SEED = 20


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[Original]:
    with quiet():
        return originals(tmp_path_factory.mktemp("originals"))


def test_the_originals_are_small_and_equal_to_what_is_registered_today(
    whole: list[Original], tmp_path: Path
) -> None:
    for original in whole:
        assert len(original.data) < 60_000
        path = tmp_path / original.name
        path.write_bytes(original.data)
        with quiet():
            verdicts = list(verify(read_recording(path)))
        assert {verdict.outcome for verdict in verdicts} == {"equal"}
        assert len(verdicts) == (7 if original.name == "steered" else 2)


@pytest.mark.parametrize("block", range(3))
def test_every_case_ends_in_a_clear_error_or_a_right_answer(
    whole: list[Original], tmp_path: Path, block: int
) -> None:
    tally, before = Tally(), peak_memory()
    for original in whole:
        (tmp_path / f"{original.name}.mcap").write_bytes(original.data)
    with quiet():
        for index in range(block * CASES, (block + 1) * CASES):
            run_case(index, SEED, whole, tmp_path, tally)
    assert tally.outcomes.total() == CASES
    assert sum(n for name, n in tally.outcomes.items() if "refused" in name) > CASES // 4
    assert sum(n for name, n in tally.outcomes.items() if "equal" in name) > CASES // 50
    assert peak_memory() - before < 200.0


def test_a_cut_at_every_byte_is_unfinished(whole: list[Original], tmp_path: Path) -> None:
    path, data = tmp_path / "cut.mcap", whole[0].data
    path.write_bytes(data)
    with path.open("r+b") as file:
        for length in range(len(data) - 1, -1, -1):
            file.truncate(length)
            with pytest.raises(RecordingError, match=r"is unfinished; `pyth|is no MCAP file"):
                read_recording(path)


def test_a_cut_keeps_what_is_whole_also_before_a_false_end(
    whole: list[Original], tmp_path: Path
) -> None:
    path, original = tmp_path / "cut.mcap", whole[1]
    kept = set()
    for length in range(8, len(original.data), 331):
        for end in (b"", MCAP0_MAGIC):
            path.write_bytes(original.data[:length] + end)
            with pytest.raises(RecordingError, match=r"is (unfinished|damaged before byte)"):
                read_recording(path)
            events = _events_of(path)
            assert all(map(same_bits, events, original.events))
            kept.add(len(events))
    assert {0, 1, len(original.events)} <= kept


def _events_of(path: Path) -> list[Event]:
    """All whole events, none if not even the session is whole."""
    try:
        return list(read_recording(path, partial=True).events())
    except RecordingError as error:
        if "has no session in it" not in str(error):
            raise
        return []


def test_the_command_tells_what_the_cases_came_to(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--cases", "20", "--seed", "1"]) == 0
    shown = capsys.readouterr().out
    assert "20 cases in" in shown
    assert "0 wrong" in shown
    assert "refused" in shown
