"""`python -m runners.report DIR`: the figures and tables of an evaluation, as a page."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from chsel.errors import SettingError, require_choice
from chsel.problem.settings import build_settings
from replay.console import Console, print_written
from replay.files import whole_file
from runners.command.program import command, plain
from runners.reporting.evaluation_folder import open_evaluation
from runners.reporting.figures import FORMATS, drawing, write_picture
from runners.reporting.page import as_html, as_markdown
from runners.reporting.sections import BASELINE, sections_of
from runners.reporting.tables import print_table


@dataclass(frozen=True)
class ReportConfig:
    """conf/report.yaml, which has all defaults, checked."""

    dir: str | None
    baseline: str | None
    format: str
    out: str | None

    def __post_init__(self) -> None:
        require_choice("format", self.format, accepted=FORMATS)
        if not self.dir:
            raise SettingError("dir is missing; pass the folder of an evaluation")


@command("report")
def main(config: DictConfig) -> None:
    """Draw all figures, and write the page, the Markdown, the pictures and their data."""
    checked = build_settings(ReportConfig, plain(config), where="report")
    folder = Path(checked.dir or "").expanduser()
    kind = checked.format
    out = Path(checked.out).expanduser() if checked.out else folder / "report"
    evaluation = open_evaluation(folder)
    console = Console()
    files: list[Path] = []
    contents: dict[str, bytes] = {}
    with drawing():
        sections = sections_of(evaluation, checked.baseline)
        steered = bool(evaluation.experiment["policies"])
        printed = sections[1:] if steered else [s for s in sections if s.title == BASELINE]
        for picture in (section.picture for section in sections if section.picture):
            picture.figure.suptitle(evaluation.experiment["name"])
            files += write_picture(picture, out, kind=kind)
            if kind != "pdf":  # which pages cannot show
                contents[files[-2].name] = files[-2].read_bytes()
    given = {"baseline": checked.baseline, "format": None if kind == FORMATS[0] else kind}
    settings = [f"{name}={value}" for name, value in given.items() if value]
    made = shlex.join(["python", "-m", "runners.report", str(checked.dir), *settings])
    markdown = as_markdown(evaluation, sections, command=made, kind=kind)
    texts = {"report.md": markdown, "report.html": as_html(markdown, contents)}
    for name, text in texts.items():
        with whole_file(out / name) as beside:
            beside.write_text(text, encoding="utf-8")
        files.append(out / name)
    for table in (table for section in printed for table in section.tables if table.rows):
        print_table(console, table)
        console.print()
    print_written(*files)


if __name__ == "__main__":
    main()
