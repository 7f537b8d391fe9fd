"""Show what is in recordings: session, steps, points, results, sizes, versions, integrity.

Of MCAP files of other programs, such as robots' logs: topics, types, counts, rates.
Status 0 if all files are whole, 1 if one is unfinished or damaged, 2 if one cannot be used.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rich.filesize import decimal
from rich.table import Table

from chsel.errors import RecordingError, SessionError
from replay.console import Console, plain_table, print_error
from replay.content.log_info import LogInfo, is_other_programs, log_info
from replay.content.recording_info import RecordingInfo, recording_info

_IN_FULL = 3  # files; of more, each is a line
_EITHER_END = 5  # steps that are shown of many


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Files, how much, and as what."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="recordings, or any MCAP files")
    parser.add_argument("--steps", action="store_true", help="show all steps")
    parser.add_argument("--json", action="store_true", help="print all as one JSON document")


def run(given: argparse.Namespace) -> int:
    """Print what is in the files; a list in JSON if there are several."""
    infos: list[RecordingInfo | LogInfo] = []
    documents: list[dict[str, Any]] = []
    status = 0
    for file in given.files:
        try:
            info = log_info(file) if is_other_programs(file) else recording_info(file)
        except (RecordingError, SessionError) as error:
            print_error(str(error))
            documents.append({"path": file, "error": str(error)})
            status = 2
            continue
        infos.append(info)
        documents.append(info.plain())
        status = max(status, int(info.damage is not None))
    if given.json:
        document = documents if len(documents) > 1 else documents[0]
        sys.stdout.write(json.dumps(document, indent=2, allow_nan=False) + "\n")
    else:
        _show(Console(), infos, brief=len(given.files) > _IN_FULL, all_=given.steps)
    return status


def _show(
    console: Console, infos: Sequence[RecordingInfo | LogInfo], *, brief: bool, all_: bool
) -> None:
    for info in infos:
        if brief:
            console.print(_overview(info), soft_wrap=True)
            continue
        console.print(str(info.path), style="bold", soft_wrap=True)
        if isinstance(info, LogInfo):
            console.print(_fact_table(_log_facts(info)))
            console.print(_topic_table(info))
            continue
        console.print(_fact_table(_facts(info)))
        if info.steps:
            console.print(_step_table(info.steps, all_=all_))


def _overview(info: RecordingInfo | LogInfo) -> str:
    """One line about a file."""
    if isinstance(info, LogInfo):
        facts = [f"{len(info.topics)} topics, {info.count} messages", f"{info.seconds:.3f} s"]
        facts += [decimal(info.size), info.damage or "whole"]
        return f"{info.path}: log of another program, {', '.join(facts)}"
    session = info.session
    facts = [
        f"{session['object']}, {session['session']}, {session['method']}",
        f"{len(info.steps)} probes, {info.registrations} registrations",
        decimal(info.size),
        "whole" if info.damage is None else info.damage,
    ]
    return f"{info.path}: {', '.join(facts)}"


def _log_facts(info: LogInfo) -> dict[str, str]:
    return {
        "kind": "log of another program; not a recording of a session",
        "time": f"{info.span}, {info.seconds:.3f} s" if info.count else "",
        "messages": f"{info.count} on {len(info.topics)} topics",
        "size": decimal(info.size),
        "integrity": info.damage or "",
    }


def _topic_table(info: LogInfo) -> Table:
    table = plain_table("", texts=("topic", "type"), numbers=("messages", "Hz"))
    for channel, count in info.topics:
        rate = info.rate(count)
        usual = channel.encoding in ("cdr", "protobuf")
        kind = channel.schema if usual else f"{channel.schema} ({channel.encoding})".strip()
        table.add_row(channel.topic, kind, str(count), "" if rate is None else f"{rate:.4g}")
    return table


def _fact_table(facts: Mapping[str, str]) -> Table:
    """Names and what they are, without those of which nothing is known."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, fact in facts.items():
        if fact:
            table.add_row(f"  {name}", fact)
    return table


