"""A report as one HTML page with its pictures in it, and as Markdown beside them."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jinja2

from runners.reporting.evaluation_folder import Evaluation, trials_of
from runners.reporting.figures import Picture, file_content
from runners.reporting.section import Section
from runners.reporting.tables import Cell, Table

_LONG = 20  # rows, of tables that can be folded
_NOT_SHOWN = ("environment", "other_environments", "commands", "methods", "policies", "format")


@dataclass(frozen=True)
class Page:
    """A report in full."""

    title: str
    lead: tuple[str, ...]  # what it is about
    sections: tuple[Section, ...]
    commands: tuple[str, ...]  # that made the evaluation and the report
    made: tuple[Table, ...]  # settings and versions
    kind: str  # of the files of its pictures, one of FORMATS


def page_of(evaluation: Evaluation, sections: Sequence[Section], command: str, kind: str) -> Page:
    """A page of sections. command: that makes the report itself. kind: of the pictures' files."""
    experiment, rows = evaluation.experiment, evaluation.rows
    lead = [
        f"{len(evaluation.methods)} methods on {len(trials_of(rows))} trials of "
        f"{len(evaluation.objects)} objects: {len(rows)} registrations. PD is plausible diversity "
        "in mm², lower is better; the best median of a row is bold, in brackets are its quartiles, "
        "and n is how many numbers are behind it.",
        f"Plausible sets are by the definition {evaluation.definition_text}.",
    ]
    if evaluation.is_steered:
        lead = [_lead_of_policies(evaluation)]
    if evaluation.gathered:
        lead.append("There is no table of the whole evaluation yet: this is what is finished.")
    if rows.empty and evaluation.probes.empty:
        lead = ["Nothing is finished yet: there is no registration to report on."]
    commands = experiment.get("commands")
    made = [str(line) for line in commands] if isinstance(commands, list) else []
    return Page(
        f"Evaluation {evaluation.name}",
        tuple(lead),
        tuple(sections),
        (*made, command),
        tuple(table for table in _made(experiment) if table.rows),
        kind,
    )


def _lead_of_policies(evaluation: Evaluation) -> str:
    probes = evaluation.probes
    methods = ", ".join(sorted(probes["method"].dropna().unique()))
    return (
        f"{probes['policy'].nunique()} policies on {len(trials_of(probes))} trials of "
        f"{probes['object'].nunique()} objects: {len(probes)} probes, after which {methods} "
        "registered, from the first contact on."
    )


def as_html(page: Page, contents: Mapping[str, bytes]) -> str:
    """The page with its pictures in it, to be read without anything else.

    contents: of the pictures' files by name. Pictures of PDF files, which pages cannot show, are
    drawn as PNG.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("runners.reporting", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )

    def address(picture: Picture) -> str:
        pdf = page.kind == "pdf"
        content = file_content(picture.figure) if pdf else contents[picture.name]
        media_type = "svg+xml" if page.kind == "svg" else "png"
        return f"data:image/{media_type};base64,{base64.b64encode(content).decode()}"

    environment.filters["address"] = address
    return environment.get_template("page.html").render(vars(page))


def as_markdown(page: Page) -> str:
    """The page, with links to the files of its pictures and of their data."""
    parts = [f"# {_text(page.title)}", *map(_text, page.lead)]
    for section in page.sections:
        parts += [f"## {_text(section.title)}"]
        parts += [_text(section.text)] if section.text else []
        if section.picture is not None:
            name, alt = section.picture.name, _text(section.picture.alt)
            parts.append(f"{'' if page.kind == 'pdf' else '!'}[{alt}]({name}.{page.kind})")
            parts.append(f"[The numbers drawn]({name}.csv)")
        elif section.missing:
            parts.append(f"No picture: {_text(section.missing)}.")
        parts += [part for table in section.tables for part in _markdown_table(table)]
    parts += ["## How it was made", "```\n" + "\n".join(page.commands) + "\n```"]
    parts += [part for table in page.made for part in _markdown_table(table)]
    return "\n\n".join(parts) + "\n"


def _markdown_table(table: Table) -> list[str]:
    lines = [
        "| " + " | ".join(_text(name) for name in table.header) + " |",
        "|" + "|".join(" :-- " if i < table.labels else " --: " for i in range(len(table.header)))
        + "|",
        *("| " + " | ".join(_markdown_cell(cell) for cell in row) + " |" for row in table.rows),
    ]  # fmt: skip
    text = "\n".join(lines)
    note = [_text(table.note)] if table.note else []
    if len(table.rows) <= _LONG:
        return [f"**{_text(table.title)}**", text, *note]
    return [f"<details><summary>{_text(table.title)}</summary>", text, *note, "</details>"]


def _markdown_cell(cell: Cell) -> str:
    text = f"**{_text(cell.text)}**" if cell.best else _text(cell.text)
    text += f" {_text(cell.between)}" if cell.between else ""
    return f"{text} ({_text(cell.note)})" if cell.note else text


def _text(text: str) -> str:
    """Text that Markdown takes for nothing else."""
    return re.sub(r"([\\`*_<>|#]|(?<=\])\()", r"\\\1", " ".join(text.split()))


def _made(experiment: Mapping[str, Any]) -> list[Table]:
    """Settings and versions."""
    settings = {name: value for name, value in experiment.items() if name not in _NOT_SHOWN}
    environments = [experiment.get("environment"), *(experiment.get("other_environments") or ())]
    tables = [_pairs("Settings, all of which experiment.json holds", _flat(settings))]
    for index, values in enumerate(environments):
        title = "Versions" if index == 0 else f"Versions on another machine, {index}"
        tables.append(_pairs(title, _flat(values) if isinstance(values, Mapping) else {}))
    return tables


def _pairs(title: str, values: Mapping[str, str]) -> Table:
    rows = tuple((Cell(name), Cell(value)) for name, value in values.items())
    return Table(title, ("name", "value"), rows, labels=2)


def _flat(values: Mapping[str, Any], path: str = "") -> dict[str, str]:
    """Nested settings by their paths."""
    flat: dict[str, str] = {}
    for name, value in values.items():
        key = f"{path}.{name}" if path else str(name)
        if isinstance(value, Mapping):
            flat |= _flat(value, key)
        elif isinstance(value, list):
            flat[key] = ", ".join(map(str, value))
        else:
            flat[key] = "-" if value is None else str(value)
    return flat
