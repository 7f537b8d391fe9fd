"""`python -m docs.results.make`: the pages of docs/ with results, and the README's numbers.

python -m docs.results.make                   write the pages from the tables in runners/results
python -m docs.results.make store FOLDER ...  put evaluations there first, under their names
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
import pyarrow.parquet

from runners.evaluation.experiment import TABLES
from runners.real import MADE, medians
from runners.reporting import sections, statistics
from runners.reporting.evaluation_folder import TRIAL, Evaluation, open_evaluation
from runners.reporting.figures import styles_of
from runners.reporting.ranking import KEPT, stored_names
from runners.reporting.tables import Table, number, percent, percent_range, with_range
from runners.sessions.faults import LEVELS

HERE = Path(__file__).parent
DOCS = Path(__file__).parents[1]
_NAMES = ("results", "results_paper", "results_probing", "benchmark")
PAGES = {HERE / f"{name}.md.j2": DOCS / f"{name}.md" for name in _NAMES}
README = DOCS.parent / "README.md"
_BLOCK = re.compile(r"(<!-- ([a-z_]+) of docs/results -->\n).*?(<!-- end -->)", re.DOTALL)
REAL = "real"  # results of runners.real


@cache
def evaluation(name: str) -> Evaluation:
    """The one that is kept under this name."""
    return open_evaluation(KEPT / name)


def stored() -> list[str]:
    """Names of all evaluations that are kept."""
    return stored_names(KEPT)


def _markdown(table: Table, without: Sequence[str] = ()) -> str:
    """A table of a report; without: columns."""
    out = [n for n, head in enumerate(table.header) if head not in without]
    rows = [[row[n] for n in out] for row in [table.header, *table.rows]]
    rows.insert(1, [":--"] * table.labels + ["--:"] * (len(out) - table.labels))
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def table(name: str, title: str, baseline: str | None = None, without: str = "") -> str:
    """A table of the report of an evaluation, by its title; without: columns, by semicolons."""
    found = [
        table
        for section in sections.sections_of(evaluation(name), baseline)
        for table in section.tables
        if table.title == title
    ]
    (one,) = found
    return _markdown(one, without.split("; "))


def real() -> str:
    """Medians of real measurements."""
    found = medians(pd.read_csv(HERE / REAL / "results.csv"))
    header = tuple(head.replace("-\n", "").replace("\n", " ") for head in found.header)
    return _markdown(replace(found, header=header), ["ms"])


@cache
def _with_ratios(name: str, to: str) -> pd.DataFrame:
    return statistics.with_ratios(evaluation(name).rows, to)


def _chosen(rows: pd.DataFrame, where: Mapping[str, Any]) -> pd.DataFrame:
    """The rows that have these values in these columns."""
    for column, value in where.items():
        rows = rows[rows[column] == value]
    return rows


def ratio(name: str, method: str, to: str, **where: Any) -> str:
    """PD by that of another method at the same steps; what may be 1 is said to be within noise."""
    own = _chosen(_with_ratios(name, to), {"method": method, **where})
    mean, lower, upper = statistics.ratio_interval(own)
    return with_range(mean, lower, upper=upper) + (
        ", within noise" if lower <= 1.0 <= upper else ""
    )


def worse(name: str, methods: list[str], to: str) -> str:
    """Whether methods have a higher PD than another one, beyond their intervals."""
    intervals = [
        statistics.ratio_interval(_chosen(_with_ratios(name, to), {"method": method}))
        for method in methods
    ]
    if all(lower > 1.0 for _, lower, _ in intervals):
        return "yes"
    return "no" if all(upper < 1.0 for *_, upper in intervals) else "within noise"


def better(name: str, method: str, than: str, **where: Any) -> str:
    """The share of steps at which a method has a lower PD than another one."""
    own = _chosen(_with_ratios(name, than), {"method": method, **where})["ratio"].dropna()
    return percent((own < 1.0 - 1e-9).mean())


def numbers(name: str, column: str, **where: Any) -> pd.Series:
    """The numbers of a column that there are, of rows with these values."""
    return _chosen(evaluation(name).rows, where)[column].dropna().astype(float)


def median(name: str, column: str, **where: Any) -> str:
    """Of these numbers."""
    return number(numbers(name, column, **where).median())


def share(name: str, column: str, below: float | None = None, **where: Any) -> str:
    """Of rows with a flag, or with a number below a limit; Wilson's interval."""
    values = numbers(name, column, **where)
    flags = values > 0.5 if below is None else values < below
    frame = pd.DataFrame({"all": 0, "flag": flags})
    return percent_range(statistics.shares(frame, "all", column="flag").iloc[0])


def mean_share(name: str, column: str, **where: Any) -> str:
    """The mean of numbers from 0 to 1, as a share."""
    return percent(numbers(name, column, **where).mean())


def count(name: str, **where: Any) -> int:
    """How many registrations, or probes of policies, an evaluation has."""
    if evaluation(name).experiment["policies"]:
        return len(evaluation(name).probes)
    return len(numbers(name, "step", **where))


def title(name: str, method: str) -> str:
    """What tables call a method."""
    return styles_of(evaluation(name).methods)[method].title


def commit(name: str) -> str:
    """Of the code that made the registrations."""
    file = HERE / REAL / MADE if name == REAL else KEPT / name / "experiment.json"
    made = {one.get("checkout", "?") for one in json.loads(file.read_text())["environments"]}
    return ", ".join(f"`{one[:9]}`" for one in sorted(made))


def digest(name: str) -> str:
    """Of the table of an evaluation."""
    kept = sorted((KEPT / name).glob("*.parquet"))
    files = [HERE / REAL / "results.csv"] if name == REAL else kept
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]


