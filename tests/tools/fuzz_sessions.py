"""`python -m tests.tools.fuzz_sessions --cases N --seed S`: sessions of changed logs.

Messages, bytes and rigs are changed. Every case must end in events whose values are finite and
inside the workspace, or in one line of a ChselError, within seconds and bounded memory.
"""

from __future__ import annotations

import copy
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError
from chsel.problem.poses import check_rigid
from replay.events import Logged, Probe, RigDescribed, SensorImage
from runners.sensors.rig import (
    Annotations,
    BoxRig,
    CloudRig,
    ExtraContacts,
    ForceRig,
    ProbeTimes,
    Rig,
)
from runners.sessions.sensors import SensorsSession, SensorsSettings
from runners.simulated_robot.log_writer import LogWriter
from tests.runners.sensors.sphere_log import BEGIN, RIG, SECOND, SphereLog
from tests.tools.fuzzing import Tally, WrongOutcome, peak_memory, run_cases
from tests.tools.mutations import Random, raw

HANGS_AFTER = 10.0  # seconds of one case: the process ends with a traceback
SLOWEST = 8.0  # seconds
MOST_MEMORY = 1024  # MB above that of the first case
_TIMES = (1, 10**6, 10**8, SECOND, 20 * SECOND, 10**14, 2**62)  # ns
_TEXTS = ("hand", "camera_frame", "nowhere", "/tf", "/camera/depth", "/probe", "none", "log")
_TEXTS += ("scaled_images", "deformation", "camera", "backwards")
_NUMBERS = (0.0, -1.0, 1e-300, 1e-3, 0.5, 1.0, 3.0, 1e6, 1e300, np.nan, np.inf, -np.inf)


@dataclass
class Message:
    """What a log is made of; times in nanoseconds."""

    topic: str
    kind: str
    content: dict[str, Any]
    stamp: int
    log_time: int


@dataclass
class Collected:
    """Takes the place of a writer."""

    messages: list[Message] = field(default_factory=list)

    def add(
        self, topic: str, kind: str, message: dict[str, Any], stamp: int, log_time: int
    ) -> None:
        """One message."""
        self.messages.append(Message(topic, kind, message, stamp, log_time))


def whole_log() -> list[Message]:
    """The messages of the sphere's log, with every second image of its pad."""
    collected = Collected()
    SphereLog(finger=0.02).send(collected)
    count: Counter[str] = Counter()
    kept = []
    for message in collected.messages:
        count[message.topic] += 1
        if not message.topic.startswith("/pad/") or count[message.topic] % 2:
            kept.append(message)
    return kept


def run_case(index: int, seed: int, whole: Sequence[Message], folder: Path, tally: Tally) -> None:
    """Make one case and judge it; raises WrongOutcome, or what should not have been raised."""
    random = np.random.default_rng([seed, index])
    messages, rig, changes = copy.deepcopy(list(whole)), RIG, []
    for _ in range(int(random.integers(1, 4))):
        if random.random() < 0.3:
            change = RIG_CHANGES[int(random.integers(len(RIG_CHANGES)))]
            try:
                rig = change(rig, random)
            except ChselError as error:
                check_error(error)
        else:
            change = LOG_CHANGES[int(random.integers(len(LOG_CHANGES)))]
            messages = change(messages, random)
        changes.append(change.__name__)
    path = folder / "case.mcap"
    write(messages, path)
    if random.random() < 0.2:
        path.write_bytes(raw(path.read_bytes(), random))
        changes.append("raw")
    begun = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            outcome = judge(path, rig, tally)
    except WrongOutcome as error:
        raise WrongOutcome(f"{', '.join(changes)}: {error}") from error
    tally.outcomes[outcome] += 1
    seconds = time.perf_counter() - begun
    tally.timed(index, seconds)
    if seconds > SLOWEST:
        raise WrongOutcome(f"{', '.join(changes)}: it took {seconds:.1f} s")
    tally.memory = tally.memory or peak_memory()
    if peak_memory() > tally.memory + MOST_MEMORY:
        tally.memory = peak_memory()
        raise WrongOutcome(f"{', '.join(changes)}: memory grew to {peak_memory():.0f} MB")


def judge(path: Path, rig: Rig, tally: Tally) -> str:
    """What a session comes to."""
    try:
        session = SensorsSession(SensorsSettings(rig, str(path)), 0)
        events = list(session.probes())
    except ChselError as error:
        check_error(error)
        tally.errors[f"{type(error).__name__}: {str(error).replace(str(path), 'LOG')[:60]}"] += 1
        return "refused"
    check_events(events, session)
    if sum(isinstance(event, Probe) for event in events) != session.count:
        raise WrongOutcome("there are other probes than were promised")
    probes = [event for event in events if isinstance(event, Probe)]
    return "contacts" if any(len(probe.contacts) for probe in probes) else "no contacts"


