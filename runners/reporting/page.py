"""A report as Markdown with its pictures beside it, and as one HTML page with them in it."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markdown_it import MarkdownIt

from runners.evaluation.experiment import flat
from runners.reporting.evaluation_folder import Evaluation, trials_of
from runners.reporting.figures import Picture
from runners.reporting.tables import Table, table_of

_NOT_SHOWN = ("environments", "commands", "methods", "policies")
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 0 auto; padding: 1rem; }
p { max-width: 48rem; }
img { max-width: 100%; }
table { border-collapse: collapse; font-size: 0.85rem; display: block; overflow-x: auto; }
th, td { padding: 0.25rem 0.6rem; border-bottom: 1px solid #d5d5d5; vertical-align: top; }
"""


@dataclass(frozen=True)
class Section:
    """A section of the page."""

    title: str
    text: str  # what is shown and how it comes about
    tables: Sequence[Table] = ()
    picture: Picture | None = None


def as_markdown(
    evaluation: Evaluation, sections: Sequence[Section], *, command: str, kind: str
) -> str:
    """Return the report. command: repeats it. kind: of its pictures' files, one of FORMATS."""
    name = _escaped(evaluation.experiment["name"])
    parts = [f"# Evaluation {name}", _escaped(_lead(evaluation))]
    for section in sections:
        parts += [f"## {section.title}", _escaped(section.text)]
        if (picture := section.picture) is not None:
            link = f"[{_escaped(picture.alt)}]({picture.name}.{kind})"
            parts.append(link if kind == "pdf" else f"!{link}")
            parts.append(f"[The numbers drawn]({picture.name}.csv)")
        parts += [part for table in section.tables if table.rows for part in _table(table)]
    commands = [*evaluation.experiment["commands"], command]
    parts += ["## How it was made", "```\n" + "\n".join(commands) + "\n```"]
    parts += [part for table in _made(evaluation.experiment) for part in _table(table)]
    return "\n\n".join(parts) + "\n"


def as_html(markdown: str, pictures: Mapping[str, bytes]) -> str:
    """Return the report as one HTML page. pictures: contents of files by their names."""
    body = MarkdownIt("commonmark", {"html": False}).enable("table").render(markdown)
    for name, content in pictures.items():
        kind = "image/svg+xml" if name.endswith("svg") else "image/png"
        data = f"data:{kind};base64,{base64.b64encode(content).decode()}"
        body = body.replace(f'<img src="{name}"', f'<img src="{data}"')
    title = html.escape(markdown.partition("\n")[0].lstrip("# "))
    head = f'<meta charset="utf-8">\n<title>{title}</title>\n<style>{_STYLE}</style>'
    return f'<!DOCTYPE html>\n<html lang="en">\n<head>\n{head}\n</head>\n{body}</html>\n'


def _lead(evaluation: Evaluation) -> str:
    """Return the first paragraph of the report."""
    done = evaluation.probes if evaluation.experiment["policies"] else evaluation.rows
    if done.empty:
        return "Nothing is finished yet: there is no registration to report on."
    return (
        f"{len(done)} rows of {len(trials_of(done))} trials with {done['object'].nunique()} "
        "objects. PD is plausible diversity in mm², lower is better, by plausible sets of the "
        f"definition {evaluation.definition_text}. The best median of a row is bold, in brackets "
        "are its quartiles, and n is how many numbers are behind it."
    )


def _table(table: Table) -> list[str]:
    ends = [" :-- " if n < table.labels else " --: " for n in range(len(table.header))]
    lines = ["|" + "|".join(ends) + "|"]
    lines += ["| " + " | ".join(map(_cell, row)) + " |" for row in table.rows]
    lines.insert(0, "| " + " | ".join(map(_cell, table.header)) + " |")
    note = [_escaped(table.note)] if table.note else []
    return [f"**{_escaped(table.title)}**", "\n".join(lines), *note]


def _cell(text: str) -> str:
    bold = re.fullmatch(r"\*\*(.*)\*\*", text)
    return f"**{_escaped(bold[1])}**" if bold else _escaped(text)


def _escaped(text: str) -> str:
    """Return text that Markdown shows as it is."""
    return re.sub(r"([\\`*_<>|#]|(?<=\])\()", r"\\\1", " ".join(text.split()))


def _made(experiment: Mapping[str, Any]) -> Iterator[Table]:
    """Yield the tables of settings and versions."""
    settings = {name: value for name, value in experiment.items() if name not in _NOT_SHOWN}
    versions = {str(n): one for n, one in enumerate(experiment["environments"], 1)}
    for title, values in (("Settings", settings), ("Versions", versions)):
        lines = ({"name": name, "value": str(value)} for name, value in flat(values).items())
        yield table_of(title, lines, labels=2)
