"""Stored replays as tests: `pytest --replays DIR` makes an item of every recorded registration.

Recordings are also collected where pytest walks by itself, if the folder is named by the setting
`replays` in pytest's configuration. What a failing item says is the report of `replay verify`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:  # a run of pytest without recordings loads nothing of this package
    from replay.comparing.verification import Verdict

_SUFFIX = ".mcap"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --replays DIR, and the setting `replays`."""
    group = parser.getgroup("replays", "stored registrations, run again")
    group.addoption(
        "--replays",
        action="append",
        default=[],
        metavar="DIR",
        help="verify every registration of the recordings in this folder (or of this file)",
    )
    parser.addini("replays", "folders whose recordings are tests", type="paths", default=[])


def pytest_configure(config: pytest.Config) -> None:
    """Collect what --replays names beside what the command line names."""
    for given in config.getoption("--replays"):
        path = config.invocation_params.dir / given
        if not path.exists():
            raise pytest.UsageError(f"--replays {given} does not exist; accepted: a folder or file")
        config.args.append(str(path))


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Return the items of a recording that lies where recordings are tests."""
    if file_path.suffix != _SUFFIX:
        return None
    config = parent.config
    named = [config.invocation_params.dir / given for given in config.getoption("--replays")]
    folders = [Path(path).resolve() for path in [*named, *config.getini("replays")]]
    if any(file_path.resolve().is_relative_to(folder) for folder in folders):
        return StoredReplay.from_parent(parent, path=file_path)
    return None


class StoredReplay(pytest.File):
    """One recording, read once to be collected and once to be run."""

    _verdicts: Mapping[str, Verdict] = {}

    def collect(self) -> Iterable[pytest.Item]:
        """Return an item for each registration that has a result, and for each decision.

        A file that cannot be used has one that fails.
        """
        from chsel.errors import ChselError
        from replay.comparing.choices import recorded_method, recorded_policy
        from replay.mcap.reader import read_recording

        try:
            recording = read_recording(self.path)
            recorded_method(recording)
            items = [
                (step, f"step {step}, {recording.start.method}")
                for step in recording.steps
                if recording.has_result(step)
            ]
            if recording.decision_steps:
                policy = recorded_policy(recording).name
                items += [
                    (step, f"decision after step {step}, {policy}")
                    for step in recording.decision_steps
                ]
            reason = "" if items else f"recording {self.path} has no registration with a result"
        except ChselError as error:
            reason = str(error)
        if reason:
            yield ReplayedItem.from_parent(self, name="recording", failure=reason)
            return
        for step, name in sorted(items, key=lambda item: item[0]):
            yield ReplayedItem.from_parent(self, name=name, step=step)

    def verdict(self, name: str) -> Verdict:
        """Return the verdict of an item; with the first come those of all selected steps."""
        from replay.comparing.verification import verify
        from replay.mcap.reader import read_recording

        if not self._verdicts:
            items = (item for item in self.session.items if item.parent is self)
            steps = [item.step for item in items if isinstance(item, ReplayedItem)]
            found = verify(read_recording(self.path), steps)
            self._verdicts = {verdict.label: verdict for verdict in found}
        return self._verdicts[name]


class ReplayedItem(pytest.Item):
    """One registration or decision, made again; or a file that cannot be, with the reason."""

    parent: StoredReplay

    def __init__(self, *, step: int = -1, failure: str = "", **more: Any) -> None:
        super().__init__(**more)
        self.step = step
        self._failure = failure

    def runtest(self) -> None:
        """Fail with the reason, or with the report unless every bit is equal."""
        from replay.comparing.verification import EQUAL
        from replay.console import printable

        if self._failure:
            pytest.fail(printable(self._failure), pytrace=False)
        verdict = self.parent.verdict(self.name)
        if verdict.outcome != EQUAL:
            pytest.fail(f"{printable(str(self.path))}: {verdict.report()}", pytrace=False)

    def reportinfo(self) -> tuple[Path, None, str]:
        """Return the file of the item."""
        return self.path, None, f"{self.path.name}: {self.name}"
