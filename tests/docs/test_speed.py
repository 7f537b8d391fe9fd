"""The speed that the README shows is that of the benchmark's page, docs/speed.md."""

import re

from tests.docs.page import DOCS

_NAMES = {
    "ours, `default`": "ours, default",
    "ours, `paper`": "ours, paper",
    "ours, `reference`": "ours, reference",
    "`anchored`, small": "anchored, small",
    "`anchored`, medium": "anchored, medium",
    "`anchored`, adaptive": "anchored, adaptive",
    "package": "package",
    "package, Eq. 8": "package, Eq. 8",
}


def table_rows(text):
    lines = [line for line in text.splitlines() if re.fullmatch(r"\|.*[^-|: ].*\|", line)]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_times_in_the_readme_are_those_of_the_page():
    readme = (DOCS.parent / "README.md").read_text()
    section = readme.partition("\n## Speed\n")[2].partition("\n## ")[0]
    header, *rows = table_rows(section)
    measured = {(row[0], row[1]): row[2] for row in table_rows((DOCS / "speed.md").read_text())}
    assert len(rows) >= 4
    for row in rows:
        (problem,) = re.findall("`(.*)`", row[0])
        for column, cell in zip(header[1:], row[1:], strict=True):
            assert cell == measured.get((problem, _NAMES[column]), ""), f"{problem}, {column}"
