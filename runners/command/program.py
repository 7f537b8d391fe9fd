"""A command: Hydra composes its configuration, a mistake is one line, and there is a status."""

from __future__ import annotations

import multiprocessing
import os
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from typing import Any

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from chsel.errors import ChselError
from replay.console import print_error, print_page, print_warning
from replay.startup import ready
from runners.command.arguments import TRACEBACK
from runners.command.at_once import asks_for_help, help_text
from runners.command.choices import CONF, prepared
from runners.command.error_message import error_message

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
    if asks_for_help(words):
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
            main(config)  # the process that waits for it reports what it raises


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
    except BrokenPipeError:  # the reader of the output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except _USER_ERRORS as error:
        if show_traceback:
            raise
        print_error(error_message(error, config_name))
        sys.exit(2)
