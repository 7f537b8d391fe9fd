"""A command: Hydra composes its configuration, a mistake is one line, and there is a status."""

from __future__ import annotations

import argparse
import difflib
import multiprocessing
import os
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from string import Template
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from chsel.errors import ChselError, SettingError
from replay.console import print_error, print_page, print_warning
from replay.startup import package_version, ready
from runners.command.arguments import TRACEBACK, hydra_arguments
from runners.command.choices import CONF

_USER_ERRORS = (ChselError, HydraException, OmegaConfBaseException, OSError)


def command(config_name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Make `main(config)` a program configured by conf/<config_name>.yaml.

    A user's mistake is one line on stderr and exit status 2; Ctrl-C is exit status 130.
    `--traceback` (or HYDRA_FULL_ERROR=1) shows where an error came from.
    """

    def decorate(main: Callable[[DictConfig], None]) -> Callable[[], None]:
        def program() -> None:
            ready()
            if "--version" in sys.argv:
                print_page(f"chsel-replay {package_version()}")
                return
            show_traceback = os.environ.get("HYDRA_FULL_ERROR") == "1" or TRACEBACK in sys.argv
            os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra hands errors on instead of printing them
            warnings.showwarning = print_warning
            job = _Job(_importable(main), config_name, show_traceback=show_traceback)
            _exit_on_error(job.start, config_name, show_traceback=show_traceback)

        program.main = main  # type: ignore[attr-defined]
        return program

    return decorate


@dataclass(frozen=True)
class _Job:
    """One run of a program, named by its module: what launchers send to other processes."""

    module: str
    config_name: str
    show_traceback: bool
    process: int = field(default_factory=os.getpid)

    def start(self) -> None:
        """Have Hydra run it once or, as a sweep, many times, or print its help."""
        words = hydra_arguments(self.config_name, sys.argv[1:])
        if {"--help", "-h"}.intersection(words):
            print_page(_help(self.config_name, words))
            return
        sys.argv[1:] = words  # where hydra.main takes them from
        if sys.version_info >= (3, 14):
            # argparse checks every help text since, and refuses that of Hydra, which is lazy.
            argparse.ArgumentParser._check_help = lambda self, action: None  # type: ignore
        hydra.main(version_base="1.3", config_path=str(CONF), config_name=self.config_name)(self)()

    def __call__(self, config: DictConfig) -> None:
        main = import_module(self.module).main.main
        if os.getpid() == self.process:
            # Caught here as well: Hydra would print a line of its own about a failed job.
            _exit_on_error(
                lambda: main(config), self.config_name, show_traceback=self.show_traceback
            )
        else:
            # Joblib's name for how it started this process says nothing to those started from it.
            multiprocessing.set_start_method("spawn", force=True)
            main(config)  # the process that waits for it reports what it raises


def _help(config_name: str, words: list[str]) -> str:
    """Return the help of a command, with the settings among its words.

    Hydra's own would list all options of all groups, those of presets included, for 20 seconds.
    """
    settings = [word for word in words if not word.startswith("-")]
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        config = hydra.compose(config_name, settings, return_hydra_config=True)
    template = Template(config.hydra.help.template)
    with open_dict(config):
        del config["hydra"]
    return template.safe_substitute(CONFIG=OmegaConf.to_yaml(config))


def _importable(main: Callable[[DictConfig], None]) -> str:
    """Return the name of the module of `main`, by which another process imports it as well."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return spec.name if main.__module__ == "__main__" and spec else main.__module__


def plain(config: DictConfig) -> dict[str, Any]:
    """Return the resolved configuration as plain dictionaries, lists and scalars."""
    container = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


def require_used(*keys: str, reason: str, accepted: str) -> None:
    """Raise SettingError if one of these settings was typed, which the choices made do not use.

    A key that ends in a dot is the settings of a group without its choice; else it is both.
    """
    for word in HydraConfig.get().overrides.task:
        typed = word.lstrip("+~").partition("=")[0].partition("@")[0]
        for key in keys:
            if typed == key or typed.startswith(key if key.endswith(".") else f"{key}."):
                raise SettingError(f"{typed} has no effect: {reason}; accepted: {accepted}")


def _exit_on_error(run: Callable[[], None], config_name: str, *, show_traceback: bool) -> None:
    try:
        run()
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # the reader of the output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except ModuleNotFoundError as error:  # caught, as Hydra would print a line of its own
        sys.excepthook(type(error), error, error.__traceback__)
        sys.exit(1)
    except _USER_ERRORS as error:
        if show_traceback:
            raise
        print_error(error_message(error, config_name))
        sys.exit(2)


def error_message(error: BaseException, config_name: str) -> str:
    """Return one line: what was wrong, and what is accepted."""
    cause = error.__cause__ if isinstance(error, HydraException) else None
    if isinstance(error, MissingConfigException) and error.options and error.missing_cfg_file:
        group, _, choice = error.missing_cfg_file.rpartition("/")
        if mesh := _mesh_as_object(error.missing_cfg_file):
            return f"object has no option {mesh!r}; accepted: object=mesh object.path={mesh}"
        return _not_accepted(
            group, f"has no option {choice!r}", value=choice, accepted=list(error.options)
        )
    if isinstance(error, OverrideParseException):
        what = error.message.splitlines()[0]
        return f"{error.override!r} is not a setting ({what}); accepted: KEY=VALUE"
    if isinstance(cause, ConfigKeyError | ConfigAttributeError):
        return _unknown_key(cause, config_name)
    lines = str(error).splitlines() or [type(error).__name__]
    if isinstance(error, OmegaConfBaseException | HydraException):
        lines = lines[:1]  # the others name types of OmegaConf, folders, and what may not help
    text = " ".join(" ".join(lines).split())
    if "No match in the defaults list" in text:
        return f"{text} --help shows what is accepted"
    if isinstance(cause, OmegaConfBaseException):
        text = f"{text}: {error_message(cause, config_name)}"
    return text


def _unknown_key(error: ConfigKeyError | ConfigAttributeError, config_name: str) -> str:
    """Return where the path of an override leaves the configuration, and which keys are there."""
    key = str(error.full_key).replace("[", ".").replace("]", "")
    where, _, name = key.rpartition(".")
    if any(part.isdecimal() for part in where.split(".")):  # an entry of a list lacks defaults
        return f"{where} does not give {name!r}; accepted: +{key}=VALUE to add it"
    node = error.parent_node or {}
    where = f"{where}={node['name']}" if where == "method" else where
    accepted = [str(known) for known in node if known != "hydra"]
    return _not_accepted(
        where or config_name, f"has no key {name!r}", value=name, accepted=accepted
    )


def _mesh_as_object(missing: str) -> str:
    """Return the file that was given as the option of `object`, if it is one; else ""."""
    group, _, option = missing.partition("/")
    return option if group == "object" and Path(option).suffix else ""


def _not_accepted(where: str, what: str, *, value: str, accepted: list[str]) -> str:
    close = difflib.get_close_matches(value, accepted, n=1, cutoff=0.5)
    hint = f"; did you mean {close[0]}?" if close else ";"
    return f"{where} {what}{hint} accepted: {', '.join(accepted) or 'no key below it'}"
