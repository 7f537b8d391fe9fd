"""One line about what is wrong with the arguments of a command, and what is accepted."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Mapping
from typing import Any

import hydra
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from runners.command.choices import CONF, NESTED_GROUPS, choices


def error_message(error: BaseException, config_name: str) -> str:
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
        text = ": ".join(part for part in (text, error_message(cause, config_name)) if part)
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


def _no_key(where: str, name: str, node: Mapping[Any, Any]) -> str:
    where = f"{where}={node['name']}" if where == "method" else where
    accepted = [str(known) for known in node if known != "hydra"]
    return _not_accepted(where, f"has no key {name!r}", name, accepted)


def _not_accepted(where: str, what: str, value: str, accepted: list[str]) -> str:
    close = difflib.get_close_matches(value, accepted, n=1, cutoff=0.5)
    hint = f"; did you mean {close[0]}?" if close else ";"
    return f"{where} {what}{hint} accepted: {', '.join(accepted) or 'no key below it'}"
