"""The help of a command: its choices, and its settings as they stand with the choices made.

Hydra would list all groups of options for it, which takes seconds, and use none of them here.
"""

from __future__ import annotations

import sys
from string import Template

HELP = ("--help", "-h")


def asked_for(words: list[str]) -> bool:
    """Whether the arguments ask for help, and bring no configuration folder of their own."""
    return any(word in HELP for word in words) and not any(
        word.startswith(("--config", "-c", "--hydra", "--package", "-p")) for word in words
    )


def help_text(config_name: str, words: list[str]) -> str:
    """The help of the command with conf/<config_name>.yaml, with the settings among its words."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf, open_dict

    from runners.arguments import is_setting
    from runners.choices import CONF

    settings = [word for word in words if is_setting(word)]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose(config_name, settings, return_hydra_config=True)
    template = Template(config.hydra.help.template)
    with open_dict(config):
        del config["hydra"]
    return template.safe_substitute(CONFIG=OmegaConf.to_yaml(config))


def help_at_once() -> None:
    """Print the help of `python -m runners.NAME ... --help`, and exit, before NAME is imported.

    Any mistake among the words is left to the command, which says what is accepted.
    """
    words = sys.argv[1:]
    if not asked_for(words):
        return
    given = sys.orig_argv
    command = given[given.index("-m") + 1] if "-m" in given else ""
    package, _, name = command.partition(".")
    from replay.console import print_page
    from runners.choices import CONF, prepared

    if package != "runners" or not (CONF / f"{name}.yaml").is_file():
        return
    try:
        text = help_text(name, prepared(name, words))
    except Exception:
        return
    print_page(text)
    sys.exit(0)
