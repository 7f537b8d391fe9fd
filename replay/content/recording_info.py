"""What is in a recording, from a few of its bytes if it is finished."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chsel.errors import RecordingError, SessionError
from chsel.problem.file_checks import refuse_special_file
from replay.content.standard_json import standard
from replay.mcap.damaged import recover_hint
from replay.mcap.encoding import decode
from replay.mcap.file import LIMITS, StoredMessage
from replay.mcap.plain_config import config_from_json
from replay.mcap.schemas import FORMAT_VERSION, MESSAGES, STEP_TIME
from replay.mcap.texts import check_name
from replay.raw.log_info import is_other_programs
from replay.raw.raw_file import RawFile, unwatched
from replay.raw.raw_reading import Wanted

# What reads everything takes seconds to import, so that it is imported where everything is read.
if TYPE_CHECKING:
    from replay.mcap.reader import Recording

_OF_THE_SESSION = ("runner", "object", "session", "method", "seed", "source", "free_resolution")


@dataclass(frozen=True)
class RecordingInfo:
    """What `info` shows of a recording."""

    path: Path
    size: int  # of the file, bytes
    session: Mapping[str, Any]  # names, seed, configuration and the like, plain values
    # A mapping for each probe, named as the columns of the message `Contents`; points are all
    # known with the probe.
    steps: tuple[Mapping[str, Any], ...]
    outcome: str | None  # how the session ended, None if that is unknown
    attachments: Mapping[str, int]  # bytes by name
    messages: Mapping[str, int]  # by topic
    message_bytes: Mapping[str, int] | None = None  # by topic, where everything was read
    checked: bool = False  # whether everything was read
    damage: str | None = None  # what is wrong, None if nothing is
    rig: Mapping[str, str] | None = None  # name and source of a robot session's sensors
    digest: str = ""  # of the whole recording, "" before format 3 and without an end
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
        if self.checked:
            seals = "" if self.digest else "; a format before 3 has no seals"
            return f"finished; everything was read, all checksums and digests are right{seals}"
        return "finished; checksums of what was read are right (--check reads everything)"

    def plain(self) -> dict[str, Any]:
        """All of it as JSON has it."""
        integrity = {
            "whole": self.damage is None,
            "checked": self.checked,
            "damage": self.damage,
        }
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
            "message_bytes": None if self.message_bytes is None else dict(self.message_bytes),
        }


def recording_info(path: str | Path, *, check: bool = False) -> RecordingInfo:
    """What is in a recording.

    Of a finished one, the index, first and last messages are read. With `check`, and where a file
    has no index, all is read that is whole. Raises RecordingError if nothing can be read.
    """
    path = Path(path).expanduser()
    refuse_special_file(f"recording {path}", path, RecordingError)
    try:
        indexed = _from_index(path)
    except (RecordingError, SessionError):  # reading it all shows what is wrong
        return _from_everything(path)
    if not check:
        return indexed
    try:
        checked = _from_everything(path)
    except RecordingError as error:
        damage = str(error).removeprefix(f"recording {path}: ").partition("; `python -m")[0]
        return replace(indexed, checked=True, damage=damage)
    return replace(checked, damage=checked.damage or _contradiction(indexed, checked))


def recording_digest(path: Path) -> str | None:
    """The digest of a finished recording, from its end; None if there is none."""
    try:
        found = _by_index(RawFile(path, LIMITS), "/contents")
    except (RecordingError, SessionError):
        return None
    return decode("Contents", found["/contents"])["digest"] or None if found else None


def _from_index(path: Path) -> RecordingInfo:
    file = RawFile(path, LIMITS)
    found = _by_index(file, "/session", "/contents", "/session_ended", "/rig")
    if is_other_programs(path) or not found.keys() >= {"/session", "/contents"}:
        raise RecordingError(f"recording {path} has no session or no contents")
    contents, ended, rig = found["/contents"], found.get("/session_ended"), found.get("/rig")
    channels, rows = file.channels.by_id, decode("Contents", contents)
    session, steps = _session(path, found["/session"]), _rows(rows)
    return RecordingInfo(
        path,
        file.size,
        session,
        steps,
        None if ended is None else decode("SessionEnded", ended)["outcome"],
        file.attachments,
        {channels[number].topic: count for number, count in (file.counts or {}).items()},
        rig=None if rig is None else _rig(path, decode("Rig", rig)),
        digest=rows["digest"],
        policy=_policy(path, session["config"], lambda: _last_decision(file, steps)),
    )


def _last_decision(file: RawFile, steps: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """The values of the message on the decision after the last probe, None if there is none.

    Raises RecordingError if what is read is damaged.
    """
    faults: list[str] = []
    begin = ((steps[-1]["step"] if steps else -1) + 1) * STEP_TIME
    wanted = Wanted(frozenset({"/decision"}), begin, begin + STEP_TIME)
    messages = list(file.messages(wanted, faults.append, unwatched))
    if faults:
        raise RecordingError(f"recording {file.path}: {faults[0]}")
    return decode("Decision", messages[-1].data) if messages else None


def _by_index(file: RawFile, *topics: str) -> dict[str, bytes]:
    """The one message on each topic that has one; the middle of a large file is not read.

    Raises RecordingError if the file has no index, if what is read is damaged, and if a topic has
    more messages than one or others than the index says.
    """
    faults = [] if file.is_indexed else [f"its index cannot be used: {file.index_fault}"]
    messages = file.messages(Wanted(frozenset(topics)), faults.append, unwatched)
    found = {} if faults else {message.channel.topic: message.data for message in messages}
    for number, count in (file.counts or {}).items():
        topic = file.channels.by_id[number].topic
        if topic in topics and count != (topic in found):
            faults.append(f"it has not {count} messages on {topic}")
    if faults:
        raise RecordingError(f"recording {file.path}: {faults[0]}")
    return found


def _from_everything(path: Path) -> RecordingInfo:
    from replay.mcap.reader import read_recording

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
        checked=True,
        damage=recording.damage or damage,
        rig=None if recording.rig is None else _rig(path, vars(recording.rig)),
        digest=recording.digest if recording.damage is None else "",
        policy=_policy(path, session["config"], lambda: last),
    )


def _checked_steps(
    recording: Recording,
) -> tuple[tuple[Mapping[str, Any], ...], str | None, Mapping[str, Any] | None]:
    """A mapping for each probe, the digests of problems checked; and the first that is wrong.

    Then stop and spread of the decision after the last probe, None if there is none.
    """
    from replay.events import Decided, Probe
    from replay.mcap.contents import Contents

    contents, damage, last = Contents(), None, None
    try:
        for event in recording.events():
            contents.take(event)
            if isinstance(event, Probe):
                last = None
            elif isinstance(event, Decided):
                last = {"stop": event.decision.stop, "spread": event.decision.spread}
    except RecordingError as error:
        damage = str(error).removeprefix(f"recording {recording.path}: ")
    return _rows(contents.values()), damage, last


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
    if not 1 <= values["format_version"] <= FORMAT_VERSION:
        raise RecordingError(f"recording {path} has format version {values['format_version']}")
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
        "lost": list(values["lost"]),
        "sdf_digest": values["sdf_digest"],
        "mesh_digest": values["mesh_digest"],
        "environment": values["environment"],
        "config": config,
    }


def _policy(
    path: Path,
    config: Mapping[str, Any],
    last: Callable[[], Mapping[str, Any] | None],
) -> dict[str, Any] | None:
    """Of a steered session: name, and how its last decision stopped it; else None."""
    group = config.get("policy")
    if not isinstance(group, Mapping):
        return None
    name, decision = str(group.get("name", "")), last()
    check_name(f"the policy of recording {path}", name)
    return {"name": name} | {
        part: None if decision is None else decision[part] for part in ("stop", "spread")
    }


def _rig(path: Path, values: Mapping[str, Any]) -> dict[str, str]:
    """Name and source of a rig."""
    for name in ("name", "source"):
        check_name(f"{name} of the rig of recording {path}", values[name])
    return {name: values[name] for name in ("name", "source")}


def _rows(columns: Mapping[str, Any]) -> tuple[Mapping[str, Any], ...]:
    """A mapping for each row of the columns of `Contents`."""
    names = tuple(name for name in MESSAGES["Contents"] if name not in ("session", "digest"))
    rows = zip(*(columns[name].tolist() for name in names), strict=True)
    return tuple(dict(zip(names, row, strict=True)) for row in rows)


def _contradiction(indexed: RecordingInfo, checked: RecordingInfo) -> str | None:
    """What the index says that is not so; None if all is so."""
    for topic, count in indexed.messages.items():
        found = checked.messages.get(topic, 0)
        if count != found:
            return f"damaged: its index has {count} messages on {topic}, there are {found}"
    if indexed.attachments != checked.attachments:
        return "damaged: its index has other attachments than there are"
    return None
