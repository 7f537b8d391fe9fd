"""docs/presets.md: its tables have every setting in which presets differ, with its values."""

import re
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
import yaml

from chsel.methods import OURS, preset_settings
from chsel.plausible.plausible_settings import plausible_settings
from chsel.problem.settings import in_preset
from runners.sessions.probing_settings import ProbingSettings
from tests.docs.page import DOCS

ORDER = ("paper", "reference", "default")
PAGE = (DOCS / "presets.md").read_text()
TABLE = re.compile(
    r"Of (?P<of>[^.:]+):\n\n\| setting \| paper \|.*\n\|[-|]+\|\n(?P<rows>(?:\|.*\n)+)"
)
PRINTED = re.compile(r"^\| [^|]+ \| `(?P<setting>[\w.]+)` \| (?P<value>[-\d.]+) \|$", re.MULTILINE)


def settings_of(name):
    """The settings of a method, a session or a definition in each preset."""
    if name == "session":
        return [in_preset(ProbingSettings(), preset) for preset in ORDER]
    if name == "definition":
        return [plausible_settings(preset, 0.001) for preset in ORDER]
    return [preset_settings(name, preset) for preset in ORDER]


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
    found = {}
    for table in TABLE.finditer(PAGE):
        for row in table["rows"].splitlines():
            setting, *cells = (cell.strip() for cell in row.strip("|").split(" | "))
            assert len(cells) == 4, row
            assert cells[3].strip(" |"), f"{setting} has no reason"
            for name in re.findall(r"`(\w+)`", table["of"]):
                assert (name, setting.strip("` ")) not in found, row
                found[name, setting.strip("` ")] = cells[:3]
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
    code = dict(differences(settings_of(name)))
    assert sorted(page) == sorted(code)
    for setting, values in code.items():
        for preset, cell, value in zip(ORDER, page[setting], values, strict=True):
            assert same(cell, value), f"{name}, {setting}, {preset}: {cell} for {value}"


def test_printed_numbers_are_those_of_all_presets():
    printed = {row["setting"]: float(row["value"]) for row in PRINTED.finditer(PAGE)}
    assert len(printed) == 7
    for setting, value in printed.items():
        for settings in settings_of("chsel"):
            for name in setting.split("."):
                settings = getattr(settings, name)
            assert settings == pytest.approx(value), setting


def test_the_tables_that_are_compared_are_all_of_the_page():
    assert len(list(TABLE.finditer(PAGE))) == PAGE.count("| setting | paper |")
