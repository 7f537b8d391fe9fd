"""Files that survive a power cut, and errors that name the file that could not be written."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from chsel.errors import RecordingError
from chsel.problem import online_registration as online
from replay.__main__ import main
from replay.files import WritingError, new_file, whole_file
from replay.mcap.writer import McapRecorder
from runners.run.recording import write_in_run_folder
from tests.runners.in_process import run

REPOSITORY = Path(__file__).resolve().parents[2]
STORED = REPOSITORY / "tests" / "replays" / "spam_can_icp.mcap"


@dataclass
class Synced:
    """What was synced to the disk: of files the size then, by inode; of folders the names then."""

    sizes: dict[int, int] = field(default_factory=dict)
    names: dict[int, list[str]] = field(default_factory=dict)

    def holds(self, path: Path) -> bool:
        """Whether a file as it is now, and then its name, are on the disk."""
        there = path.stat()
        named = path.name in self.names.get(path.parent.stat().st_ino, [])
        return named and self.sizes.get(there.st_ino) == there.st_size


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> Synced:
    """Follows os.fsync."""
    found = Synced()

    def fsync(number: int) -> None:
        there = os.fstat(number)
        if os.path.isdir(f"/proc/self/fd/{number}"):
            found.names[there.st_ino] = os.listdir(number)
        else:
            found.sizes[there.st_ino] = there.st_size

    monkeypatch.setattr(os, "fsync", fsync)
    return found


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Makes files with a text in their names fail as on a full disk: the error names none."""

    def fill(part: str) -> None:
        write_text = Path.write_text

        def fail(path: Path, *more: object, **named: object) -> int:
            if part in path.name:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return write_text(path, *more, **named)  # type: ignore[arg-type]

        monkeypatch.setattr(Path, "write_text", fail)

    return fill


def test_a_recording_is_on_the_disk_when_it_is_closed(events, tmp_path, synced) -> None:
    path = tmp_path / "recording.mcap"
    recorder = McapRecorder(path)
    for event in events:
        recorder.record(event)
    recorder.flush()
    assert not synced.holds(path)  # a step waits for no disk
    recorder.close()
    assert synced.holds(path)


def test_a_recording_that_does_not_get_to_the_disk_is_an_error(
    events, tmp_path, monkeypatch
) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    recorder = McapRecorder(tmp_path / "recording.mcap")
    monkeypatch.setattr(os, "fsync", fail)
    recorder.record(events[0])
    with pytest.raises(RecordingError, match=r"mcap cannot be written.*Input/output error"):
        recorder.close()


def test_recovered_and_accepted_recordings_are_on_the_disk(tmp_path, synced, monkeypatch) -> None:
    out = tmp_path / "out.mcap"
    assert main(["recover", str(STORED), "-o", str(out)]) == 0
    assert synced.holds(out)
    assert main(["export", str(STORED), "--what", "points", "-o", str(tmp_path / "a.npz")]) == 0
    assert synced.holds(tmp_path / "a.npz")

    drawn = online.normals
    monkeypatch.setattr(online, "normals", lambda stream, shape: -drawn(stream, shape))
    accepted = Path(shutil.copy(STORED, tmp_path / "accepted.mcap"))
    before = accepted.stat().st_ino
    synced.names.clear()
    assert main(["accept", str(accepted), "--yes"]) == 0
    assert accepted.stat().st_ino != before
    assert synced.holds(accepted)


@pytest.mark.parametrize("make", [whole_file, new_file])
def test_new_files_are_on_the_disk_and_a_full_one_is_named(make, tmp_path, synced) -> None:
    path = tmp_path / "out.txt"
    with make(path) as beside:
        beside.write_text("text")
    assert synced.holds(path)
    full = tmp_path / "full.txt"
    with (
        pytest.raises((RecordingError, WritingError), match=r"full\.txt cannot be written.*space"),
        make(full),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert sorted(os.listdir(tmp_path)) == ["out.txt"]


def test_a_full_disk_under_a_recovery_names_the_file_that_was_asked_for(
    tmp_path, capsys, monkeypatch
) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    out = tmp_path / "out.mcap"
    assert main(["recover", str(STORED), "-o", str(out)]) == 2
    error = f"error: {out} cannot be written: No space left on device\n"
    assert capsys.readouterr().err == error
    assert os.listdir(tmp_path) == []


def test_an_error_about_another_file_stays_what_it_is(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match="other"), new_file(tmp_path / "out"):
        (tmp_path / "other").read_text()


@pytest.mark.parametrize("name", ["summary.json", "config.yaml"])
def test_a_full_disk_under_a_file_of_a_run_is_named(
    name: str, tmp_path, full_disk, make_events, write
) -> None:
    from runners.probe import main as probe

    source = write(make_events(steps=2, seed=1))
    full_disk(name)
    more = ("method=icp", "method.iterations=2", "recording=mcap", f"logs={tmp_path / 'logs'}")
    done = run(probe, "session=recorded", f"session.path={source}", *more)
    assert done.returncode == 2, done.stderr
    (folder,) = (tmp_path / "logs" / "probe").iterdir()
    assert done.stderr == (
        f"error: {folder / name} cannot be written (No space left on device); "
        "accepted: a logs=DIR that can be written\n"
    )
    whole = {"summary.json": ["config.yaml", "recording.mcap"], "config.yaml": []}
    assert sorted(os.listdir(folder)) == whole[name]
    if name == "summary.json":
        assert main(["info", str(folder / "recording.mcap")]) == 0


def test_a_run_folder_that_was_removed_is_not_made_again(tmp_path) -> None:
    with pytest.raises(WritingError, match=r"summary\.json cannot be written: its folder was"):
        write_in_run_folder(tmp_path / "gone" / "summary.json", "")
    assert not (tmp_path / "gone").exists()
