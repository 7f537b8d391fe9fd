"""The shell around every command: Hydra, one-line errors, exit statuses."""

from __future__ import annotations

import difflib
import multiprocessing
import os
import re
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from chsel.errors import ChselError
from replay.console import print_error, print_page, print_warning
from replay.startup import ready
from runners.command_help import asked_for, help_text
from runners.path_values import literal_paths
from runners.presets import store_presets

CONF = Path(__file__).resolve().parents[1] / "conf"
TRACEBACK = "--traceback"
_NESTED_GROUPS = ("session/rig",)  # choices of their own, not options of the group around them
_OPEN_GROUPS = {"evaluate": ("settings.", "outside.")}  # of a command, groups that have any key
_USER_ERRORS = (ChselError, HydraException, OmegaConfBaseException, OSError)


def command(config_name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Make `main(config)` a program configured by conf/<config_name>.yaml.

    A user's mistake is one line on stderr and exit status 2; Ctrl-C is exit status 130.
    `--traceback` (or HYDRA_FULL_ERROR=1) shows where an error came from.
    """

    def decorate(main: Callable[[DictConfig], None]) -> Callable[[], None]:
        def program() -> None:
            ready()
            show_traceback = os.environ.get("HYDRA_FULL_ERROR") == "1" or TRACEBACK in sys.argv
            os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra hands errors on instead of printing them
            warnings.showwarning = print_warning
            sys.argv[1:] = prepared(config_name, sys.argv[1:])
            if asked_for(sys.argv[1:]):
                words = sys.argv[1:]
                show_help = partial(_print_help, config_name, words)
                _exit_on_error(show_help, config_name, show_traceback)
                return

            job = _Job(_importable(main), config_name, show_traceback)
            run = hydra.main(version_base="1.3", config_path=str(CONF), config_name=config_name)
            _exit_on_error(run(job), config_name, show_traceback)

        program.main = main  # type: ignore[attr-defined]
        return program

    return decorate


def prepared(config_name: str, words: list[str]) -> list[str]:
    """The arguments of a command as Hydra takes them, which has all presets to choose from."""
    store_presets()
    _register_resolvers()
    words = [word for word in words if word != TRACEBACK]
    open_groups = _OPEN_GROUPS.get(config_name, ())
    words = [f"++{word}" if word.startswith(open_groups) else word for word in words]
    return literal_paths(words)


def _print_help(config_name: str, words: list[str]) -> None:
    print_page(help_text(config_name, words))


@dataclass(frozen=True)
class _Job:
    """One run of a program, named by its module: what launchers send to other processes."""

    module: str
    config_name: str
    show_traceback: bool
    process: int = field(default_factory=os.getpid)

    def __call__(self, config: DictConfig) -> None:
        main = import_module(self.module).main.main
        if os.getpid() == self.process:
            # Caught here as well: Hydra would print a line of its own about a failed job.
            _exit_on_error(lambda: main(config), self.config_name, self.show_traceback)
        else:
            # Joblib's name for how it started this process says nothing to those started from it.
            multiprocessing.set_start_method("spawn", force=True)
            main(config)  # what it raises is told by the process that waits for it


def _importable(main: Callable[[DictConfig], None]) -> str:
    """The name of the module of `main`, by which another process imports it as well."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return spec.name if main.__module__ == "__main__" and spec else main.__module__


def plain(config: DictConfig) -> dict[str, Any]:
    """The resolved configuration as plain dictionaries, lists and scalars."""
    container = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


def choices(group: str) -> list[str]:
    """The options of a group, those of conf/ first, of nested folders with their path."""
    folder = CONF / group
    files = sorted(folder.rglob("*.yaml"), key=lambda file: (len(file.parts), file))
    nested = [CONF / name for name in _NESTED_GROUPS if name != group]
    files = [file for file in files if not any(file.is_relative_to(other) for other in nested)]
    names = [str(file.relative_to(folder).with_suffix("")) for file in files]
    stored = ConfigStore.instance().repo.get(group, {})  # such as methods of installed packages
    more = sorted(Path(name).stem for name in stored if name.endswith(".yaml"))
    return list(dict.fromkeys([*names, *more]))


def _exit_on_error(run: Callable[[], None], config_name: str, show_traceback: bool) -> None:
    try:
        run()
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # whoever read the output has had enough of it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except _USER_ERRORS as error:
        if show_traceback:
            raise
        print_error(_message(error, config_name))
        sys.exit(2)


def _message(error: Exception, config_name: str) -> str:
    """One line: what was wrong, and what is accepted."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, choice = _group_and_choice(str(error.missing_cfg_file))
        if (CONF / group).is_dir():
            return _not_accepted(group, f"has no option {choice!r}", choice, choices(group))
    unknown = re.match(r"Could not override '([^']+)'", str(error))
    if unknown and isinstance(error, ConfigCompositionException):
        return _unknown_key(unknown.group(1), config_name)
    text = str(error)
    if isinstance(error, OverrideParseException):
        text = f"{error.override!r} is no setting ({text}"
        text = text.split("\n")[0] + "); accepted: KEY=VALUE"
    if isinstance(error, HydraException) and error.__cause__ is not None:
        text = f"{text}: {error.__cause__}"
    text = re.split(r"\nConfig search path:|\nSee https?://|\n\s*full_key:", text)[0]
    return re.sub(r"\s*\n\s*", " ", text).strip()


def _group_and_choice(name: str) -> tuple[str, str]:
    """The group that an option GROUP/CHOICE is of; both may have slashes."""
    for group in _NESTED_GROUPS:
        if name.startswith(f"{group}/"):
            return group, name.removeprefix(f"{group}/")
    group, _, choice = name.partition("/")
    return group, choice


def _unknown_key(key: str, config_name: str) -> str:
    """Where the path of an override leaves the configuration, and what stands there."""
    groups = [argument for argument in sys.argv[1:] if argument.split("=")[0] in _groups()]
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        node: Any = hydra.compose(config_name, groups)
    parts = key.split("@")[0].split(".")
    for depth, part in enumerate(parts):
        where = ".".join(parts[:depth]) or config_name
        if isinstance(node, ListConfig) and part.isdecimal() and int(part) < len(node):
            node = node[int(part)]
            continue
        if not isinstance(node, DictConfig) or part not in node:
            if any(part.isdecimal() for part in parts[:depth]):
                return f"{where} does not give {part!r}; accepted: +{key}=VALUE to add it"
            names = [str(name) for name in node] if isinstance(node, DictConfig) else []
            return _not_accepted(where, f"has no key {part!r}", part, names)
        node = OmegaConf.select(node, part)
    return f"{key} is not a key"


def _not_accepted(where: str, what: str, value: str, accepted: list[str]) -> str:
    close = difflib.get_close_matches(value, accepted, n=1, cutoff=0.5)
    hint = f"; did you mean {close[0]}?" if close else ";"
    return f"{where} {what}{hint} accepted: {', '.join(accepted) or 'no key below it'}"


def _groups() -> list[str]:
    return sorted(
        folder.name for folder in CONF.iterdir() if folder.is_dir() and choices(folder.name)
    )


def _register_resolvers() -> None:
    """What the help texts in conf/ use: ${options:object,session} lists the options of groups."""

    def options(*groups: str) -> str:
        return "\n".join(f"  {group}={'|'.join(choices(group))}" for group in groups)

    OmegaConf.register_new_resolver("options", options, replace=True)
