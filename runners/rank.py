"""`python -m runners.rank DIR`: an evaluation of one's own beside that of docs/results.md."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from chsel.errors import SettingError
from chsel.problem.settings import CheckedSettings, build_settings
from replay.console import Console
from runners.command.program import command, plain
from runners.reporting.ranking import ranking
from runners.reporting.tables import Table, print_table


@dataclass(frozen=True)
class RankConfig(CheckedSettings):
    """conf/rank.yaml, which has all defaults, checked."""

    dir: str | None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.dir:
            raise SettingError("dir is missing; pass the folder of an evaluation")


@command("rank")
def main(config: DictConfig) -> None:
    """Print which rows are the same to the bit, and the table with all rows of both."""
    checked = build_settings(RankConfig, plain(config), where="rank")
    console = Console()
    for shown in ranking(Path(checked.dir or "").expanduser()):
        if isinstance(shown, Table):
            print_table(console, shown)
        else:
            console.print(shown, soft_wrap=True)


if __name__ == "__main__":
    main()
