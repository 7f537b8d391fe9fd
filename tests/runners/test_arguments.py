"""Files whose names Hydra would read as its own grammar, as they are typed in a shell."""

from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from chsel.errors import SettingError
from runners import evaluate, real
from runners.command.arguments import hydra_arguments, quoted
from tests.runners.in_process import run

NAMES = ("a,b [1].obj", "it's 'so'", "Prüfkörper", "a\\'b", "a#b")


def value_of(word):
    """What a setting becomes in Hydra's configuration."""
    override = OverridesParser.create().parse_override(word)
    assert not override.is_sweep_override()
    config = OmegaConf.create({"seed": 7, "path": override.value()})
    return OmegaConf.to_container(config, resolve=True)["path"]


def test_a_path_reaches_the_configuration_as_typed():
    for name in NAMES:
        for key in ("object.path", "++session.hand.urdf", "+outside.x"):
            (word,) = hydra_arguments("probe", [f"{key}={name}"])
            assert word.startswith(f"{key}=")
            assert value_of(word) == name
        assert value_of(f"x={quoted(name)}") == name


def test_the_home_folder_is_put_in_and_what_hydra_reads_stays(monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    words = ["object.path=~/a,b [1].obj", "assets.dir=~", "session.rig.hand.urdf=~/a b.urdf"]
    assert [value_of(word) for word in hydra_arguments("probe", words)] == [
        "/home/somebody/a,b [1].obj",
        "/home/somebody",
        "/home/somebody/a b.urdf",
    ]
    unchanged = ['session.path="a,b"', "out=null", "out=", "methods=[chsel,icp]", "logs=${seed}"]
    unchanged += ["settings={icp: {iterations: 3}}", "~object.path", "-m", "seed=1,2"]
    assert hydra_arguments("probe", unchanged) == unchanged
    assert hydra_arguments("probe", ["seed=1,2"]) == ["seed='1,2'"], "no sweep without -m"


def test_words_without_a_key_get_that_of_the_command(tmp_path, monkeypatch):
    assert hydra_arguments("report", ["a b", "out=x", "--traceback"]) == ["out=x", "dir='a b'"]
    assert hydra_arguments("align", ["-cd", "x", "f.mcap"]) == ["-cd", "x", "file='f.mcap'"]
    assert hydra_arguments("plausible", ["f", "3", "5..9"]) == ["file='f'", "steps='3,5..9'"]
    with pytest.raises(SettingError, match="'g' is one argument too many; accepted: FILE KEY"):
        hydra_arguments("align", ["f", "g"])
    assert hydra_arguments("probe", ["f", "-m"]) == ["f", "-m"]  # Hydra's to refuse
    monkeypatch.chdir(tmp_path)
    Path("seed=1").touch()
    assert hydra_arguments("plausible", ["seed=1"]) == ["file='seed=1'"]


def test_any_key_of_an_open_group_is_taken():
    words = ["settings.icp.iterations=3", "outside.mine=x [1]", "seeds=0"]
    assert hydra_arguments("evaluate", words) == [
        "++settings.icp.iterations=3",
        "++outside.mine='x [1]'",
        "seeds=0",
    ]


@pytest.mark.parametrize("command", [evaluate.main, real.main])
@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("settings.chsel.archive.bins=x", "settings.chsel.archive.bins is 'x'; accepted: "),
        ("settings={chsl: {archive: {bins: 20}}}", "settings of a method is 'chsl'; accepted: "),
        ("settings=null", "settings is None; accepted: a group of settings by method"),
    ],
)
def test_settings_of_methods_are_taken_dotted_and_as_a_group(command, word, message, tmp_path):
    (tmp_path / "real").mkdir()
    folders = [f"data={tmp_path}"] if command is real.main else ["session=kinematic"]
    done = run(command, word, *folders, f"out={tmp_path / 'out'}")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith(f"error: {message}")