def seeds(name: str, method: str | None = None) -> str:
    """Those of an evaluation, or of a method in it, as commands have them."""
    every = evaluation(name)
    used = numbers(name, "seed", method=method).astype(int) if method else every.experiment["seeds"]
    first, last = min(used), max(used)
    return f"{first}" if first == last else f"{first}..{last}"


def definition(name: str) -> str:
    """The plausible sets behind an evaluation's PD, if it has any."""
    every = evaluation(name)
    return every.definition_text if every.rows["members"].notna().any() else ""


def levels(name: str) -> list[str]:
    """Faults of an evaluation, in the order of their table."""
    there = set(evaluation(name).rows["faults"])
    return [level for level in LEVELS if level in there]


def moment(method: str, iteration: int, column: str = "diversity") -> str:
    """Median of the searches of `paper_qd` after so many iterations."""
    rows = evaluation("paper_qd").iterations
    own = rows[(rows["method"] == method) & (rows["iteration"] == iteration)]
    return number(own[column].median())


def pushed(name: str) -> pd.DataFrame:
    """Registrations after six touches and more of objects that may move: five pushes are known."""
    probes = evaluation(name).probes.sort_values([*TRIAL, "probes"])
    return probes[probes.groupby(TRIAL)["hit"].cumsum() >= 6]


def moved(name: str, column: str) -> str:
    """Median of these, mm."""
    return number(1000.0 * pushed(name)[column].median())


def wrong(name: str) -> str:
    """How many of these that say *determined* are more than 10 mm off."""
    sure = pushed(name).query("verdict == 'determined'")
    return f"{(sure['best_error'] > statistics.GOOD).sum()} of {len(sure)}"


def solved(name: str, policy: str) -> str:
    """The share of a policy's sessions whose set comes within 10 mm."""
    errors = statistics.steered_sessions(evaluation(name)).errors.loc[policy]
    return percent((errors.min(axis=1) < statistics.GOOD).mean())


def held_by_modes(name: str) -> str:
    """The share of results with modes whose ellipsoids of 90 % hold the true pose."""
    held = evaluation(name).probes["modes_90"].dropna()
    return percent_range(
        statistics.shares(pd.DataFrame({"all": 0, "flag": held}), "all", column="flag").iloc[0]
    )


def things(name: str) -> int:
    """How many objects an evaluation has."""
    return int(evaluation(name).probes["object"].nunique())


def _speeds() -> dict[tuple[str, str], str]:
    """Milliseconds by problem and registration, of docs/speed.md."""
    lines = (DOCS / "speed.md").read_text().splitlines()
    cells = [[cell.strip() for cell in line.strip("| ").split("|")] for line in lines]
    return {(row[0], row[1]): row[2] for row in cells if len(row) in (6, 7)}


def speed_of(problem: str, registration: str) -> str:
    """Milliseconds of a registration in the median."""
    return _speeds()[problem, registration]


def speeds(problems: Mapping[str, str], columns: Mapping[str, str]) -> str:
    """Milliseconds by problem and registration, each with its name in the table."""
    every = _speeds()
    lines = [["drill", *columns.values()], ["---", *["--:"] * len(columns)]]
    for name, text in problems.items():
        lines.append([text, *(every.get((name, column), "") for column in columns)])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def store(folder: Path) -> None:
    """Keep the tables of an evaluation, smaller, and without those of single machines."""
    if (folder / MADE).exists():
        (HERE / REAL).mkdir(exist_ok=True)
        for name in (MADE, "results.csv"):
            shutil.copyfile(folder / name, HERE / REAL / name)
        return
    experiment = json.loads((folder / "experiment.json").read_text())
    outside = experiment["outside"]
    experiment["outside"] = {name: Path(path).name for name, path in outside.items()}
    to = KEPT / experiment["name"]
    to.mkdir(exist_ok=True)
    (to / "experiment.json").write_text(json.dumps(experiment, indent=1) + "\n")
    for name in TABLES:
        if (folder / f"{name}.parquet").exists():
            table = pyarrow.parquet.read_table(folder / f"{name}.parquet")
            pyarrow.parquet.write_table(table, to / f"{name}.parquet", compression="zstd")


def ranked(name: str, to: str) -> list[str]:
    """Methods by their ratio of PD to another one's, best first."""
    means = _with_ratios(name, to).groupby("method")["ratio"].agg(statistics.geometric_mean)
    return list(means.dropna().sort_values().index)


def write(checked: bool = False) -> list[Path]:
    """The pages that are not what the tables say; checked: these are not written anew."""
    loader = jinja2.FileSystemLoader(HERE)
    engine = jinja2.Environment(
        loader=loader, undefined=jinja2.StrictUndefined, keep_trailing_newline=True
    )
    engine.globals |= {name: value for name, value in globals().items() if callable(value)}
    texts = {page: engine.get_template(path.name).render() for path, page in PAGES.items()}
    blocks = engine.get_template("README.md.j2").module

    def filled(match: re.Match[str]) -> str:
        return f"{match[1]}{str(getattr(blocks, match[2])()).strip()}\n{match[3]}"

    texts[README] = _BLOCK.sub(filled, README.read_text())
    stale = [page for page, text in texts.items() if not page.exists() or page.read_text() != text]
    for page in stale if not checked else ():
        page.write_text(texts[page])
    return stale


def main(arguments: list[str]) -> None:
    """See above."""
    verb = (arguments or ["write"])[0]
    folders = [Path(name) for name in arguments[1:]]
    if verb not in ("write", "store") or bool(folders) != (verb != "write"):
        sys.exit(f"{' '.join(arguments)} is none of:\n{__doc__}")
    for folder in folders:
        store(folder)
    for page in write():
        print(page)


if __name__ == "__main__":
    main(sys.argv[1:])
