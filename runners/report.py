"""`python -m runners.report DIR`: the figures and tables of an evaluation, as a page."""

from __future__ import annotations

import shlex
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from chsel.errors import SettingError, require_choice
from chsel.problem.settings import build_settings, settings_mapping
from replay.console import Console, print_written
from replay.files import whole_file
from runners.command.program import command, plain
from runners.reporting.against_baseline import against_baseline
from runners.reporting.evaluation_folder import open_evaluation
from runners.reporting.figures import FORMATS, drawing, set_title, write_picture
from runners.reporting.page import as_html, as_markdown, page_of
from runners.reporting.section import Section, SequenceConfig, Subject
from runners.reporting.sections import sections_of
from runners.reporting.tables import print_table

HTML, MARKDOWN = "report.html", "report.md"
_ACCEPTED = "an out=DIR that can be written"


@dataclass(frozen=True)
class ReportConfig:
    """conf/report.yaml, which has all defaults, checked."""

    sequence: SequenceConfig
    dir: str | None
    baseline: str | None
    format: str
    out: str | None

    def __post_init__(self) -> None:
        require_choice("format", self.format, FORMATS)
        if not self.dir:
            raise SettingError("dir is missing; pass the folder of an evaluation")


@command("report")
def main(config: DictConfig) -> None:
    """Draw all figures, and write the page, the Markdown, the pictures and their data."""
    checked = build_settings(ReportConfig, plain(config), "report")
    folder = Path(checked.dir or "").expanduser()
    out = Path(checked.out).expanduser() if checked.out else folder / "report"
    subject = Subject(open_evaluation(folder), checked.sequence, checked.baseline)
    console, waiting = Console(), Console(stderr=True)
    if (compared := against_baseline(subject)) is not None:
        for table in compared.tables:
            print_table(console, table)
            console.print()
    with drawing(), waiting.status("drawing") if waiting.is_terminal else nullcontext():
        sections = sections_of(subject)
        files = _write(out, subject, sections, checked)
    if subject.evaluation.is_steered:
        for table in (table for section in sections[1:] for table in section.tables):
            print_table(console, table)
            console.print()
    for section in sections:
        if section.missing:
            line = f"no picture of {section.title}: {section.missing}"
            console.print(line, soft_wrap=True)
    print_written(*files)


def _write(
    out: Path, subject: Subject, sections: list[Section], config: ReportConfig
) -> list[Path]:
    """Write the files, each in the place of that of an earlier report, and return them."""
    contents: dict[str, bytes] = {}
    files: list[Path] = []
    for section in sections:
        if (picture := section.picture) is not None:
            set_title(picture.figure, f"{section.title}, {subject.evaluation.name}")
            drawn = write_picture(picture, out, config.format, accepted=_ACCEPTED)
            contents[picture.name] = drawn[0].read_bytes()
            files += drawn
    page = page_of(subject.evaluation, sections, _command(config), config.format)
    for name, text in ((MARKDOWN, as_markdown(page)), (HTML, as_html(page, contents))):
        with whole_file(out / name, _ACCEPTED) as beside:
            beside.write_text(text, encoding="utf-8")
        files.append(out / name)
    return files


def _command(config: ReportConfig) -> str:
    """What makes these bytes again, wherever they go."""
    usual = settings_mapping(SequenceConfig())
    chosen = settings_mapping(config.sequence)
    changed = {name: value for name, value in chosen.items() if value != usual[name]}
    settings = [] if config.baseline is None else [f"baseline={config.baseline}"]
    settings += [] if config.format == FORMATS[0] else [f"format={config.format}"]
    settings += [f"sequence.{name}={_value(value)}" for name, value in changed.items()]
    return shlex.join(["python", "-m", "runners.report", str(config.dir), *settings])


def _value(value: Any) -> str:
    return f"[{','.join(map(str, value))}]" if isinstance(value, tuple) else str(value)


if __name__ == "__main__":
    main()
