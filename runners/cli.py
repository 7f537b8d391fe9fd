"""The shell around every command: Hydra, one-line errors, exit statuses."""

from __future__ import annotations

import difflib
import multiprocessing
import os
import sys
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from typing import Any

import hydra
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from chsel.errors import ChselError
from replay.console import print_error, print_page, print_warning
from replay.startup import ready
from runners.arguments import TRACEBACK
from runners.choices import CONF, NESTED_GROUPS, choices, prepared
from runners.command_help import asked_for, help_text

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
            job = _Job(_importable(main), config_name, show_traceback)
            _exit_on_error(partial(_start, job), config_name, show_traceback)

        program.main = main  # type: ignore[attr-defined]
        return program

    return decorate


def _start(job: _Job) -> None:
    """Print the help of a command, or have Hydra run it once or, as a sweep, many times."""
    words = prepared(job.config_name, sys.argv[1:])
    if asked_for(words):
        print_page(help_text(job.config_name, words))
        return
    sys.argv[1:] = words  # where hydra.main takes them from; no other call of it runs sweeps
    hydra.main(version_base="1.3", config_path=str(CONF), config_name=job.config_name)(job)()


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


def _message(error: BaseException, config_name: str) -> str:
    """One line: what was wrong, and what is accepted."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return _missing(str(error.missing_cfg_file))
    if isinstance(error, OverrideParseException):
        what = error.message.splitlines()[0]
        return f"{error.override!r} is not a setting ({what}); accepted: KEY=VALUE"
    cause = error.__cause__ if isinstance(error, HydraException) else None
    if isinstance(cause, ConfigKeyError | ConfigAttributeError):
        return _unknown_key(cause, config_name)
    if isinstance(error, ConfigCompositionException) and not cause:
        unknown = _unknown_group(config_name)
        if unknown is not None:
            return unknown
    lines = str(error).splitlines()
    if isinstance(error, OmegaConfBaseException):
        lines = lines[:1]  # the others name its own types
    text = " ".join(" ".join(lines).split())
    if isinstance(cause, OmegaConfBaseException):
        text = ": ".join(part for part in (text, _message(cause, config_name)) if part)
    return text


def _missing(name: str) -> str:
    """A file that is not there: GROUP/CHOICE, or the configuration that --config-name names."""
    group, choice = _group_and_choice(name)
    if accepted := choices(group):
        return _not_accepted(group, f"has no option {choice!r}", choice, accepted)
    return f"configuration {name!r} does not exist; accepted: a file of {CONF} or --config-dir"


def _unknown_group(config_name: str) -> str | None:
    """What is wrong with an argument that chooses an option of a group of another command."""
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        config = hydra.compose(config_name)
    groups = [word.partition("=")[0] for word in sys.argv[1:]]
    unknown = (key for key in groups if choices(key) and key.split("/")[0] not in config)
    return next((_no_key(config_name, key, config) for key in unknown), None)


def _group_and_choice(name: str) -> tuple[str, str]:
    """The group that an option GROUP/CHOICE is of; both may have slashes."""
    for group in NESTED_GROUPS:
        if name.startswith(f"{group}/"):
            return group, name.removeprefix(f"{group}/")
    group, _, choice = name.partition("/")
    return group, choice


def _unknown_key(error: ConfigKeyError | ConfigAttributeError, config_name: str) -> str:
    """Where the path of an override leaves the configuration, and what stands there."""
    key = str(error.full_key).replace("[", ".").replace("]", "")
    where, _, name = key.rpartition(".")
    if any(part.isdecimal() for part in where.split(".")):  # an entry of a list lacks defaults
        return f"{where} does not give {name!r}; accepted: +{key}=VALUE to add it"
    return _no_key(where or config_name, name, error.parent_node or {})


def _no_key(where: str, name: str, node: Iterable[Any]) -> str:
    accepted = [str(known) for known in node if known != "hydra"]
    return _not_accepted(where, f"has no key {name!r}", name, accepted)


def _not_accepted(where: str, what: str, value: str, accepted: list[str]) -> str:
    close = difflib.get_close_matches(value, accepted, n=1, cutoff=0.5)
    hint = f"; did you mean {close[0]}?" if close else ";"
    return f"{where} {what}{hint} accepted: {', '.join(accepted) or 'no key below it'}"