def check_error(error: ChselError) -> None:
    """Raise WrongOutcome unless it is a line that a person can read."""
    text = str(error)
    if "\n" in text or not 10 < len(text) < 10_000:
        raise WrongOutcome(f"an error is not one line: {text[:500]!r}")


def check_events(events: Sequence[Any], session: SensorsSession) -> None:
    """Raise WrongOutcome unless all values are finite, and all points in the workspace."""
    assert isinstance(events[0], RigDescribed)
    lower, upper = session.workspace.bounds
    margin = session.free_resolution * (1.0 + 1e-9)
    steps = [event.step for event in events[1:]]
    if steps != sorted(steps):
        raise WrongOutcome(f"steps are {steps[:20]}")
    for event in events[1:]:
        match event:
            case Logged():
                if "\n" in event.text or len(event.text) > 1000:
                    raise WrongOutcome(f"a remark is not one line: {event.text[:500]!r}")
            case SensorImage():
                good = event.values.dtype == np.uint16 and event.unit > 0.0
                good &= event.mask.shape == event.values.shape
                good &= bool(np.isfinite(event.intrinsics).all())
                if not good:
                    raise WrongOutcome(f"an image of {event.sensor} is malformed")
                check_rigid("pose of an image", event.world_from_camera[None])
            case Probe():
                for points in (event.new_points.free, event.new_points.known, event.contacts):
                    inside = (points >= lower - margin) & (points <= upper + margin)
                    if not inside.all():
                        raise WrongOutcome(f"a point is at {points[~inside.all(axis=1)][0]}")
                if not np.isfinite(event.contact_normals).all():
                    raise WrongOutcome("a normal is not finite")
                check_rigid("path", event.gripper_path)


def write(messages: Sequence[Message], path: Path) -> None:
    """The messages as a log, by their log times; what cannot be said in ROS 2 is cut to size."""
    with LogWriter(path) as writer:
        for one in messages:
            for head in _heads(one.content):
                head["stamp"]["sec"] = int(np.clip(head["stamp"]["sec"], -(2**31), 2**31 - 1))
            log_time = int(np.clip(one.log_time, 0, 2**63 - 1))
            writer.add(one.topic, one.kind, one.content, log_time, log_time)


def _heads(content: dict[str, Any]) -> list[dict[str, Any]]:
    """The headers of a message, of all transforms in it."""
    parts = [content, *content.get("transforms", [])]
    return [part["header"] for part in parts if "header" in part]


def _some(messages: list[Message], random: Random) -> list[int]:
    """Places of messages: of all, or of one topic; a few, a share, a stretch, or each."""
    topics = sorted({one.topic for one in messages})
    chosen = str(random.choice(topics)) if topics and random.random() < 0.7 else None
    places = [n for n, one in enumerate(messages) if chosen in (None, one.topic)]
    if not places:
        return []
    match int(random.integers(4)):
        case 0:
            return sorted(random.choice(places, min(3, len(places)), replace=False).tolist())
        case 1:
            return [n for n in places if random.random() < 0.3]
        case 2:
            first, last = np.sort(random.integers(0, len(places) + 1, 2)).tolist()
            return places[first:last]
    return places


def _of_kind(messages: list[Message], random: Random, kind: str) -> list[Message]:
    return [messages[n] for n in _some(messages, random) if messages[n].kind.endswith(kind)]


def drop(messages: list[Message], random: Random) -> list[Message]:
    """Some are missing."""
    gone = set(_some(messages, random))
    return [one for n, one in enumerate(messages) if n not in gone]


def duplicate(messages: list[Message], random: Random) -> list[Message]:
    """Some come twice, the second time at once or later."""
    delay = int(random.choice(_TIMES[:5]))
    again = [copy.deepcopy(messages[n]) for n in _some(messages, random)]
    for one in again:
        one.log_time += delay
    return messages + again


def reorder(messages: list[Message], random: Random) -> list[Message]:
    """Some come at one another's times."""
    places = _some(messages, random)
    times = [messages[n].log_time for n in places]
    for n, other in zip(places, random.permutation(len(places)), strict=True):
        messages[n].log_time = times[other]
    return messages


