"""Tables on narrow terminals."""

import io

import pytest

from replay.console import Console, plain_table

NAMES = ("anchored#adaptive", "a name: of_policy")


def printed(width, *, labels=NAMES, numbers=6, **options):
    """The lines of a table of labels and numbers, and its cells."""
    heads = [f"column {n}" for n in range(numbers)]
    table = plain_table("a title", texts=["name"], numbers=heads, **options)
    for label in labels:
        table.add_row(label, *(f"{n}.12 [1, 2]" for n in range(numbers)))
    console = Console(file=io.StringIO(), width=width)
    console.print(table, "")
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize("width", [50, 80, 94])
def test_a_table_that_is_too_wide_is_split_between_columns(width):
    lines = [line.rstrip() for line in printed(width)]
    assert max(map(len, lines)) <= width
    assert "".join(lines).count("a title") == 1
    assert "…" not in "".join(lines)
    for label in NAMES:
        rows = [line for line in lines if line.startswith(label)]
        assert 1 < len(rows) <= 6
        shown = "".join(row.removeprefix(label) for row in rows)
        assert shown.split("]")[:-1] == [f"  {n}.12 [1, 2" for n in range(6)]


def test_a_table_that_fits_is_one():
    lines = printed(140)
    assert sum(line.startswith(NAMES[0]) for line in lines) == 1
    assert lines[-1] == ""


def test_long_texts_are_folded_where_they_stand():
    lines = printed(60, labels=["x" * 70], numbers=2)
    assert sum("column 0" in line for line in lines) == 1
    assert "".join(lines).count("x") == 70
