"""What `info` prints of an MCAP file of another program."""

from __future__ import annotations

from collections.abc import Mapping

from rich.box import SIMPLE_HEAD
from rich.filesize import decimal
from rich.table import Table

from replay.console import Console
from replay.raw.log_info import LogInfo, TopicInfo, moment

_MOST_TOPICS = 100  # that are shown without being asked for all
_SECOND = 10**9


def show_log(console: Console, info: LogInfo, *, all_: bool) -> None:
    """Print facts and a row for each topic. all_: also of those beyond the first hundred."""
    console.print(_facts(info))
    if info.topics:
        console.print(_topic_table(info, all_=all_))


def log_overview(info: LogInfo) -> str:
    """One line about a file."""
    facts = [
        f"{len(info.topics)} topics, {info.count} messages",
        f"{_seconds(info)}",
        decimal(info.size),
        info.damage or "whole",
    ]
    return f"{info.path}: log of another program, {', '.join(facts)}"


def fact_table(facts: Mapping[str, str]) -> Table:
    """Names and what they are, without those of which nothing is known."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, fact in facts.items():
        if fact:
            table.add_row(f"  {name}", fact)
    return table


def _facts(info: LogInfo) -> Table:
    times = f"{moment(info.begin)} to {moment(info.end)}, {_seconds(info)}"
    return fact_table(
        {
            "kind": "log of another program; not a recording of a session",
            "time": times if info.count else "",
            "messages": f"{info.count} on {len(info.topics)} topics",
            "size": decimal(info.size),
            "reading": "; ".join(info.remarks),
            "integrity": info.integrity,
        }
    )


def _topic_table(info: LogInfo, *, all_: bool) -> Table:
    table = Table(box=SIMPLE_HEAD, collapse_padding=True)
    table.add_column("topic\n  type, frames", overflow="fold")  # names are long: below each other
    for name in ("messages", "Hz"):
        table.add_column(name, justify="right", no_wrap=True)
    shown = info.topics if all_ else info.topics[:_MOST_TOPICS]
    for topic in shown:
        rate = "" if topic.rate is None else f"{topic.rate:.4g}"
        table.add_row(f"{topic.topic}\n  {_contents(topic)}", str(topic.count), rate)
    if len(shown) < len(info.topics):
        table.caption = f"{len(info.topics) - len(shown)} more topics (--steps shows all)"
        table.caption_justify = "left"
    return table


def _contents(topic: TopicInfo) -> str:
    """The schema's name, with an encoding that names do not imply, and the frames."""
    usual = topic.encoding in ("cdr", "protobuf")
    name = topic.type.replace("/msg/", "/")
    shown = name if usual and name else f"{name} ({topic.encoding})".strip()
    return ", ".join([shown, *topic.frames, *["..."] * topic.more_frames])


def _seconds(info: LogInfo) -> str:
    return f"{(info.end - info.begin) / _SECOND:.3f} s"
