"""Show what is in recordings: session, steps, points, results, sizes, versions, integrity.

Of MCAP files of other programs, such as robots' logs: topics, types, counts, rates.
Status 0 if all files are whole, 1 if one is unfinished or damaged, 2 if one cannot be used.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mcap.records import Header
from mcap.stream_reader import StreamReader
from rich.filesize import decimal
from rich.table import Table

from chsel.errors import RecordingError, SessionError
from chsel.events import Decided, Probe
from chsel.problem.mesh import mesh_digest
from chsel.problem.points import POINT_CLASSES
from replay.console import Console, plain_table, print_error
from replay.logs.mcap_log import ZSTD, Channel
from replay.logs.rosbag import ROS1, SQLITE, open_log_file
from replay.mcap.file import MALFORMED, McapFile, recover_hint
from replay.mcap.foxglove_messages import TOPIC_SCHEMAS
from replay.mcap.reader import Recording, read_recording
from replay.mcap.schemas import FORMAT_VERSION, PROFILE

_POINTS = (*POINT_CLASSES, "contacts")
_SECOND = 10**9
_LONGEST_HEADER = 4096  # bytes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add files, and the form of the output."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="recordings, or any MCAP files")
    parser.add_argument("--json", action="store_true", help="print all as one JSON document")


def run(given: argparse.Namespace) -> int:
    """Print what is in the files; a list in JSON if there are several."""
    console = Console()
    documents = []
    status = 0
    for file in given.files:
        try:
            info = log_info(file) if is_other_programs(file) else recording_info(file)
        except (RecordingError, SessionError) as error:
            print_error(str(error))
            info = {"path": file, "error": str(error)}
            status = 2
        else:
            status = max(status, int(not info["integrity"]["whole"]))
            if not given.json:
                console.print(info["path"], style="bold", soft_wrap=True)
                for table in _log_tables(info) if "log" in info else _recording_tables(info):
                    console.print(table)
        documents.append(info)
    if given.json:
        document = documents if len(documents) > 1 else documents[0]
        sys.stdout.write(json.dumps(document, indent=2, allow_nan=False) + "\n")
    return status


def recording_info(path: str | Path) -> dict[str, Any]:
    """Return the contents of a recording as JSON has them, with every checksum and digest compared.

    Of a damaged one, all is read that is whole. Raise RecordingError if nothing can be read.
    """
    path = Path(path).expanduser()
    recording = read_recording(path, partial=True)
    start = recording.start
    damage = recording.damage
    decision = None
    try:
        for event in recording.events():  # which compares the digests of all problems
            if isinstance(event, Probe):
                decision = None
            elif isinstance(event, Decided):
                decision = event.decision
    except RecordingError as error:
        damage = damage or str(error).removeprefix(f"recording {path}: ")
    messages, sizes = Counter[str](), Counter[str]()
    for message in McapFile(path, TOPIC_SCHEMAS, partial=True).messages():
        messages[message.topic] += 1
        sizes[message.topic] += len(message.data)
    rows = step_rows(recording)
    policy = _name(start.config, "policy")
    stopped: dict[str, Any] = {"stop": None, "spread": None}
    if decision is not None:
        stopped = {"stop": decision.stop, "spread": decision.spread}
    rig = recording.rig
    return {
        "path": str(path),
        "bytes": path.stat().st_size,
        "runner": start.runner,
        "object": start.object,
        "session": start.session,
        "method": start.method,
        "seed": start.seed,
        "source": start.source,
        "free_resolution": start.free_resolution,
        "preset": _name(start.config, "preset"),
        "format_version": FORMAT_VERSION,
        "workspace": start.workspace.bounds.tolist(),
        "true_pose": start.world_from_object is not None,
        "sdf_digest": start.sdf.digest,
        "mesh_digest": mesh_digest(start.mesh),
        "environment": dict(start.environment),
        "config": start.config,
        "rig": None if rig is None else {"name": rig.name, "source": rig.source},
        "policy": None if policy is None else {"name": policy, **stopped},
        "outcome": None if recording.ended is None else recording.ended.outcome,
        "registrations": sum(row["hypotheses"] is not None for row in rows),
        "integrity": {"whole": damage is None, "damage": damage},
        "digest": recording.digest,
        "steps": rows,
        "attachments": dict(recording.attachments),
        "messages": messages,
        "message_bytes": sizes,
    }


def step_rows(recording: Recording) -> list[dict[str, Any]]:
    """Return a row for each probe: all points known with it, and the numbers of its result.

    hypotheses, distinct and best_cost are None without a result.
    """
    points, rows = recording.start.initial_points, []
    for probe in recording.probes:
        points = probe.added_to(points)
        row: dict[str, Any] = {
            "step": probe.step,
            **{name: len(getattr(points, name)) for name in _POINTS},
        }
        row |= {"posed": probe.step in recording.steps}
        row |= dict.fromkeys(("hypotheses", "distinct", "best_cost"))
        if recording.has_result(probe.step):
            found = recording.hypotheses(probe.step)
            row |= {"hypotheses": len(found.cost), "distinct": found.distinct}
            if len(found.cost) and math.isfinite(found.cost[0]):
                row["best_cost"] = float(found.cost[0])
        rows.append(row)
    return rows


def is_other_programs(path: str | Path) -> bool:
    """Return whether a file is a robot's log: MCAP whose header is not ours, or of ROS."""
    path = Path(path).expanduser()
    if not path.is_file():  # a FIFO would be waited for
        return False
    try:
        with path.open("rb") as file:
            if file.read(len(ROS1)).startswith((ROS1, SQLITE, ZSTD)):
                return True
            file.seek(0)
            header = next(StreamReader(file, record_size_limit=_LONGEST_HEADER).records, None)
    except (*MALFORMED, OSError):
        return False
    return isinstance(header, Header) and header.profile != PROFILE


