"""`python -m tests.tools.fuzz_logs --cases N --seed S`: changed logs, and reading them.

Every case must end in one clear SessionError or in messages that are well formed, all else counted
in faults; where checksums tell, no message may say what the original did not.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from chsel.errors import SessionError
from chsel.problem.poses import check_rigid
from runners.sensors.log.clocks import Clocks
from runners.sensors.log.messages import (
    CameraInfoMessage,
    CloudMessage,
    ImageMessage,
    JointsMessage,
    MarkerMessage,
    PoseMessage,
    Received,
    TransformMessage,
)
from runners.sensors.log.raw_log import RawLog
from runners.sensors.log.transforms import TransformError, TransformTree
from runners.sensors.rig import ClockRig
from tests.runners.sensors.small_logs import foxglove_sent, ros2_sent, write_foxglove, write_ros2
from tests.tools.fuzzing import Tally, WrongOutcome, run_cases
from tests.tools.mutations import Random, file_of, joined, packed, raw, records, split, unpacked

HANGS_AFTER = 60.0  # seconds of one case: the process ends with a traceback
LAYERS = ("raw", "cut", "records", "messages")
_MESSAGE_HEAD = 22  # bytes
_MOST_FAULTS = 401


@dataclass
class Original:
    """A log that is whole: its bytes, and what its messages say."""

    data: bytes
    said: frozenset[str]


def originals(folder: Path) -> list[Original]:
    """Small logs of both encodings."""
    made = []
    path = folder / "whole.mcap"
    for data in (
        write_ros2(path, ros2_sent(3), chunk_size=700),
        write_foxglove(path, foxglove_sent() * 2),
    ):
        path.write_bytes(data)
        log = RawLog(path)
        made.append(Original(data, frozenset(map(repr, log.messages(log.topics)))))
    return made


def run_case(index: int, seed: int, whole: Sequence[Original], folder: Path, tally: Tally) -> None:
    """Make one case and judge it; raises WrongOutcome, or what should not have been raised."""
    random = np.random.default_rng([seed, index])
    original = whole[int(random.integers(len(whole)))]
    layer = str(random.choice(LAYERS))
    path = folder / "case.mcap"
    path.write_bytes(changed(original.data, layer, random))
    begun = time.perf_counter()
    tally.outcomes[f"{layer}: {judge(path, original, layer)}"] += 1
    tally.timed(index, time.perf_counter() - begun)


def changed(data: bytes, layer: str, random: Random) -> bytes:
    """The bytes of a changed log."""
    if layer == "raw":
        return raw(data, random)
    if layer == "cut":  # with a change ahead of the cut, so that no index leads past it
        return raw(data[: int(random.integers(len(data)))], random)
    return records(data, random) if layer == "records" else _other_messages(data, random)


def judge(path: Path, original: Original, layer: str) -> str:
    """What reading a file comes to."""
    try:
        log = RawLog(path)
        if not log.topics:
            return "no topics"
        received = list(log.messages(log.topics))
    except SessionError as error:
        if "\n" in str(error) or str(path) not in str(error):
            raise WrongOutcome(f"an error is not one line that names the file: {error}") from None
        return "refused"
    for one in received:
        check(one)
    if len(log.faults) > _MOST_FAULTS or any("\n" in text for text in log.faults):
        raise WrongOutcome("faults are too many, or not one line each")
    said = set(map(repr, received))
    if layer in ("raw", "cut") and not said <= original.said:
        raise WrongOutcome(f"a message says {next(iter(said - original.said))[:300]}")
    use(received)
    if said == original.said:
        return "the same"
    return "some, with faults" if log.faults else "some"


def check(received: Received) -> None:
    """Raise WrongOutcome unless a message is as the types of messages promise."""
    content = received.content
    good = 0 <= received.log_time < 2**63
    good &= received.stamp is None or 0 < received.stamp < 2**63
    match content:
        case ImageMessage():
            good &= content.values.ndim == 2 and content.values.size > 0
            good &= content.values.dtype in (np.uint16, np.float32)
        case CameraInfoMessage():
            numbers = [content.fx, content.fy, content.cx, content.cy]
            good &= bool(np.isfinite(numbers).all()) and min(numbers[:2]) > 0
        case TransformMessage():
            check_rigid("transform", content.parent_from_child[None])
            good &= bool(np.isfinite(content.parent_from_child).all())
        case PoseMessage():
            check_rigid("pose", content.frame_from_body[None])
        case JointsMessage():
            good &= all(np.isfinite(value) for value in content.positions.values())
        case CloudMessage():
            good &= content.points.ndim == 2 and content.points.dtype == np.float64
        case MarkerMessage():
            good &= "\n" not in content.text
    if not good:
        raise WrongOutcome(f"a message is malformed: {received}")


def use(received: Sequence[Received]) -> None:
    """Put messages into the tree and the clocks; whatever they say, that ends well."""
    tree, clocks = TransformTree(), Clocks(ClockRig())
    for one in received:
        clocks.add(one)
    correction = clocks.correction()
    for one in received:
        if isinstance(one.content, TransformMessage):
            tree.add(correction.time(one), one.content)
    stamps = np.array([correction.time(one) for one in received], dtype=np.int64)
    for target, source in (
        ("world", "camera"),
        ("base", "world"),
        *zip(tree.frames, tree.frames, strict=True),
    ):
        try:
            poses, valid = tree.lookups(target, source, stamps, gap_s=0.5)
        except TransformError:
            continue
        check_rigid("pose", poses[valid])


def _other_messages(whole: bytes, random: Random) -> bytes:
    """One to three messages of other content, all checksums right."""
    everything = split(whole[len(MCAP0_MAGIC) : -len(MCAP0_MAGIC)])
    chunks = [i for i, (opcode, _) in enumerate(everything) if opcode == Opcode.CHUNK]
    for place in random.choice(chunks, int(random.integers(1, 4))).tolist():
        inside = split(unpacked(everything[place][1]))
        within = [i for i, (opcode, _) in enumerate(inside) if opcode == Opcode.MESSAGE]
        chosen = int(random.choice(within))
        head, content = inside[chosen][1][:_MESSAGE_HEAD], inside[chosen][1][_MESSAGE_HEAD:]
        if random.random() < 0.1:
            head = raw(head, random).ljust(_MESSAGE_HEAD, b"\0")[:_MESSAGE_HEAD]
        inside[chosen] = (Opcode.MESSAGE, head + _other_content(content, random))
        everything[place] = (Opcode.CHUNK, packed(joined(inside)))
    # Chunks may have moved, so that an index could not be right.
    end = next(i for i, (opcode, _) in enumerate(everything) if opcode == Opcode.DATA_END)
    return file_of(everything[: end + 1])


def _other_content(content: bytes, random: Random) -> bytes:
    """Bytes changed at random, or one number of four or eight bytes that is extreme."""
    if random.random() < 0.5 or len(content) < 16:
        return raw(content, random)
    data = bytearray(content)
    numbers = [
        np.array(kind(value)).tobytes()
        for kind, values in (
            (np.uint32, (0, 1, 2**16, 2**31, 2**32 - 1)),
            (np.float64, (0.0, np.nan, np.inf, -np.inf, 1e300, 5e-324)),
        )
        for value in values
    ]
    part = numbers[int(random.integers(len(numbers)))]
    start = int(random.integers(0, (len(data) - len(part)) // 4 + 1)) * 4
    data[start : start + len(part)] = part
    return bytes(data)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run cases, and print what they came to; 1 if any ended otherwise than it may."""

    def prepare(folder: Path, tally: Tally) -> Callable[[int, int], None]:
        whole = originals(folder)
        return lambda index, seed: run_case(index, seed, whole, folder, tally)

    return run_cases(__doc__, arguments, prepare, cases=5000, hangs_after=HANGS_AFTER)


if __name__ == "__main__":
    sys.exit(main())
