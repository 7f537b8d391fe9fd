"""What a command answers before it is imported, which takes seconds: help, version, completion."""

from __future__ import annotations

import sys
from string import Template

from replay.console import print_page
from replay.startup import package_version

HELP = ("--help", "-h")
VERSION = "--version"
_COMPLETION = ("-sc", "--shell-completion")


def answer_at_once(command: str, *, installed: bool) -> None:
    """Print the help or the version of a command, or what a shell completes, if asked, and exit.

    command: its module in `runners`. installed: it was started by its console script, which is
    what shells complete. Any mistake in the arguments is left to the command itself.
    """
    words = sys.argv[1:]
    if VERSION in words:
        print_page(f"chsel-replay {package_version()}")
        sys.exit(0)
    completes = installed and words[:1] and words[0] in _COMPLETION
    if not (completes or asks_for_help(words)):
        return
    from runners.command.choices import CONF, prepared

    if not (CONF / f"{command}.yaml").is_file():
        return
    if completes:
        import hydra

        prepared(command, [])
        hydra.main(version_base="1.3", config_path=str(CONF), config_name=command)(_nothing)()
        sys.exit(0)
    try:
        text = help_text(command, prepared(command, words))
    except Exception:
        return
    print_page(text)
    sys.exit(0)


def asks_for_help(words: list[str]) -> bool:
    """Whether the arguments ask for help, and bring no configuration folder of their own."""
    return any(word in HELP for word in words) and not any(
        word.startswith(("--config", "-c", "--hydra", "--package", "-p")) for word in words
    )


def help_text(config_name: str, words: list[str]) -> str:
    """The help of the command with conf/<config_name>.yaml, with the settings among its words.

    Hydra's own help would list all groups of options, which takes seconds and is not shown here.
    """
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf, open_dict

    from runners.command.arguments import is_setting
    from runners.command.choices import CONF

    settings = [word for word in words if is_setting(word)]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose(config_name, settings, return_hydra_config=True)
    template = Template(config.hydra.help.template)
    with open_dict(config):
        del config["hydra"]
    return template.safe_substitute(CONFIG=OmegaConf.to_yaml(config))


def _nothing(_: object) -> None:
    """Stands for a command that Hydra does not run."""
