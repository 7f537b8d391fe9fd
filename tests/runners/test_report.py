"""The report on an evaluation, as a user makes it."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from PIL import Image

from runners import report
from runners.reporting.evaluation_folder import open_evaluation
from tests.runners.in_process import run
from tests.runners.made_up_evaluations import (
    METHODS,
    add_recording,
    made_up_iterations,
    made_up_rows,
    row,
    write_evaluation,
    write_table,
)

PICTURES = [
    "cvo.png",
    "gradients.png",
    "medial.png",
    "over_iterations.png",
    "pd_boxes.png",
    "pd_over_probes.png",
    "sequence.png",
    "times.png",
]
DATA = [name.replace(".png", ".csv") for name in PICTURES]
_VOID = ("meta", "img", "link", "br")


class Page(HTMLParser):
    """A page in short: its tags as they were opened, and its tables. Fails for tags left open."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.tables: dict[str, list[list[str]]] = {}
        self._open: list[str] = []
        self._name = ""
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in _VOID:
            self._open.append(tag)
        if tag == "tr":
            self._cells: list[str] = []
        if tag in ("td", "th"):
            self._cells.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag
        if tag == "tr":
            self.tables.setdefault(self._name, []).append(self._cells)

    def handle_data(self, data: str) -> None:
        if "caption" in self._open or "summary" in self._open:
            self._name = data.strip()
        elif {"td", "th"} & set(self._open):
            self._cells[-1] += (" " if self._open[-1] == "small" else "") + data.strip()


