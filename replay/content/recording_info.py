"""What is in a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chsel.errors import RecordingError
from replay.content.standard_json import standard
from replay.content.step_rows import StepRows
from replay.events import Decided, Probe
from replay.mcap.encoding import decode
from replay.mcap.event_messages import config_from_json
from replay.mcap.file import StoredMessage, recover_hint
from replay.mcap.reader import Recording, read_recording
from replay.mcap.texts import check_name

_OF_THE_SESSION = ("runner", "object", "session", "method", "seed", "source", "free_resolution")


@dataclass(frozen=True)
class RecordingInfo:
    """What `info` shows of a recording."""

    path: Path
    size: int  # of the file, bytes
    session: Mapping[str, Any]  # names, seed, configuration and the like, plain values
    # A mapping for each probe, named as the fields of `StepRow`; points are all known with it.
    steps: tuple[Mapping[str, Any], ...]
    outcome: str | None  # how the session ended, None if that is unknown
    attachments: Mapping[str, int]  # bytes by name
    messages: Mapping[str, int]  # by topic
    message_bytes: Mapping[str, int]  # by topic
    damage: str | None = None  # what is wrong, None if nothing is
    rig: Mapping[str, str] | None = None  # name and source of a robot session's sensors
    digest: str = ""  # of the file
    # Of a steered session: `name`, and of the decision after the last probe `stop` and `spread`,
    # metres; None where that is unknown.
    policy: Mapping[str, Any] | None = None

    @property
    def registrations(self) -> int:
        """How many registration problems have a result."""
        return sum(step["hypotheses"] >= 0 for step in self.steps)

    @property
    def integrity(self) -> str:
        """A line about what holds of the file."""
        if self.damage is not None:
            return f"{self.damage}; what is whole was read, and {recover_hint(self.path)}"
        return "finished; all checksums and digests are right"

    def plain(self) -> dict[str, Any]:
        """All of it as JSON has it."""
        integrity = {"whole": self.damage is None, "damage": self.damage}
        return {
            "path": str(self.path),
            "bytes": self.size,
            **self.session,
            "rig": None if self.rig is None else dict(self.rig),
            "policy": None if self.policy is None else dict(self.policy),
            "outcome": self.outcome,
            "registrations": self.registrations,
            "integrity": integrity,
            "digest": self.digest,
            "steps": standard([*self.steps]),
            "attachments": dict(self.attachments),
            "messages": dict(self.messages),
            "message_bytes": dict(self.message_bytes),
        }


def recording_info(path: str | Path) -> RecordingInfo:
    """What is in a recording, every checksum and digest compared.

    Of a damaged one, all is read that is whole. Raises RecordingError if nothing can be read.
    """
    path = Path(path).expanduser()
    tally = _Tally()
    recording = read_recording(path, partial=True, watch=tally.take)
    steps, damage, last = _checked_steps(recording)
    session = _session(path, tally.session)
    return RecordingInfo(
        path,
        path.stat().st_size,
        session,
        steps,
        None if recording.ended is None else recording.ended.outcome,
        recording.attachments,
        tally.messages,
        tally.bytes,
        damage=recording.damage or damage,
        rig=None if recording.rig is None else _rig(path, vars(recording.rig)),
        digest=recording.digest,
        policy=_policy(path, session["config"], last),
    )


def _checked_steps(
    recording: Recording,
) -> tuple[tuple[Mapping[str, Any], ...], str | None, Mapping[str, Any] | None]:
    """A mapping for each probe, the digests of problems checked; and the first that is wrong.

    Then stop and spread of the decision after the last probe, None if there is none.
    """
    rows, damage, last = StepRows(), None, None
    try:
        for event in recording.events():
            rows.take(event)
            if isinstance(event, Probe):
                last = None
            elif isinstance(event, Decided):
                last = {"stop": event.decision.stop, "spread": event.decision.spread}
    except RecordingError as error:
        damage = str(error).removeprefix(f"recording {recording.path}: ")
    return tuple(vars(row) for row in rows.rows), damage, last


class _Tally:
    """Counts messages and bytes by topic, and keeps the session's."""

    def __init__(self) -> None:
        self.session = b""
        self.messages: dict[str, int] = {}
        self.bytes: dict[str, int] = {}

    def take(self, message: StoredMessage) -> None:
        if message.topic == "/session":
            self.session = message.data
        self.messages[message.topic] = self.messages.get(message.topic, 0) + 1
        self.bytes[message.topic] = self.bytes.get(message.topic, 0) + len(message.data)


def _session(path: Path, data: bytes) -> dict[str, Any]:
    """The plain values of a session's first message, its configuration taken apart."""
    values = decode("Session", data)
    for name in ("runner", "object", "session", "method", "source"):
        check_name(f"{name} of recording {path}", values[name])
    config = config_from_json(values["config"])
    preset = config.get("preset")
    return {
        **standard({name: values[name] for name in _OF_THE_SESSION}),
        "preset": preset.get("name") if isinstance(preset, Mapping) else None,
        "format_version": values["format_version"],
        "workspace": standard(values["workspace"].tolist()),
        "true_pose": values["world_from_object"] is not None,
        "sdf_digest": values["sdf_digest"],
        "mesh_digest": values["mesh_digest"],
        "environment": values["environment"],
        "config": config,
    }


def _policy(
    path: Path, config: Mapping[str, Any], last: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    """Of a steered session: name, and how its last decision stopped it; else None."""
    group = config.get("policy")
    if not isinstance(group, Mapping):
        return None
    name = str(group.get("name", ""))
    check_name(f"the policy of recording {path}", name)
    return {"name": name, **(last or {"stop": None, "spread": None})}


def _rig(path: Path, values: Mapping[str, Any]) -> dict[str, str]:
    """Name and source of a rig."""
    for name in ("name", "source"):
        check_name(f"{name} of the rig of recording {path}", values[name])
    return {name: values[name] for name in ("name", "source")}
