"""`python -m runners.report DIR`: the figures and tables of an evaluation, as a page."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from chsel.errors import SettingError
from chsel.problem.settings import build_settings, settings_mapping
from replay.console import Console
from runners.command.program import command, plain
from runners.reporting.against_baseline import section_against
from runners.reporting.completeness import planned_methods
from runners.reporting.console_table import print_table
from runners.reporting.evaluation_folder import open_evaluation
from runners.reporting.method_style import method_styles
from runners.reporting.page import Page, as_html, as_markdown, page_of
from runners.reporting.sections import SequenceConfig, sections_of
from runners.whole_file import whole_file

HTML, MARKDOWN = "report.html", "report.md"


@dataclass(frozen=True)
class ReportConfig:
    """conf/report.yaml, which has all defaults, checked."""

    sequence: SequenceConfig
    dir: str | None
    baseline: str | None
    out: str | None

    def __post_init__(self) -> None:
        if not self.dir:
            raise SettingError("dir is missing; pass the folder of an evaluation")


@command("report")
def main(config: DictConfig) -> None:
    """Draw all figures, and write the page, the Markdown and the pictures."""
    checked = build_settings(ReportConfig, plain(config), "report")
    folder = Path(checked.dir or "").expanduser()
    out = Path(checked.out).expanduser() if checked.out else folder / "report"
    evaluation = open_evaluation(folder)
    console, waiting = Console(), Console(stderr=True)
    if checked.baseline is not None:
        styles = method_styles(planned_methods(evaluation))
        for table in section_against(evaluation, styles, checked.baseline).tables:
            print_table(console, table)
            console.print()
    if waiting.is_terminal:
        with waiting.status("drawing"):
            sections = sections_of(evaluation, checked.sequence, checked.baseline)
    else:
        sections = sections_of(evaluation, checked.sequence, checked.baseline)
    _write(out, page_of(evaluation, sections, _command(checked)))
    for section in sections:
        if section.missing:
            line = f"no picture of {section.title}: {section.missing}"
            console.print(line, soft_wrap=True)
    for name in (HTML, MARKDOWN):
        console.print(str(out / name), soft_wrap=True)


def _write(out: Path, page: Page) -> None:
    """The files, each in the place of that of an earlier report."""
    for section in page.sections:
        if section.picture is not None:
            with whole_file(out / section.picture.name) as beside:
                beside.write_bytes(section.picture.png)
    for name, text in ((MARKDOWN, as_markdown(page)), (HTML, as_html(page))):
        with whole_file(out / name) as beside:
            beside.write_text(text, encoding="utf-8")


def _command(config: ReportConfig) -> str:
    """What makes these bytes again, wherever they go."""
    usual = settings_mapping(SequenceConfig())
    chosen = settings_mapping(config.sequence)
    changed = {name: value for name, value in chosen.items() if value != usual[name]}
    settings = [f"sequence.{name}={_value(value)}" for name, value in changed.items()]
    if config.baseline is not None:
        settings.insert(0, f"baseline={config.baseline}")
    return shlex.join(["python", "-m", "runners.report", str(config.dir), *settings])


def _value(value: Any) -> str:
    return f"[{','.join(map(str, value))}]" if isinstance(value, tuple) else str(value)


if __name__ == "__main__":
    main()