def page_of(folder: Path) -> Page:
    return Page((folder / "report.html").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An evaluation with everything in it."""
    folder = tmp_path_factory.mktemp("evaluation")
    rows = made_up_rows(["clamp", "mustard", "mustard_fallen"], [0, 1], 3, METHODS)
    moments = made_up_iterations("clamp", [0, 1], [9], ["chsel", "chsel_cma_me"])
    planned = {"configurations": ["clamp", "mustard", "mustard_fallen"], "seeds": [0, 1]}
    methods = {method: {"name": method} for method in METHODS}
    write_evaluation(folder, rows, moments, **planned, methods=methods)
    for method in ("chsel", "icp", "medial_constraint"):
        add_recording(folder, "clamp", 1, method, f"clamp_{method}")
    done = run(report.main, str(folder))
    assert (done.returncode, done.stderr) == (0, "")
    assert "no picture" not in done.stdout
    written = {line for line in done.stdout.splitlines() if line.startswith("written: ")}
    assert written == {f"written: {path}" for path in (folder / "report").iterdir()}
    return folder


def test_a_report_has_all_pictures_and_stands_alone(whole: Path) -> None:
    found = whole / "report"
    assert sorted(path.name for path in found.iterdir()) == sorted(
        [*PICTURES, *DATA, "report.html", "report.md"]
    )
    for name in PICTURES:
        with Image.open(found / name) as image:
            assert image.width == 1440
            assert image.info.keys() <= {"dpi"}  # no clock, no program
            assert len(image.convert("RGB").getcolors(2**24) or []) > 50
    page = page_of(found)
    images = [attributes for tag, attributes in page.tags if tag == "img"]
    assert len(images) == len(PICTURES)
    assert all((image["src"] or "").startswith("data:image/png;base64,") for image in images)
    assert all(len(image["alt"] or "") > 40 for image in images)
    assert not {"script", "link", "iframe"} & {tag for tag, _ in page.tags}
    names = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(set(names)) == len(names)
    targets = [(a["href"] or "")[1:] for tag, a in page.tags if tag == "a"]
    assert targets
    assert set(targets) <= set(names)
    html = (found / "report.html").read_text(encoding="utf-8")
    assert html.startswith("<!DOCTYPE html>")
    assert "url(" not in html
    assert "python -m runners.evaluate experiment=made_up\npython -m runners.report" in html


def test_the_markdown_links_its_pictures_and_has_the_same_numbers(whole: Path) -> None:
    text = (whole / "report" / "report.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"\]\(([\w.]+)\)", text)) == sorted([*PICTURES, *DATA])
    table = text.split("**PD in mm² by object**\n\n")[1].split("\n\n")[0]
    lines = [line.strip("| ").split(" | ") for line in table.splitlines()]
    assert [line[:2] for line in lines[2:]] == [["clamp", "4"], ["mustard", "8"]]
    cells = [[cell.replace("**", "") for cell in line] for line in lines[2:]]
    assert cells == page_of(whole / "report").tables["PD in mm² by object"][1:]
    assert [line[2:].count(next(c for c in line if "**" in c)) for line in lines[2:]] == [1, 1]


def test_the_same_evaluation_gives_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    assert run(report.main, str(whole), f"out={tmp_path / 'again'}").returncode == 0
    for path in (whole / "report").iterdir():
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes(), path.name


def test_finished_parts_stand_in_for_a_table_that_is_not_there_yet(tmp_path: Path) -> None:
    write_evaluation(tmp_path, None, configurations=["can"], seeds=[0], methods={"icp": {}})
    trial = tmp_path / "trials" / "can" / "seed_0"
    trial.mkdir(parents=True)
    write_table(trial / "icp.parquet", [row("can", 0, "icp", 5, diversity=3.0)])
    write_table(trial / "svgd.parquet", [row("can", 0, "svgd", 5, diversity=4.0)])
    failed = row("can", 0, "icp", None) | {"status": "failed: once"}
    write_table(trial / "icp.failed.parquet", [failed])  # before it went well
    evaluation = open_evaluation(tmp_path)
    assert evaluation.gathered
    assert evaluation.rows[["method", "diversity"]].to_numpy().tolist() == [
        ["icp", 3.0],
        ["svgd", 4.0],
    ]
    assert run(report.main, str(tmp_path)).returncode == 0
    assert "no table of the whole" in (tmp_path / "report" / "report.md").read_text("utf-8")


@pytest.mark.parametrize(
    ("kind", "begins", "on_page"),
    [("svg", b"<?xml", "image/svg+xml"), ("pdf", b"%PDF-", "image/png")],
)
def test_figures_are_files_of_a_format_the_same_each_time_with_the_evaluations_name(
    tmp_path: Path, kind: str, begins: bytes, on_page: str
) -> None:
    folder = write_evaluation(tmp_path, made_up_rows(["can"], [0, 1], 2, ["icp"]), name="$own$ 1")
    contents = []
    for name in ("first", "again"):
        assert (
            run(report.main, str(folder), f"out={tmp_path / name}", f"format={kind}").stderr == ""
        )
        files = sorted((tmp_path / name).iterdir())
        contents.append([path.read_bytes() for path in files if path.suffix == f".{kind}"])
    assert contents[0] == contents[1]
    assert len(contents[0]) == 3
    assert {path.suffix for path in files} == {f".{kind}", ".csv", ".html", ".md"}
    assert all(content.startswith(begins) for content in contents[0])
    if kind == "svg":
        assert b"<!-- Plausible diversity by object and method, $own$ 1 -->" in contents[0][0]
    sources = [
        attributes["src"] or ""
        for tag, attributes in page_of(tmp_path / "first").tags
        if tag == "img"
    ]
    assert [source.split(";")[0] for source in sources] == [f"data:{on_page}"] * 3
    text = (tmp_path / "again" / "report.md").read_text("utf-8")
    assert f"](pd_boxes.{kind})" in text
    assert f"format={kind}" in text.split("How it was made")[1]


@pytest.mark.parametrize(
    ("rows", "sections"),
    [
        ([], []),
        ([row("can", 0, "chsel", 4) | {"status": "failed: no reason"}], []),
        (
            [row("can", 0, "chsel", 4, diversity=0.0, seconds=0.0)],
            ["over-probes", "boxes", "times"],
        ),
        (
            [row("can", 0, name, 4, diversity=0.0) for name in ("cvo", "icp")],
            ["over-probes", "boxes", "cvo"],
        ),
        ([row("can", 0, "our own @#$1", 4, seconds=2.0)], ["times"]),
    ],
    ids=["nothing", "all failed", "one zero", "no time", "no PD"],
)
def test_there_are_only_sections_of_what_the_rows_have(
    tmp_path: Path, rows: list, sections: list
) -> None:
    write_evaluation(tmp_path, rows)
    done = run(report.main, str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")
    assert "no picture" not in done.stdout
    page = page_of(tmp_path / "report")
    names = [attributes["id"] for tag, attributes in page.tags if tag == "section"]
    assert names == ["what-was-run", *sections, "made"]
    done = run(report.main, str(tmp_path), "sequence.view=xy")
    assert done.stdout.count("there are no recordings") == 2  # as they were asked for


def test_settings_of_the_sequence_choose_trial_methods_and_steps(
    whole: Path, tmp_path: Path
) -> None:
    out = f"out={tmp_path}"
    some = ["sequence.methods=[icp]", "sequence.steps=[11]", "sequence.view=xy"]
    assert run(report.main, str(whole), out, "sequence.trial=clamp/1", *some).returncode == 0
    text = (tmp_path / "report.md").read_text("utf-8")
    assert "seen from above" in text
    assert "sequence.trial=clamp/1 'sequence.methods=[icp]' 'sequence.steps=[11]'" in text
    assert "that ICP hold" in text
    done = run(report.main, str(whole), out, "sequence.steps=[3]")
    assert "step 3 has no result of every method shown; accepted: 10, 11" in done.stdout
    done = run(report.main, str(whole), out, "sequence.trial=mustard/seed_0")
    assert "there is no recording of mustard, seed 0" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "dir is missing"),
        (["{}/nowhere"], "nowhere does not exist; accepted: a folder that runners.evaluate has"),
        (["{}/empty"], "has no experiment.json"),
        (["{}/text"], "experiment.json cannot be read"),
        (["{}/damaged"], "results.parquet cannot be read as a table"),
        (["{}/other"], "results.parquet lacks the column"),
        (["{}/letters"], "results.parquet cannot be read as a table (Failed to parse string"),
        (["{}/good", "sequence.trial=clamp"], "accepted: CONFIGURATION/SEED"),
        (["{}/good", "sequence.view=zz"], "view is 'zz'; accepted: xz, xy, yz"),
        (["{}/good", "sequence.steps=[]"], "steps is empty"),
        (["{}/good", "format=gif"], "format is 'gif'; accepted: png, svg, pdf"),
        (["{}/good", "colour=red"], "has no key 'colour'"),
        (["{}/good", "{}/empty"], "one argument too many; accepted: DIR KEY=VALUE"),
        (["{}/good", "out={}/good/experiment.json/x"], "accepted: an out=DIR that can be written"),
    ],
)
def test_a_mistake_is_one_line(tmp_path: Path, arguments: list[str], message: str) -> None:
    write_evaluation(tmp_path / "good", [row("can", 0, "chsel", 4, diversity=1.0)])
    write_evaluation(tmp_path / "damaged", [])
    (tmp_path / "damaged" / "results.parquet").write_bytes(b"PAR1 and no more")
    write_evaluation(tmp_path / "other", None)
    write_table(tmp_path / "other" / "results.parquet", [{"a": 1}], None)
    letters = [row("can", 0, "chsel", 4, diversity="much")]
    write_table(write_evaluation(tmp_path / "letters", None) / "results.parquet", letters, None)
    (tmp_path / "empty").mkdir()
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "experiment.json").write_text("{")
    done = run(report.main, *(argument.format(tmp_path) for argument in arguments))
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert json.loads((tmp_path / "good" / "experiment.json").read_text())["name"] == "made_up"