def shift_stamps(messages: list[Message], random: Random) -> list[Message]:
    """Stamps are off, alike or each otherwise, or there are none."""
    shift, alike = int(random.choice(_TIMES)), random.random() < 0.5
    none = random.random() < 0.2
    for n in _some(messages, random):
        by = shift if alike else int(shift * random.normal())
        for head in _heads(messages[n].content):
            seconds, nanoseconds = divmod(by, SECOND)
            head["stamp"] = {
                "sec": 0 if none else head["stamp"]["sec"] + seconds,
                "nanosec": 0 if none else nanoseconds,
            }
    return messages


def shift_log_times(messages: list[Message], random: Random) -> list[Message]:
    """The log's clock jumps."""
    shift = int(random.choice(_TIMES)) * int(random.choice([-1, 1]))
    for n in _some(messages, random):
        messages[n].log_time += shift
    return messages


def other_frames(messages: list[Message], random: Random) -> list[Message]:
    """Frames are those of other messages, or unheard of."""
    frames = ["world", "hand", "pad_frame", "camera_frame", "", "nowhere", "a" * 300, "/world"]
    for n in _some(messages, random):
        for head in _heads(messages[n].content):
            head["frame_id"] = str(random.choice(frames))
    return messages


def other_transforms(messages: list[Message], random: Random) -> list[Message]:
    """Transforms hold extreme numbers, or between other frames, also round in circles."""
    frames, value = ["world", "hand", "pad_frame", "camera_frame"], float(random.choice(_NUMBERS))
    way = int(random.integers(4))
    for one in _of_kind(messages, random, "TFMessage"):
        for part in one.content["transforms"]:
            moved = part["transform"]
            if way == 0:
                moved["translation"][str(random.choice(list("xyz")))] = value
            elif way == 1:
                moved["rotation"] = dict.fromkeys("xyzw", value)
            elif way == 2:
                part["child_frame_id"] = str(random.choice(frames))
            else:
                head = part["header"]
                head["frame_id"], part["child_frame_id"] = part["child_frame_id"], head["frame_id"]
    return messages


def other_depths(messages: list[Message], random: Random) -> list[Message]:
    """Depths are nothing, too large, too small, or noise."""
    way = int(random.integers(6))
    for one in _of_kind(messages, random, "/Image"):
        kind = "<u2" if one.content["encoding"] == "16UC1" else "<f4"
        values = np.frombuffer(one.content["data"], kind).astype(np.float64)
        with np.errstate(all="ignore"):
            values = (
                values * 0.0,
                values * 1000.0,
                values * 0.001,
                np.full_like(values, random.choice(_NUMBERS)),
                values * random.uniform(0.5, 1.5, values.shape),
                np.where(random.random(values.shape) < 0.5, np.nan, values),
            )[way]
            if kind == "<u2":
                values = np.clip(np.nan_to_num(values), 0.0, 65535.0)
            one.content["data"] = values.astype(kind).tobytes()
    return messages


def other_sizes(messages: list[Message], random: Random) -> list[Message]:
    """Images have other sizes, whole or not."""
    for one in _of_kind(messages, random, "/Image"):
        rows, whole = int(random.integers(0, 100)), random.random() < 0.7
        step = one.content["step"]
        if whole:
            one.content["data"] = (one.content["data"] * 100)[: rows * step]
        one.content["height"] = rows
    return messages


def other_cameras(messages: list[Message], random: Random) -> list[Message]:
    """Camera infos change."""
    for one in _of_kind(messages, random, "CameraInfo"):
        place = int(random.integers(12))
        if place < 9:
            one.content["k"] = list(one.content["k"])
            one.content["k"][place] = float(random.choice(_NUMBERS))
        else:
            name = ("width", "height", "binning_x")[place - 9]
            one.content[name] = int(random.choice([0, 1, 2, 36, 48, 72, 96, 65_536, 2**31]))
    return messages


def other_marks(messages: list[Message], random: Random) -> list[Message]:
    """Markers say something else, and there are more of them."""
    texts = ["begin 0", "begin 1", "end 1", "end", "begin", "true", "-1", "7", "", "begin 999999"]
    texts += ["hello\nworld", "é" * 500, "begin -1", "begin 99999999999"]
    for one in _of_kind(messages, random, "String"):
        one.content["data"] = str(random.choice(texts))
    for _ in range(int(random.integers(0, 30))):
        moment = BEGIN + int(random.uniform(-1.0, 6.0) * SECOND)
        text = {"data": str(random.choice(texts))}
        messages.append(Message("/probe", "std_msgs/String", text, moment, moment))
    return messages


def other_topics(messages: list[Message], random: Random) -> list[Message]:
    """Messages come on a topic that is of another kind."""
    topics = sorted({one.topic for one in messages}) or ["/nothing"]
    for n in _some(messages, random):
        messages[n].topic = str(random.choice(topics))
    return messages


