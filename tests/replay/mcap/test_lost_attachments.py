"""A damaged mesh or SDF grid costs only what needs it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from chsel.errors import RecordingError
from replay.__main__ import main
from replay.comparing.verification import EQUAL, verify
from replay.events import Event, HypothesesFound, SessionStarted
from replay.lost_attachment import is_lost
from replay.mcap.reader import read_recording
from replay.mcap.recovery import Recovered, recover
from tests.replay.conftest import same_bits
from tests.tools.small_recordings import registered_session, write_recording

HOW_MADE = {"object_resolution": 0.02, "object_padding": 0.03}  # as `registered_session` does it
STORED = Path(__file__).parents[2] / "replays" / "points_exact_descent.mcap"


@pytest.fixture(scope="module")
def session() -> list[Event]:
    return registered_session("gradient_descent")


def configured(events: list[Event], **session: Any) -> list[Event]:
    """The same session with a configuration that tells how its grid was made."""
    start = events[0]
    assert isinstance(start, SessionStarted)
    config = {**start.config, "session": session}
    return [dataclasses.replace(start, config=config), *events[1:]]


def flipped(data: bytes, *names: str) -> bytes:
    """A bit flipped within attachments of a recording."""
    changed = bytearray(data)
    for name in names:
        changed[data.index(len(name).to_bytes(4, "little") + name.encode()) + 200] ^= 4
    return bytes(changed)


@pytest.fixture
def recovered(tmp_path: Path) -> Callable[..., tuple[Path, Recovered]]:
    """The recovered recording of events whose attachments are damaged, and the report."""

    def make(events: list[Event], *names: str) -> tuple[Path, Recovered]:
        data = write_recording(tmp_path / "whole.mcap", events)
        (tmp_path / "damaged.mcap").write_bytes(flipped(data, *names))
        with pytest.raises(RecordingError, match="is damaged before byte"):
            read_recording(tmp_path / "damaged.mcap")
        out = tmp_path / "recovered.mcap"
        return out, recover(tmp_path / "damaged.mcap", out)

    return make


def test_a_lost_grid_is_made_again_from_the_mesh(
    session: list[Event], recovered: Callable[..., tuple[Path, Recovered]]
) -> None:
    events = configured(session, **HOW_MADE)
    path, found = recovered(events, "sdf_grid")
    assert (found.remade, found.attachments, found.events) == (["sdf_grid"], [], [])
    assert found.nothing_lost
    read = list(read_recording(path).events())
    assert len(read) == len(events)
    assert all(map(same_bits, read, events))


@pytest.mark.parametrize(
    "how", [{}, {**HOW_MADE, "object_resolution": 0.021}, {**HOW_MADE, "object_padding": "x"}]
)
def test_a_grid_that_cannot_be_made_again_leaves_all_registrations(
    session: list[Event], recovered: Callable[..., tuple[Path, Recovered]], how: dict[str, Any]
) -> None:
    """The configuration does not say how, or what comes of it has another digest."""
    path, found = recovered(configured(session, **how), "sdf_grid")
    assert (found.remade, found.attachments, found.events) == ([], ["sdf_grid"], [])
    assert not found.nothing_lost
    assert (found.probes, found.problems, found.results) == ([0, 1], [0, 1], [0, 1])
    recording = read_recording(path)
    assert is_lost(recording.start.sdf)
    assert not is_lost(recording.start.mesh)
    read = list(recording.events())
    assert len(read) == len(session)
    written = [event for event in session if isinstance(event, HypothesesFound)]
    results = [event for event in read if isinstance(event, HypothesesFound)]
    assert all(map(same_bits, results, written))
    for step in recording.steps:  # the problems have the recorded digests
        with pytest.raises(RecordingError, match="needs the attachment sdf_grid of the recording"):
            recording.problem(step).sdf.values  # noqa: B018


def test_without_the_mesh_all_registrations_verify(
    session: list[Event], recovered: Callable[..., tuple[Path, Recovered]]
) -> None:
    path, found = recovered(configured(session, **HOW_MADE), "mesh.ply")
    assert (found.remade, found.attachments) == ([], ["mesh.ply"])
    recording = read_recording(path)
    assert is_lost(recording.start.mesh)
    assert [verdict.outcome for verdict in verify(recording)] == [EQUAL, EQUAL]


def test_without_both_all_else_is_there(
    session: list[Event], recovered: Callable[..., tuple[Path, Recovered]], tmp_path: Path
) -> None:
    path, found = recovered(configured(session, **HOW_MADE), "mesh.ply", "sdf_grid")
    assert found.attachments == ["mesh.ply", "sdf_grid"]
    assert found.results == [0, 1]
    again = recover(path, tmp_path / "again.mcap")
    assert again.damage is None
    assert (tmp_path / "again.mcap").read_bytes() == path.read_bytes()


VERBS: dict[str, tuple[str, ...]] = {
    "info": ("info", "FILE", "--check"),
    "verify": ("verify", "FILE"),
    "step": ("step", "FILE", "--step", "1", "--out", "OUT.mcap"),
    "compare": ("compare", "FILE", "--methods", "gradient_descent"),
    "diff": ("diff", "FILE", "WHOLE"),
    "view": ("view", "FILE", "--save", "OUT.rrd"),
    "accept": ("accept", "FILE", "--yes"),
    "hypotheses": ("export", "FILE", "--what", "hypotheses", "-o", "OUT.npz"),
    "points": ("export", "FILE", "--what", "points", "-o", "OUT.npz"),
    "metrics": ("export", "FILE", "--what", "metrics", "-o", "OUT.csv"),
}
NEEDS = {"mesh.ply": {"view"}, "sdf_grid": {"verify", "step", "compare", "accept"}}
STATUS = {"diff": 1}  # the session's start says what is lost


@pytest.mark.parametrize("lost", NEEDS)
def test_every_verb_works_or_says_in_one_line_what_is_lost(
    session: list[Event],
    recovered: Callable[..., tuple[Path, Recovered]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    lost: str,
) -> None:
    path, _ = recovered(session, lost)
    for number, (verb, words) in enumerate(VERBS.items()):
        names = {"FILE": str(path), "WHOLE": str(tmp_path / "whole.mcap")}
        arguments = [
            names.get(word, word).replace("OUT", str(tmp_path / str(number))) for word in words
        ]
        capsys.readouterr()
        status = main(arguments)
        shown = capsys.readouterr()
        if verb in NEEDS[lost]:
            assert status == 2, verb
            assert shown.err.count("\n") == 1, verb
            assert shown.err.startswith("error: ")
            assert f"needs the attachment {lost} of the recording" in shown.err
        else:
            assert (status, shown.err) == (STATUS.get(verb, 0), ""), verb
        if verb == "info":
            assert f"lost         {lost}" in shown.out
    assert read_recording(path).damage is None
    assert sorted(file.name for file in tmp_path.iterdir() if file.name.startswith(".")) == []


def test_recover_says_what_is_lost(
    session: list[Event], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    events = configured(session, **HOW_MADE)
    data = write_recording(tmp_path / "whole.mcap", events)
    for names, said in (
        (["sdf_grid"], ["sdf_grid was lost and is there again", "nothing of the session is lost"]),
        (["mesh.ply", "sdf_grid"], ["lost: mesh.ply; what needs it", "lost: sdf_grid; what needs"]),
    ):
        path, out = tmp_path / "damaged.mcap", tmp_path / f"{len(names)}.mcap"
        path.write_bytes(flipped(data, *names))
        assert main(["recover", str(path), "-o", str(out)]) == 0
        shown = capsys.readouterr()
        assert shown.err == ""
        assert shown.out.startswith("kept: 2 probes, 2 registration problems, 2 results\n")
        for text in said:
            assert text in shown.out
        assert ("nothing of the session is lost" in shown.out) is (len(names) == 1)


@pytest.mark.parametrize("name", ["mesh.ply", "sdf_grid"])
def test_older_recordings_lose_no_more(tmp_path: Path, name: str) -> None:
    """The checksum of the attachment alone tells there, as no seal does."""
    data = bytearray(STORED.read_bytes())
    data[data.index(name.encode()) + 400] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(data)
    found = recover(tmp_path / "damaged.mcap", tmp_path / "out.mcap")
    assert found.results == list(read_recording(STORED).steps)
    assert [*found.attachments, *found.remade] == [name]
    assert read_recording(tmp_path / "out.mcap").steps == read_recording(STORED).steps