def _facts(info: RecordingInfo) -> dict[str, str]:
    """Names and what they are, but for the steps."""
    session = info.session
    preset = f", preset {session['preset']}" if session["preset"] else ""
    counts = f"probes {len(info.steps)}, registrations {info.registrations}"
    files = ", ".join(f"{name} {decimal(size)}" for name, size in info.attachments.items())
    return {
        "object": session["object"],
        "session": f"{session['session']}, runner {session['runner']}; {counts}",
        "method": f"{session['method']}{preset}, seed {session['seed']}",
        "policy": _policy(info),
        "source": f"recording {session['source']}" if session["source"] else "",
        "rig": "" if info.rig is None else f"{info.rig['name']}, raw log {info.rig['source']}",
        "true pose": "known" if session["true_pose"] else "unknown",
        "outcome": info.outcome or "unknown: the session did not end",
        "size": f"{decimal(info.size)}, of that, uncompressed: {files}",
        "messages": _messages(info),
        "environment": _environment(session["environment"]),
        "format": f"version {session['format_version']}",
        "digest": info.digest,
        "integrity": info.integrity,
    }


def _policy(info: RecordingInfo) -> str:
    """The policy of a steered session, and how it stopped; empty if there is none."""
    if info.policy is None:
        return ""
    stop, spread = info.policy["stop"], info.policy["spread"]
    text = f"{info.policy['name']}, decisions {info.messages.get('/decision', 0)}, "
    if spread is None:
        return f"{text}none after the last probe"
    ended = f"stopped by {stop}" if stop else "not stopped"
    return f"{text}{ended}, spread of the poses {1000.0 * spread:.1f} mm"


def _messages(info: RecordingInfo) -> str:
    """How many on each topic, with their bytes, the most first."""
    counts, sizes = _grouped(info.messages), _grouped(info.message_bytes)
    return ", ".join(
        f"{counts[topic]} {topic} ({decimal(size)})"
        for topic, size in sorted(sizes.items(), key=lambda item: -item[1])
    )


def _grouped(numbers: Mapping[str, int]) -> dict[str, int]:
    """Sums over the topics that are parts of one cloud."""
    sums: dict[str, int] = {}
    for topic, number in numbers.items():
        name = "/all_points" if topic.startswith("/all_points/") else topic
        sums[name] = sums.get(name, 0) + number
    return sums


def _environment(environment: Mapping[str, str]) -> str:
    return ", ".join(f"{k.removeprefix('package ')} {v}" for k, v in environment.items())


def _step_table(steps: Sequence[Mapping[str, Any]], *, all_: bool) -> Table:
    """A row for each probe, or for the first and last of many."""
    names = ("step", "free", "occupied", "known", "contacts", "hypotheses", "distinct", "best cost")
    title = "known points after each probe, and what registering gave"
    table = plain_table(title, numbers=names)
    many = not all_ and len(steps) > 2 * _EITHER_END + 2
    for index, step in enumerate(steps):
        if many and index == _EITHER_END:
            table.add_row("...", *[""] * (len(names) - 1))
        if not many or not _EITHER_END <= index < len(steps) - _EITHER_END:
            table.add_row(*_cells(step))
    if many:
        table.caption = f"{len(steps) - 2 * _EITHER_END} more steps (--steps shows all)"
    return table


def _cells(step: Mapping[str, Any]) -> list[str]:
    points = [str(step[name]) for name in ("step", "free", "occupied", "known", "contacts")]
    if step["hypotheses"] < 0:
        return [*points, "no result" if step["posed"] else "", "", ""]
    cost = "" if math.isnan(step["best_cost"]) else f"{step['best_cost']:.4g}"
    return [*points, str(step["hypotheses"]), str(step["distinct"]), cost]