def other_setting(rig: Rig, random: Random) -> Rig:
    """A number, a range, a text or a choice of the rig or of a part of it is another."""
    part = str(random.choice(["", "cameras", "bubbles", "contact", "hand", "clock", "gate"]))
    group = getattr(rig, part) if part else rig
    several = isinstance(group, tuple)
    settings = group[0] if several else group
    if settings is None:  # as another change took the hand away
        return rig
    name = str(random.choice([one.name for one in fields(settings)]))
    before, number = getattr(settings, name), float(random.choice(_NUMBERS))
    whole = int(number) if 0.0 <= number < 1e7 else -1
    after: Any
    match before:
        case bool() | int():
            after = whole
        case float():
            after = number
        case str():
            after = str(random.choice(_TEXTS))
        case None:
            after = number if name in ("unit", "edge", "rate") else str(random.choice(_TEXTS))
        case (float(), float()):
            after = (0.1, number)
        case tuple() if name != "workspace":
            after = ()
        case _:
            return rig
    changed = replace(settings, **{name: after})
    if not part:
        return changed
    return replace(rig, **{part: (changed,) if several else changed})


def other_workspace(rig: Rig, random: Random) -> Rig:
    """The workspace is tiny, far away, large, or none."""
    workspaces: list[Any] = [
        ((0.9, 0.9001), (0.0, 0.0001), (0.45, 0.4501)),
        ((1e3, 1e3 + 1), (0.0, 1.0), (0.0, 1.0)),
        ((1e12, 1e12 + 1), (0.0, 1.0), (0.0, 1.0)),
        ((-1.0, 2.0), (-1.0, 1.0), (-1.0, 1.0)),
        ((-100.0, 100.0), (-100.0, 100.0), (-100.0, 100.0)),
        ((0.0, np.nan), (0.0, 1.0), (0.0, 1.0)),
        ((1.0, 0.0), (0.0, 1.0), (0.0, 1.0)),
        ((-1e300, 1e300), (0.0, 1.0), (0.0, 1.0)),
        None,
    ]
    return replace(rig, workspace=workspaces[int(random.integers(len(workspaces)))])


def other_parts(rig: Rig, random: Random) -> Rig:
    """Sensors, probes and annotations that there are not, or not otherwise."""
    pad, hand = rig.bubbles[0] if rig.bubbles else RIG.bubbles[0], rig.hand or RIG.hand
    assert hand is not None
    value = float(random.choice(_NUMBERS))
    box = replace(RIG.hand.boxes[0], position=(value, 0.0, 0.0)) if RIG.hand else None
    nearby = Annotations((0,), (ExtraContacts(1, ((0.9, 0.0, 0.4),), foremost=5),))
    changes: list[Callable[[], dict[str, Any]]] = [
        lambda: {"bubbles": (replace(pad, depth="/camera/depth", info="/camera/info"),)},
        lambda: {"hand": None},
        lambda: {"hand": replace(hand, boxes=(box,))},
        lambda: {"hand": replace(hand, boxes=(BoxRig((value, 1.0, 1.0)),))},
        lambda: {"forces": (ForceRig("/pad/depth", threshold=value),)},
        lambda: {"probes": (ProbeTimes(1.0, 2.0), ProbeTimes(2.0, value))},
        lambda: {"probes": ()},
        lambda: {"annotations": nearby},
        lambda: {"annotations": Annotations((), (ExtraContacts(0, ((value, 0.0, 0.4),)),))},
        lambda: {"annotations": Annotations((), (ExtraContacts(0, foremost=int(1e7)),))},
        lambda: {"clouds": (CloudRig("/camera/depth", "rays"),)},
    ]
    return replace(rig, **changes[int(random.integers(len(changes)))]())


LOG_CHANGES: tuple[Callable[[list[Message], Random], list[Message]], ...] = (
    drop,
    duplicate,
    reorder,
    shift_stamps,
    shift_log_times,
    other_frames,
    other_transforms,
    other_depths,
    other_sizes,
    other_cameras,
    other_marks,
    other_topics,
)
RIG_CHANGES: tuple[Callable[[Rig, Random], Rig], ...] = (
    other_setting,
    other_workspace,
    other_parts,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run cases, and print what they came to; 1 if any ended otherwise than it may."""

    def prepare(folder: Path, tally: Tally) -> Callable[[int, int], None]:
        whole = whole_log()
        return lambda index, seed: run_case(index, seed, whole, folder, tally)

    return run_cases(__doc__, arguments, prepare, cases=1000, hangs_after=HANGS_AFTER)


if __name__ == "__main__":
    sys.exit(main())
