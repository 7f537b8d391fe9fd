"""Output of commands: a name is shown as it is, never read as markup or sent as a control."""

from __future__ import annotations

import sys
import unicodedata
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import rich.console
import rich.progress
from rich.box import SIMPLE_HEAD
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

# Control and format characters (such as those that reverse the direction of what follows), halves
# of surrogate pairs (bytes of file names that are not UTF-8), ends of lines and paragraphs.
_NOT_SHOWN = {"Cc", "Cf", "Cs", "Zl", "Zp"}
_MOST_LABELS = 0.6  # of the width of a terminal: texts that stand beside each part of a table


def printable(text: str, *, keep: str = "") -> str:
    r"""Return the text with every character that would steer a terminal escaped, such as \x1b.

    keep: characters that stay as they are.
    """
    if text.isprintable():
        return text
    return "".join(
        repr(sign)[1:-1] if unicodedata.category(sign) in _NOT_SHOWN and sign not in keep else sign
        for sign in text
    )


def print_page(text: str) -> None:
    """Print a text of several lines, such as a command's help."""
    print(printable(text, keep="\n"))


def print_written(*files: Path) -> None:
    """Print the path of each file that was written."""
    for file in files:
        print(f"written: {printable(str(file))}")


def print_error(text: str) -> None:
    """Print one line about what is wrong, on stderr."""
    print(f"error: {printable(text)}", file=sys.stderr)


def print_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning as one line on stderr; takes the place of `warnings.showwarning`."""
    print(f"warning: {printable(str(message))}", file=sys.stderr)


class Console(rich.console.Console):
    """A terminal, or a file. A text that is printed is one line; cells and titles may have more."""

    def __init__(
        self,
        *,
        stderr: bool = False,
        soft_wrap: bool = False,
        file: IO[str] | None = None,
        width: int | None = None,
    ) -> None:
        super().__init__(
            stderr=stderr,
            soft_wrap=soft_wrap,
            file=file,
            width=width,
            markup=False,
            emoji=False,
            highlight=False,
        )

    def print(self, *objects: Any, **options: Any) -> None:
        """Print texts and tables; a newline within a text is shown, not sent.

        A table that is wider than the terminal is printed as several, of some of its columns each.
        """
        shown: list[Any] = []
        for one in objects:
            if isinstance(one, Table):
                shown += self._blocks(one)
            else:
                shown.append(printable(one) if isinstance(one, str) else one)
        super().print(*shown, **options)

    def _blocks(self, table: Table) -> list[Table]:
        """Return the table or, if it is too wide, parts that fit; each begins with its texts."""
        columns = range(len(table.columns))
        numbers = [n for n in columns if table.columns[n].overflow != "fold"]
        labels = range(max(1, numbers[0])) if numbers else columns
        longest = _MOST_LABELS * self.width  # longer ones are folded where they stand
        if self._width_of(table) <= self.width or self._width_of(_part(table, labels)) > longest:
            return [table]
        blocks: list[list[int]] = []
        for n in range(len(labels), len(table.columns)):
            last = blocks[-1] if blocks else None
            if last and self._width_of(_part(table, [*last, n])) <= self.width:
                last.append(n)
            else:
                blocks.append([*labels, n])
        first, *others = (_part(table, block) for block in blocks)
        for other in others:
            other.title = None
        return [first, *others]

    def _width_of(self, table: Table) -> int:
        return Measurement.get(self, self.options.update(width=10_000), table).maximum

    def render_str(self, text: str, **options: Any) -> Text:
        """Return printable text; each printed text, cell and title of a table passes here."""
        options |= {"markup": False, "emoji": False}
        return super().render_str(printable(text, keep="\n"), **options)


def plain_table(
    title: str = "", *, texts: Sequence[str] = (), numbers: Sequence[str] = ()
) -> Table:
    """Return a table without lines between its columns, those of texts first."""
    table = Table(
        title=title or None,
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
        show_edge=False,
    )
    for name in texts:
        table.add_column(name, overflow="fold")
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _part(table: Table, columns: Sequence[int]) -> Table:
    """Return a table of some of the columns of another one."""
    part = copy(table)
    part.columns = [replace(table.columns[n], _index=i) for i, n in enumerate(columns)]
    return part


class Progress(rich.progress.Progress):
    """A progress bar whose descriptions are shown as they are."""

    @classmethod
    def get_default_columns(cls) -> tuple[rich.progress.ProgressColumn, ...]:
        """Return the description, the bar, and how much is done."""
        _, *columns = super().get_default_columns()
        return (TextColumn("{task.description}"), *columns)


class TextColumn(rich.progress.TextColumn):
    """A column of text, such as "{task.description}"."""

    def __init__(self, text_format: str) -> None:
        super().__init__(text_format, markup=False)

    def render(self, task: rich.progress.Task) -> Text:
        """Return the text of a task."""
        return Text(printable(self.text_format.format(task=task)))
