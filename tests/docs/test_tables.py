"""What pages say is so: settings, presets, names of files and classes, times."""

import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
import trimesh
import yaml

from chsel.methods import OURS, preset_settings
from chsel.next_probe.decision_problem import STOPS
from chsel.plausible.plausible_settings import plausible_settings
from chsel.policies import OURS as POLICIES
from chsel.policies.policy import PolicySettings
from chsel.problem.points import Workspace
from chsel.problem.settings import in_preset, settings_mapping
from docs.results import make
from examples.own_robot import FINGER, FakeRobot
from runners.sessions.probing_settings import ProbingSettings
from tests.chsel.samples import REPOSITORY
from tests.runners.made_up_evaluations import row, session, write_evaluation, write_sessions

DOCS = REPOSITORY / "docs"
NEXT_PROBE, PRESETS = ((DOCS / name).read_text() for name in ("next_probe.md", "presets.md"))


def test_files_and_classes_that_the_page_of_the_architecture_names_exist():
    page = re.sub(r"^```.*?^```$", "", (DOCS / "architecture.md").read_text(), flags=re.M | re.S)
    words = set(re.findall(r"`([\w./-]+)`", page))
    folders = ("chsel", "conf", "replay", "runners", "tests")
    files = [file for folder in folders for file in (REPOSITORY / folder).rglob("*.*")]
    paths = "\n".join(f"/{file.relative_to(REPOSITORY).as_posix()}\n" for file in files)
    named = {word for word in words if word.endswith((".py", ".yaml", ".json"))}
    assert len(named) > 30
    assert {word for word in named if f"/{word}\n" not in paths} == set()
    text = "".join(file.read_text() for file in files if file.suffix == ".py")
    classes = {word for word in words if re.fullmatch(r"(?:[A-Z][a-z0-9]+){2,}", word)}
    assert len(classes) > 8
    assert {word for word in classes if not re.search(rf"\b{word}\b", text)} == set()


PAGES = [REPOSITORY / name for name in ("README.md", "CONTRIBUTING.md")]
PAGES += sorted(DOCS.glob("*.md"))
LINK = re.compile(r"\]\((?!https?:)(?P<path>[^)#\s]*)(?:#(?P<section>[^)\s]+))?\)")


