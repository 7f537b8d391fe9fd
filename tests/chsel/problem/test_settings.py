"""Settings from mappings and back, and choices of installed packages by their entry points."""

import re
from dataclasses import dataclass
from typing import Annotated

import pytest

from chsel.errors import SettingError
from chsel.methods import METHODS, build_method, preset_settings
from chsel.methods.chsel import ChselSettings
from chsel.policies.policies import _lacks
from chsel.policies.policy import ConfiguredPolicy, PolicySettings
from chsel.problem.settings import (
    PRESETS,
    CheckedSettings,
    NamedChoices,
    at_most,
    between,
    build_settings,
    not_negative,
    one_of,
    positive,
    settings_mapping,
)


@pytest.mark.parametrize("method", METHODS)
def test_every_preset_survives_the_way_through_a_mapping(method):
    for preset in PRESETS:
        settings = preset_settings(method, preset)
        assert build_method(method, settings_mapping(settings)).settings == settings


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"cots": {}}, r"method.cots does not exist; did you mean cost\? accepted: archive, cost"),
        ({"cost": {"free_scale": "x"}}, r"method.cost.free_scale is 'x'; accepted: a number"),
        ({"cost": {"lookup": None}}, r"method.cost.lookup is None; accepted: a text"),
        ({"plane": {"axis": [0, 1], "offset": 0}}, r"method.plane.axis has 2 entries; accepted: 3"),
        ({"archive": {"bins": 0}}, r"method.archive: bins is 0"),
    ],
)
def test_wrong_settings_name_the_key_and_what_is_accepted(mapping, message):
    with pytest.raises(SettingError, match=message):
        build_settings(ChselSettings, mapping, where="method")


@dataclass(frozen=True)
class Checked(CheckedSettings):
    """A setting with each kind of check, and a relation between two."""

    rate: Annotated[float, positive] = 1.0
    count: Annotated[int, not_negative, at_most(1_000)] = 0
    length: Annotated[float, between(1e-3, 10.0)] = 1.0
    name: Annotated[str, one_of("a", "b")] = "a"
    limit: Annotated[float | None, positive, at_most(5.0)] = None
    side: Annotated[float, positive] | None = None
    free: float = -1.0

    def __post_init__(self):
        super().__post_init__()
        if self.limit is not None and self.rate > self.limit:
            raise SettingError(f"rate is {self.rate}; accepted: at most limit")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"rate": float("nan")}, "rate is nan; accepted: a finite number above 0"),
        ({"count": -1}, "count is -1; accepted: a finite number of at least 0"),
        ({"count": 1_001}, "count is 1001; accepted: at most 1_000"),
        ({"length": 20.0}, r"length is 20.0; accepted: 0.001 to 10 (m)"),
        ({"limit": 6.0}, "limit is 6.0; accepted: at most 5.0"),
        ({"side": 0.0}, "side is 0.0; accepted: a finite number above 0"),
        ({"limit": 0.5}, "rate is 1.0; accepted: at most limit"),
        ({"limit": 0.5, "name": "c"}, "name is 'c'; accepted: a, b"),
    ],
)
def test_settings_accept_what_their_annotations_and_their_class_accept(values, message):
    with pytest.raises(SettingError, match=f"^{re.escape(message)}$"):
        Checked(**values)


def test_values_at_the_limits_and_none_pass_where_the_type_has_it():
    limits = Checked(count=1_000, length=10.0, limit=5.0, side=0.1)
    assert build_settings(Checked, settings_mapping(limits), where="settings") == limits
    assert build_settings(Checked, {"limit": None, "rate": 2}, where="settings") == Checked(
        rate=2.0
    )
    with pytest.raises(SettingError, match=r"^settings.count is None; accepted: an integer$"):
        build_settings(Checked, {"count": None}, where="settings")


POLICY = """
from dataclasses import dataclass
from chsel.policies.policy import ConfiguredPolicy, PolicySettings

@dataclass(frozen=True)
class MineSettings(PolicySettings):
    weight: float = 2.0

class Mine(ConfiguredPolicy):
    settings_class = MineSettings

class Plain:
    settings = MineSettings()

class Unlike:
    settings = {}

class Unready:
    def __init__(self):
        raise RuntimeError("no\\nlicence")
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Installs packages that each offer a policy, as pip does; the choices that there are then."""

    def done(*lines):
        module = f"offered_by_{tmp_path.name}"  # imported once in a process
        for number, line in enumerate(lines):
            about = tmp_path / f"mine{number}-1.dist-info"
            about.mkdir()
            (about / "METADATA").write_text(f"Name: mine{number}\nVersion: 1\n")
            entry = line.replace("mine:", f"{module}:")
            (about / "entry_points.txt").write_text(f"[chsel.policies]\n{entry}\n")
        (tmp_path / f"{module}.py").write_text(POLICY)
        monkeypatch.syspath_prepend(str(tmp_path))
        ours = {"grid": (ConfiguredPolicy, PolicySettings())}
        return NamedChoices(
            "policy", "chsel.policies", page="docs/page.md", ours=ours, lacks=_lacks
        )

    return done


def test_a_choice_of_a_package_is_built_as_ours_are(install):
    choices = install("mine = mine:Mine")
    assert choices.names == ("grid", "mine")
    make, default = choices.entry("mine")
    assert (make.__name__, default.weight) == ("Mine", 2.0)
    built = choices.build("mine", {"weight": 3.0, "stop": {"spread": 0.1}})
    assert (built.settings.weight, built.settings.stop.spread) == (3.0, 0.1)
    assert choices.build("grid").settings == PolicySettings()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["mine = mine:Unready"], "cannot be loaded: RuntimeError: no licence; accepted: a"),
        (["mine = nowhere:Mine"], "policy mine of package mine0 cannot be loaded: ModuleNotFound"),
        (["mine = mine:Unlike"], "has settings {}; accepted: a frozen dataclass"),
        (["mine = mine:Plain"], "has no `decide`; accepted: decide(problem); see docs/page"),
        (["mine = mine:Mine"] * 2, "policy mine is of mine0 and mine1; accepted: one of"),
    ],
)
def test_what_cannot_be_taken_is_one_line(install, lines, message):
    choices = install(*lines)
    with pytest.raises(SettingError) as caught:
        choices.entry("mine")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert choices.build("grid")  # others go on as ever


def test_a_name_of_ours_is_not_taken_from_us(install):
    choices = install("grid = mine:Mine")
    assert choices.names == ("grid",)
    with pytest.raises(SettingError, match="policy grid is of package mine0, too; accepted: one"):
        choices.build("grid")