def log_info(path: str | Path) -> dict[str, Any]:
    """Return the contents of any program's log file, by its summary or else by reading it all.

    begin and end: first and last log time, nanoseconds, 0 without messages; rate: messages a
    second over that span. Raise SessionError for a file that cannot be read, or is no log.
    """
    file = open_log_file(Path(path).expanduser())
    faults = list[str]()
    counts: Counter[Channel] = Counter()
    times = file.times
    if not file.is_indexed:
        for message in file.messages(None, faults.append):
            counts[message.channel] += 1
            first, last = times or (message.log_time, message.log_time)
            times = min(first, message.log_time), max(last, message.log_time)
    for number, channel in file.channels.items():
        counts[channel] += file.counts.get(number, 0)
    begin, end = times or (0, 0)
    damage = f"unfinished or damaged: {faults[0]}; what is whole was counted" if faults else None
    return {
        "path": str(file.path),
        "bytes": file.size,
        "log": True,
        "begin": begin,
        "end": end,
        "integrity": {"whole": damage is None, "damage": damage},
        "topics": [
            {
                "topic": channel.topic,
                "type": channel.schema,
                "encoding": channel.encoding,
                "count": count,
                "rate": _SECOND * count / (end - begin) if end > begin else None,
            }
            for channel, count in sorted(counts.items(), key=lambda c: (c[0].topic, c[0].schema))
        ],
    }


def _name(config: Mapping[str, Any], group: str) -> str | None:
    """Return the choice of a group in a configuration."""
    chosen = config.get(group)
    return str(chosen.get("name", "")) if isinstance(chosen, Mapping) else None