def sections(page):
    """The names by which links name the sections of a page, as GitHub makes them."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).strip().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_named_sections_exist(page):
    text = page.read_text()
    dead = []
    for link in LINK.finditer(text):
        to = (page.parent / link["path"]).resolve() if link["path"] else page
        if not to.exists() or (link["section"] and link["section"] not in sections(to)):
            dead.append(link[0])
    for name, title in re.findall(r'(README|CONTRIBUTING|\w+\.md), "([^"]+)"', text):
        to = next(page for page in PAGES if page.name == f"{name.removesuffix('.md')}.md")
        dead += [title] if title.lower().replace(" ", "-") not in sections(to) else []
    assert dead == []


def cells(title):
    """The rows of the tables of a section of next_probe.md, by their first cell, a name."""
    section = re.split(rf"^## {title}\n", NEXT_PROBE, flags=re.MULTILINE)[1].partition("\n## ")[0]
    rows = re.findall(r"^\| `([\w.]+)` \| (.+) \|$", section, re.MULTILINE)
    return {name: text.split(" | ") for name, text in rows}


def flat(settings, path=""):
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{path}{name}.")
        else:
            yield path + name, value


def test_every_policy_setting_and_reason_to_stop_is_there():
    assert set(cells("Policies")) == set(POLICIES)
    assert set(cells("When to stop")) == set(STOPS) - {""}
    shown = {name: yaml.safe_load(row[0]) for name, row in cells("Settings").items()}
    settings = dict(flat(settings_mapping(PolicySettings())))
    assert shown == {name: settings[name] for name in shown}
    assert set(settings) - set(shown) == {"actions.reach"}  # a group of its own, named above


def test_the_program_of_the_next_probe_stops_where_the_object_is_found():
    mesh = trimesh.creation.box(extents=(0.1, 0.12, 0.2))
    truth = np.eye(4)
    truth[2, 3] = 0.1
    (program,) = re.findall(r"```python\n(.*?)```", NEXT_PROBE, re.DOTALL)
    names = {"mesh": mesh, "gripper_mesh": FINGER, "robot": FakeRobot(mesh, truth)}
    names["workspace"] = Workspace((-0.1, -0.1, 0.0), (0.1, 0.1, 0.2))
    exec(program, names)
    session = names["session"]
    assert session.stop in ("spread", "gain")
    centre = np.linalg.inv(session.answer.object_from_world[0])[:3, 3]
    np.testing.assert_allclose(centre, truth[:3, 3], atol=0.01)


ORDER = ("paper", "reference", "default")
PRINTED = re.compile(r"^\| [^|]+ \| `(?P<setting>[\w.]+)` \| (?P<value>[-\d.]+) \|$", re.MULTILINE)


def settings_of(name, preset):
    """The settings of a method, a session or a definition in a preset."""
    if name == "session":
        return in_preset(ProbingSettings(), preset)
    return (
        plausible_settings(preset, 0.001) if name == "definition" else preset_settings(name, preset)
    )


def differences(settings, path=""):
    """Dotted names and values of all fields in which settings of one class are not equal."""
    for field in fields(settings[0]):
        values = [getattr(one, field.name) for one in settings]
        name = path + field.name
        if all(is_dataclass(value) for value in values) and len(set(map(type, values))) == 1:
            yield from differences(values, f"{name}.")
        elif any(value != values[0] for value in values):
            yield name, values


def on_the_page():
    """Cells of paper, reference and default by method and setting."""
    found, of = {}, []
    for block in PRESETS.split("\n\n"):
        of = re.findall(r"`(\w+)`", block) if block.startswith("Of ") else of
        for line in block.splitlines()[2:] if block.startswith("| setting | paper |") else ():
            setting, *cells = (cell.strip("|` ") for cell in line.split(" | "))
            assert len(cells) == 4, line
            assert cells[3], f"{setting} has no reason"
            assert not {(name, setting) for name in of} & set(found), line
            found |= {(name, setting): cells[:3] for name in of}
    return found


def same(cell, value):
    """Whether a cell, in YAML, shows a value; numbers to four digits."""
    if is_dataclass(value):
        return cell == type(value).__name__
    shown = yaml.safe_load(cell)
    if isinstance(shown, str) and re.fullmatch(r"[\d.]+e-?\d+", shown):
        shown = float(shown)
    if isinstance(value, float | tuple) and not isinstance(shown, str | None):
        return bool(np.allclose(shown, value, rtol=1e-3, atol=0.0))
    return type(shown) is type(value) and shown == value


@pytest.mark.parametrize("name", [*OURS, "session", "definition"])
def test_every_setting_in_which_presets_differ_is_on_the_page(name):
    page = {setting: cells for (of, setting), cells in on_the_page().items() if of == name}
    code = dict(differences([settings_of(name, one) for one in ORDER]))
    assert sorted(page) == sorted(code)
    for setting, values in code.items():
        for preset, cell, value in zip(ORDER, page[setting], values, strict=True):
            assert same(cell, value), f"{name}, {setting}, {preset}: {cell} for {value}"


def test_printed_numbers_are_those_of_all_presets():
    printed = {row["setting"]: float(row["value"]) for row in PRINTED.finditer(PRESETS)}
    assert len(printed) == 7
    for preset in ORDER:
        settings = dict(flat(settings_mapping(settings_of("chsel", preset))))
        assert {name: settings[name] for name in printed} == pytest.approx(printed)


def test_pages_are_written_from_the_tables_as_they_are():
    assert make.write(checked=True) == []


def test_objects_that_moved_are_judged_from_six_touches_on(tmp_path, monkeypatch):
    hits = [True, True, False, True, True, True, True, True]  # the sixth is the seventh probe
    columns = {"hit": hits, "best_error": [0.5] * 6 + [0.004, 0.012]}
    rows = session(
        "can",
        40,
        policy="random",
        errors=[90.0] * 6 + [8.0, 30.0],
        verdict=["determined"] * 8,
        **columns,
    )
    columns["best_error"] = [0.5] * 6 + [0.006, 0.002]
    rows += session(
        "can", 41, policy="random", errors=[90.0] * 6 + [2.0, 4.0], verdict=["wide"] * 8, **columns
    )
    write_sessions(tmp_path / "made_up", rows, budgets={"random": 8})
    monkeypatch.setattr(make, "KEPT", tmp_path)
    make.evaluation.cache_clear()
    found = [make.moved("made_up", column) for column in ("best_error", "error")]
    shown = [*found, make.wrong("made_up"), make.seeds("made_up")]
    make.evaluation.cache_clear()
    assert shown == ["5", "6", "1 of 2", "40..41"]


def test_seeds_of_a_method_are_those_that_it_ran_on(tmp_path, monkeypatch):
    seeds = {"icp": (3, 5, 4), "cvo": (4,)}
    rows = [row("can", seed, method=name, step=0) for name, own in seeds.items() for seed in own]
    write_evaluation(tmp_path / "made_up", rows, methods={"icp": {}, "cvo": {}})
    monkeypatch.setattr(make, "KEPT", tmp_path)
    make.evaluation.cache_clear()
    shown = [make.seeds("made_up", name) for name in seeds]
    make.evaluation.cache_clear()
    assert shown == ["3..5", "4"]
