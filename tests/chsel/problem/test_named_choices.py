"""Choices of installed packages: found by their entry points, and refused on one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from chsel.errors import SettingError
from chsel.policies.policies import _lacks
from chsel.policies.policy import ConfiguredPolicy, PolicySettings
from chsel.problem.settings import NamedChoices

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
    settings = {settings}
    def decide(self, problem):
        return None

class Unready:
    def __init__(self):
        raise RuntimeError("no\\nlicence")
"""
Install = Callable[..., NamedChoices]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Installs packages that each offer a policy, as pip does; the choices that there are then."""

    def done(*lines: str, settings: str = "{}") -> NamedChoices:
        module = f"offered_by_{tmp_path.name}"  # imported once in a process
        for number, line in enumerate(lines):
            about = tmp_path / f"mine{number}-1.dist-info"
            about.mkdir()
            (about / "METADATA").write_text(f"Name: mine{number}\nVersion: 1\n")
            (about / "entry_points.txt").write_text(
                f"[chsel.policies]\n{line.replace('mine:', module + ':')}\n"
            )
        (tmp_path / f"{module}.py").write_text(POLICY.replace("{settings}", settings))
        monkeypatch.syspath_prepend(str(tmp_path))
        ours = {"grid": (ConfiguredPolicy, PolicySettings())}
        return NamedChoices("policy", "chsel.policies", "docs/page.md", ours, _lacks)

    return done


def test_a_choice_of_a_package_is_built_as_ours_are(install: Install) -> None:
    choices = install("mine = mine:Mine")
    assert choices.names == ("grid", "mine")
    make, default = choices.entry("mine")
    assert (make.__name__, default.weight) == ("Mine", 2.0)
    built = choices.build("mine", {"weight": 3.0, "stop": {"spread": 0.1}})
    assert (built.settings.weight, built.settings.stop.spread) == (3.0, 0.1)
    assert choices.build("grid").settings == PolicySettings()


@pytest.mark.parametrize(
    ("lines", "settings", "message"),
    [
        (["mine = mine:Nothing"], "{}", "policy mine of package mine0 cannot be loaded: Attribute"),
        (["mine = mine:Unready"], "{}", "cannot be loaded: RuntimeError: no licence; accepted: a"),
        (["mine = nowhere:Mine"], "{}", "cannot be loaded: ModuleNotFoundError"),
        (["mine = mine:Unlike"], "{}", "has settings {}; accepted: a frozen dataclass"),
        (["mine = mine:Unlike"], "__import__('chsel').CostSettings()", "one derived from Policy"),
        (["mine = mine:Plain"], "{}", "has no `decide`; accepted: decide(problem); see docs/page"),
        (["mine = mine:Mine"] * 2, "{}", "policy mine is of mine0 and mine1; accepted: one of"),
    ],
)
def test_what_cannot_be_taken_is_one_line(
    install: Install, lines: list[str], settings: str, message: str
) -> None:
    choices = install(*lines, settings=settings)
    with pytest.raises(SettingError) as caught:
        choices.entry("mine")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert choices.build("grid")  # others go on as ever


def test_a_name_of_ours_is_not_taken_from_us(install: Install) -> None:
    choices = install("grid = mine:Mine")
    assert choices.names == ("grid",)
    with pytest.raises(SettingError, match="policy grid is of package mine0, too; accepted: one"):
        choices.build("grid")