def _log_tables(info: Mapping[str, Any]) -> tuple[Table, Table]:
    begin, end = (datetime.fromtimestamp(info[t] / _SECOND, UTC) for t in ("begin", "end"))
    count = sum(topic["count"] for topic in info["topics"])
    span = f"{begin:%Y-%m-%d %H:%M:%S} to {end:%Y-%m-%d %H:%M:%S} UTC"
    facts = {
        "kind": "log of another program; not a recording of a session",
        "time": f"{span}, {(info['end'] - info['begin']) / _SECOND:.3f} s" if count else "",
        "messages": f"{count} on {len(info['topics'])} topics",
        "size": decimal(info["bytes"]),
        "integrity": info["integrity"]["damage"],
    }
    table = plain_table("", texts=("topic", "type", "encoding"), numbers=("messages", "Hz"))
    for topic in info["topics"]:
        rate = "" if topic["rate"] is None else f"{topic['rate']:.4g}"
        table.add_row(topic["topic"], topic["type"], topic["encoding"], str(topic["count"]), rate)
    return _fact_table(facts), table


def _recording_tables(info: Mapping[str, Any]) -> tuple[Table, Table]:
    title = "known points after each probe, and what registering gave"
    names = ("step", *_POINTS, "hypotheses", "distinct", "best cost")
    table = plain_table(title, numbers=names)
    for row in info["steps"]:
        points = [str(row[name]) for name in ("step", *_POINTS)]
        without = "no result" if row["posed"] else ""
        cost = "" if row["best_cost"] is None else f"{row['best_cost']:.4g}"
        counts = [row["hypotheses"], row["distinct"]]
        result = [without, "", ""] if counts[0] is None else [*map(str, counts), cost]
        table.add_row(*points, *result)
    return _fact_table(_facts(info)), table


def _fact_table(facts: Mapping[str, str | None]) -> Table:
    """Return a table of names and facts, without those of which nothing is known."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, fact in facts.items():
        if fact:
            table.add_row(f"  {name}", fact)
    return table


def _facts(info: Mapping[str, Any]) -> dict[str, str]:
    """Return facts by their names, but for the steps."""
    preset = f", preset {info['preset']}" if info["preset"] else ""
    steps = f"probes {len(info['steps'])}, registrations {info['registrations']}"
    files = ", ".join(f"{name} {decimal(size)}" for name, size in info["attachments"].items())
    counts, sizes = Counter[str](), Counter[str]()  # of topics such as /all_points/free/0 together
    for topic, size in info["message_bytes"].items():
        name = "/".join(topic.split("/")[:2])
        counts[name] += info["messages"][topic]
        sizes[name] += size
    messages = (f"{counts[name]} {name} ({decimal(size)})" for name, size in sizes.most_common())
    versions = (f"{k.removeprefix('package ')} {v}" for k, v in info["environment"].items())
    damage = info["integrity"]["damage"]
    path = Path(info["path"])
    integrity = "finished; all checksums and digests are right"
    if damage is not None:
        integrity = f"{damage}; what is whole was read, and {recover_hint(path)}"
    return {
        "object": info["object"],
        "session": f"{info['session']}, runner {info['runner']}; {steps}",
        "method": f"{info['method']}{preset}, seed {info['seed']}",
        "policy": _policy(info),
        "source": f"recording {info['source']}" if info["source"] else "",
        "rig": "{name}, raw log {source}".format(**info["rig"]) if info["rig"] else "",
        "true pose": "known" if info["true_pose"] else "unknown",
        "outcome": info["outcome"] or "unknown: the session did not end",
        "size": f"{decimal(info['bytes'])}, of that, uncompressed: {files}",
        "messages": ", ".join(messages),
        "environment": ", ".join(versions),
        "format": f"version {info['format_version']}",
        "digest": info["digest"],
        "integrity": integrity,
    }


def _policy(info: Mapping[str, Any]) -> str:
    """Return the policy of a steered session, and how it stopped; empty if there is none."""
    if info["policy"] is None:
        return ""
    stop, spread = info["policy"]["stop"], info["policy"]["spread"]
    text = f"{info['policy']['name']}, decisions {info['messages']['/decision']}, "
    if spread is None:
        return f"{text}none after the last probe"
    return text + (f"stopped by {stop}" if stop else "not stopped")
